"""Solving of single loads, and of many loads by worker processes."""
