"""Sparse linear solvers and their factors."""
