"""Hyperelastic laws, public as names of `dpl.fem`."""
