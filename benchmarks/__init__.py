"""Benchmarks of this repository: verification, stress cases, public codes, tables of the paper.

It is not installed: `scripts/` call it in a checkout. `scripts/NAME.py` calls `main` of the module
NAME, whose configuration is `conf/NAME.yaml`.
"""

from pathlib import Path

CONF = Path(__file__).parent / "conf"
