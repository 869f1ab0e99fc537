"""The ground: what every family and every command stands on. Nothing here knows the equations of a problem."""
