"""Verification cases with known solutions: the sections of docs/verification.md.

A case solves, draws and returns a `Section`. References stand beside the case with the digits that
their source prints. Sources: closed forms and elliptic integrals; public codes, by name; and "an
independent code": a finite-element program in NumPy, written for these numbers, that shares no line
with this package.
"""

import json
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

from benchmarks.verification.artery import artery
from benchmarks.verification.beams import balance, beam
from benchmarks.verification.cardiac import cardiac
from benchmarks.verification.composites import composites
from benchmarks.verification.contraction import contraction
from benchmarks.verification.nodal_stress import nodal_stress
from benchmarks.verification.pressurised import inflation
from benchmarks.verification.refinement import cook, locking, order
from benchmarks.verification.report import Row, Section, summary, table
from benchmarks.verification.rods import buckling, elastica
from benchmarks.verification.twisted import twist
from benchmarks.verification.uniaxial import laws

__all__ = ["CASES", "LONG", "Row", "Section", "measure", "page"]

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
    "nodal_stress": nodal_stress,
    "inflation": inflation,
    "cardiac": cardiac,
    "contraction": contraction,
    "artery": artery,
    "composites": composites,
}

LONG = ("contraction",)  # cases that take more than ten minutes


def measure(name: str, folder: Path) -> Section:
    """Return the section of a case and write its figures and numbers into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # some of these bodies lock on purpose
        section = CASES[name](folder)
    section = replace(section, seconds=time.perf_counter() - start)
    (folder / f"{name}.json").write_text(json.dumps(asdict(section), indent=1) + "\n")
    return section


def page(folder: Path) -> str:
    """Return the Markdown page of all sections whose numbers are in a folder."""
    sections = {}
    for name in CASES:
        if (path := folder / f"{name}.json").is_file():
            data = json.loads(path.read_text())
            data["rows"] = [Row(**row) for row in data["rows"]]
            sections[name] = Section(**data)
    lines = [
        "# Verification",
        "",
        "`python scripts/verify.py` writes this page and measures every number in the columns",
        "*dpl* and *difference*, in float64 on one thread; the numbers of section 13 only with",
        "`cases=[contraction]`, because they take half an hour. The references are quoted with the",
        "digits of their sources. A difference is relative; its tolerance is one unit of the last",
        "digit of the reference unless the section states another one. Values beyond the tolerance",
        "are set in **bold** and explained below the table. *An independent code* is a small",
        "finite-element program in NumPy, written for these references, that shares no code with",
        "dpl.",
        "In the figures references are black and results of dpl are coloured.",
        "",
        *table(
            ("case", "values", "within tolerance", "largest relative difference", "seconds"),
            [summary(k, s) for k, s in enumerate(sections.values(), 1)],
        ),
    ]
    for k, section in enumerate(sections.values(), 1):
        lines += ["", f"## {k}. {section.title}", "", section.text]
        for file, caption in section.figures:
            lines += ["", f"![{caption}](verification/{file})", "", f"*{caption}*"]
        header = ("quantity", "reference", "dpl", "difference")
        lines += ["", *table(header, [row.cells() for row in section.rows])]
        for note in section.notes:
            lines += ["", note]
    return "\n".join(lines) + "\n"
