"""What judges this repository: verification, stress cases, peers, tables of the paper.

It is not installed: `scripts/` call it in a checkout.
"""
