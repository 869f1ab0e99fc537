"""The base of all families' pictures: style, files, training curves, animations. It knows no problem."""
