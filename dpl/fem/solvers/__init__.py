"""Solvers of the equilibrium equations."""
