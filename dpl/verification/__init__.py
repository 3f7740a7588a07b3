"""Cases whose answers are known, solved again: the sections of docs/verification.md.

A case solves, draws and returns a `Section`; its references stand beside it, typed as their source
prints them. Sources: closed forms and elliptic integrals; public codes, by name; and "an
independent code": a finite-element program in NumPy, written for these numbers, that shares no line
with this package.
"""

import json
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

from dpl.verification.beams import balance, beam
from dpl.verification.refinement import cook, locking, order
from dpl.verification.report import Row, Section, written
from dpl.verification.rods import buckling, elastica, twist
from dpl.verification.uniaxial import laws

__all__ = ["CASES", "Row", "Section", "measure", "page"]

CASES: dict[str, Callable[[Path], Section]] = {
    "laws": laws,
    "order": order,
    "cook": cook,
    "elastica": elastica,
    "twist": twist,
    "locking": locking,
    "beam": beam,
    "buckling": buckling,
    "balance": balance,
}
