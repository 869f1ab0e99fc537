"""Landers: a point mass with one engine comes down to a pad, with hidden mass, gravity and engine failure."""
