"""A trained network in use: the hybrid solver and the simulator."""
