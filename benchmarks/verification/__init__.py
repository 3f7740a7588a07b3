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
from benchmarks.verification.cardiac import cardiac, contraction
from benchmarks.verification.composites import composites
from benchmarks.verification.dilatation import dilatation
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
    "dilatation": dilatation,
}

LONG = ("contraction",)  # cases that take more than ten minutes

SHOWN: dict[str, tuple[str, ...]] = {  # values on the page, besides all that exceed their tolerance
    "laws": ("largest relative difference of 90 stresses and stretches",),
    "order": ("hex27, order in L2, last pair", "tet4, L2 error, 16³ cells"),
    "cook": ("Q1, 64 × 64: u_y(48, 52) [mm], deal.II", "Q2, 64 × 64: u_y(48, 52) [mm], deal.II"),
    "elastica": ("hex27, 20 × 1 × 1, α = 10: w/L", "tet10, 20 × 1 × 1, α = 10: u/L"),
    "twist": ("hex27, 4 × 4 × 20: torque [N m]", "hex27, 4 × 4 × 20: axial force [N]"),
    "locking": (
        "hex8, 16 × 4 × 4, ν = 0.4999",
        "hex8 with mean dilatation, 16 × 4 × 4, ν = 0.4999",
        "tet10 with mean dilatation, 8 × 2 × 2, ν = 0.4999",
    ),
    "beam": (
        "hex8, 39 × 9 × 9, SVK, q = 40 Pa: u_z [m]",
        "scene S1: mean of u_z over the end face [m], nine codes",
    ),
    "buckling": (
        "SVK, 10 × 1 × 1: critical load [N], same mesh",
        "SVK, L/h = 40: critical load [N], Euler",
        "L/h = 40, bent, P = 2.5 N: u/L, elastica",
    ),
    "balance": ("moved and turned body: forces, relative", "work / U"),
    "nodal_stress": (
        "beam, tet4, 16 × 4 × 4: von Mises stress over the exact one",
        "cylinder, quad9, 4 × 6: von Mises stress over the exact one",
    ),
    "inflation": (
        "cylinder, quad9, ν = 0.3, p = 0.15 E: r/R, 16 cells",
        "sphere, hex27, ν = 0.3, p = 0.2 E: r/R, 4 cells",
    ),
    "cardiac": (
        "beam, 30 × 6 × 6 hex27: z of (10, 0.5, 1) [mm]",
        "ventricle, 4 in the patch, 14 rings, 3 layers of hex27: z of the apex, endo [mm]",
    ),
    "contraction": ("4 in the patch, 12 rings, 4 layers of hex27: z of the apex, endo [mm]",),
    "artery": (
        "neo-Hookean, 16 × 64 quad9, κ/μ = 1e+06: r/R",
        "Holzapfel-Gasser-Ogden, 16 × 64 quad9, κ/μ = 1e+06: r/R",
    ),
    "composites": (
        "beam, moduli 100 : 1, 5 × 1 × 2 hex27: curvature over M / (E I)",
        "ball, 3 cells along the block, R = 16 a: ε_zz / ε∞",
        "ball, error at R = 4 a over that at 8 a (8 for an error of a³/R³)",
    ),
    "dilatation": (
        "Cook's membrane: u_y(48, 60) [mm], tri6, n = 8, ν = 0.4999",
        "bonded block: force / (E L²), tet10, n = 4, ν = 0.4999",
        "sphere: r/R, tet10, n = 2, ν = 0.4999",
        "Land et al., problem 1: z of (10, 0.5, 1) [mm], tet10, 10 × 2 × 2 × 6",
    ),
}


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
    rows = [
        cells
        for k, (name, section) in enumerate(sections.items(), 1)
        for cells in summary(k, name, section, SHOWN[name])
    ]
    first = "case (source), values within tolerance"
    header = (first, "quantity", "reference", "dpl", "difference")
    lines = [
        "# Verification",
        "",
        "`python scripts/verify.py` (20 minutes; `cases=[contraction]` 35) compares dpl with known",
        "solutions, in float64 on one thread, and writes this page; linked files have all values.",
        "A tolerance is one unit of the last digit that the source prints unless a section states",
        "another one; values beyond it are in **bold**. *An independent code* is a finite-element",
        "program in NumPy, written for these references, without a line of dpl.",
        "",
        *table(header, rows),
        "",
        "In the figures references are black.",
    ]
    for k, (name, section) in enumerate(sections.items(), 1):
        lines += ["", f"## {k}. {section.title}", "", f"{section.text} {section.note}".rstrip()]
        if (folder / f"{name}.png").is_file():
            lines += ["", f"![{section.title}](verification/{name}.png)"]
    return "\n".join(lines) + "\n"
