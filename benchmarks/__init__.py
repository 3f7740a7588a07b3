"""Benchmarks of this repository: verification, stress cases, public codes, tables of the paper.

It is not installed: `scripts/` call it in a checkout.
"""
