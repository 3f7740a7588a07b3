"""Hyperelastic laws."""
