"""Solvers timed and compared: errors, run times, Newton started from predictions."""
