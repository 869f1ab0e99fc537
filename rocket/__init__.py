"""The rockets: vehicle, physics, rewards, environment, optimum, guidance, metrics and pictures, a file each."""
