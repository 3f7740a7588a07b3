"""Families of loads: eigenmodes, modal forces and their sampling, tractions and body forces."""
