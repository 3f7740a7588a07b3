"""Losses: supervised, from residuals, from energies."""
