"""All laws under uniaxial stress."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.study import picture
from benchmarks.verification.bodies import Array, balanced
from benchmarks.verification.drawing import measured, panel, reference
from benchmarks.verification.report import Row, Section
from dpl import fem

LAWS = {
    "linear": fem.LinearElastic(0.3),
    "SVK": fem.SaintVenantKirchhoff(0.3),
    "NH-ln": fem.NeoHookeanLn(0.3),
    "NHiso-k2": fem.NeoHookeanIsoK2(0.3),
    "NHiso-k4": fem.NeoHookeanIsoK4(0.3),
    "SNH": fem.StableNeoHookean(0.3),
    "Mooney-Rivlin": fem.MooneyRivlinK2(0.15, 0.05, 2.0),
    "Yeoh": fem.YeohK2(0.2, -0.02, 0.005, 2.0),
    "Ogden": fem.OgdenK2((0.3, 0.1, 0.02), (1.3, 5.0, -2.0), 2.0),
}
STRETCHES = (0.7, 0.9, 1.1, 1.5, 2.0)
UNIAXIAL = {  # P11 / E and lateral stretch at each of STRETCHES
    "linear": ("-0.3 -0.1 0.1 0.5 1", "1.09 1.03 0.97 0.85 0.7"),
    "SVK": (
        "-0.1785 -0.0855 0.1155 0.9375 3",
        "1.0737784 1.0281051 0.9679876 0.79056942 0.31622777",
    ),
    "NH-ln": (
        "-0.40523042 -0.10872219 0.093077432 0.37828018 0.64674466",
        "1.1079347 1.0317024 0.97149295 0.88017459 0.79807754",
    ),
    "NHiso-k2": (
        "-0.44554937 -0.11187482 0.090689794 0.33839717 0.53293834",
        "1.1044723 1.0316963 0.9716092 0.88433825 0.81314372",
    ),
    "NHiso-k4": (
        "-0.45107826 -0.11220284 0.090463478 0.33468032 0.52191631",
        "1.1113189 1.0321264 0.97189683 0.88840637 0.82299639",
    ),
    "SNH": (
        "-0.37289985 -0.10674866 0.094487596 0.40444552 0.73211342",
        "1.0852993 1.0301603 0.97046893 0.86708612 0.77104534",
    ),
    "Mooney-Rivlin": (
        "-0.55294631 -0.12900074 0.10005544 0.35616699 0.54696647",
        "1.1530612 1.0436369 0.96201437 0.84942055 0.76076018",
    ),
    "Yeoh": (
        "-0.48025971 -0.12527148 0.10163146 0.3551584 0.54381747",
        "1.1590759 1.0439467 0.9621461 0.84933557 0.76049767",
    ),
    "Ogden": (
        "-0.54675771 -0.13221775 0.10726572 0.43472713 0.83342554",
        "1.1535798 1.0433693 0.9626163 0.85592074 0.78310418",
    ),
}


def pulled(law: fem.Material, stretches: Sequence[float]) -> list[tuple[float, float]]:
    """Return P11 / E and the lateral stretch of a cube stretched along x, its sides free."""
    mesh = fem.box([1.0, 1.0, 1.0], [2, 2, 2])
    held = mesh.p.T == 0
    held[:, 0] |= mesh.p[0] == 1
    rest = fem.Problem.build(mesh, law, fixed=held, length=1.0)
    far, end = int(rest.points.sum(dim=1).argmax()), rest.points[:, 0] == 1
    found = []
    for stretch in stretches:
        moved = torch.zeros_like(rest.points)
        moved[end, 0] = stretch - 1
        problem = replace(rest, prescribed=moved)
        u = balanced(fem.Newton(problem, tol=1e-12)).displacement
        found.append((float(problem.internal_force(u)[0, end, 0].sum()), 1 + float(u[0, far, 1])))
    return found


def laws(folder: Path) -> Section:
    """Solve a cube under uniaxial stress with every law."""
    grid = np.round(np.arange(0.5, 2.001, 0.05), 2)
    curves = {name: pulled(law, grid.tolist()) for name, law in LAWS.items()}
    rows, worst = [], 0.0
    for name, printed in UNIAXIAL.items():
        stress, lateral = (text.split() for text in printed)
        found = [curves[name][int(np.abs(grid - x).argmin())] for x in STRETCHES]
        for x, k in ((0.7, 0), (1.5, 3)):
            rows.append(Row(f"{name}, P11/E at λ = {x}", stress[k], found[k][0]))
        pairs = [(float(s), f[0]) for s, f in zip(stress, found, strict=True)]
        pairs += [(float(s), f[1]) for s, f in zip(lateral, found, strict=True)]
        worst = max(worst, *(abs(b / a - 1) for a, b in pairs))
    rows.append(Row("largest relative difference of 90 stresses and stretches", "< 5e-8", worst))
    with picture(folder / "laws.png") as figure:
        panels = [
            panel(figure, place, "stretch λ [-]", what, title, columns=3, xlim=(0.47, 2.05))
            for place, what, title in (
                (1, "nominal stress P$_{11}$/E [-]", "(a) laws of E = 1, ν = 0.3"),
                (2, "nominal stress P$_{11}$/E [-]", "(b) laws of rubber"),
                (3, "secant modulus P$_{11}$/(λ − 1)/E [-]", "(c) laws of E = 1, ν = 0.3"),
            )
        ]
        _draw_laws(panels, grid, curves)
    at = int(np.abs(grid - 1.5).argmin())
    stresses = [curves[name][at][0] for name in ("NH-ln", "NHiso-k2", "NHiso-k4", "SNH")]
    spread = 100 * (max(stresses) / min(stresses) - 1)
    return Section(
        "Uniaxial stress",
        "closed forms",
        "One hexahedron is stretched along x with free sides: E = 1, ν = 0.3; rubber laws with "
        "shear moduli of 0.40 and 0.42 (Ogden), κ = 2.",
        rows,
        "The laws agree at small strains only. Two laws with the name neo-Hookean differ by "
        f"{spread:.0f} % at λ = 1.5, and SVK has no equilibrium above its largest "
        "compressive stress, at λ = 1/√3.",
    )


def _draw_laws(panels: Sequence[Any], grid: Array, curves: dict[str, Any]) -> None:
    stressed, rubber, stiff = panels
    away, at = np.abs(grid - 1) > 1e-9, np.array(STRETCHES)
    for k, (name, curve) in enumerate(curves.items()):
        P = np.array([stress for stress, _ in curve])
        known = np.array([float(text) for text in UNIAXIAL[name][0].split()])
        style: dict[str, Any] = {
            "markevery": slice(k % 5, None, 5),
            "linestyle": "-" if k % 2 else "--",
        }
        ax, k = (stressed, k) if k < 6 else (rubber, k - 6)
        label = "reference" if k in (2, 5) else None
        measured(ax, grid, P, k, name, **style)
        reference(ax, at, known, label if len(ax.lines) > 5 else None)
        if ax is stressed:
            measured(stiff, grid[away], P[away] / (grid[away] - 1), k, **style)
            reference(stiff, at, known / (at - 1))
    for ax in (stressed, rubber):
        ax.set(ylim=(-1.6, 1.25))
        ax.legend(loc="lower right")
    stiff.set(ylim=(0.35, 2.3))
