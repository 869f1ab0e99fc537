"""The small problems: a `Problem` is dynamics and a quadratic cost in phases. `envs.py` has the tables."""
