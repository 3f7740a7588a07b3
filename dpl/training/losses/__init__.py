"""Losses of displacements: supervised, residual-based and energy-based."""
