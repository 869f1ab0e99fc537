"""What the pictures of all families share: style, files, training curves, animations. Knows no problem."""
