"""Active problem of the cardiac mechanics benchmark: a contracting ventricle.

Source: Land et al. (2015), Proc. R. Soc. A 471:20150641, problem 3. The sources of the digits are
those of `benchmarks.verification.cardiac`.
"""

from pathlib import Path

from benchmarks.study import picture
from benchmarks.verification.cardiac import BULKS, SPREAD, apex_of
from benchmarks.verification.drawing import measured, panel
from benchmarks.verification.report import Row, Section
from benchmarks.verification.ventricle import endocardium, fibres, ventricle
from dpl import fem

ENDO, EPI = "-12.347", "-15.452"  # z of the deformed apex [mm]
MESHES = ((2, 6, 2), (3, 9, 3), (4, 12, 4))  # patch, rings, layers


def contracted(patch: int, rings: int, layers: int, bulk: float = BULKS[-1]) -> fem.Problem:
    """Return the ventricle under 15 kPa with an active stress of 60 kPa along its fibres."""
    muscle = fem.Guccione(2.0, 8.0, 2.0, 4.0)
    return fem.Problem.build(
        ventricle(patch, rings, layers),
        fem.FibreReinforced(fem.VolumetricK4(bulk), muscle, fem.FibreFunction(fibres)),
        supports=[fem.DirichletBC(fem.Plane(2, "max"))],
        degree=2,
        mean_dilatation=True,
        follower_loads=[fem.FollowerPressure(endocardium, 15.0), fem.ActiveStress(60.0)],
        length=1.0,
    )


def contraction(folder: Path) -> Section:
    """Solve problem 3 on refined meshes."""
    found = {mesh: apex_of(contracted(*mesh)) for mesh in MESHES}
    rows = []
    for k, (side, text) in enumerate((("endo", ENDO), ("epi", EPI))):
        for (patch, rings, layers), values in found.items():
            name = f"{patch} in the patch, {rings} rings, {layers} layers of hex27"
            rows.append(Row(f"{name}: z of the apex, {side} [mm]", text, values[k], SPREAD))
    with picture(folder / "contraction.png", 2.9) as figure:
        for k, (side, text) in enumerate((("endo", ENDO), ("epi", EPI))):
            label = f"z of the apex, {side} [mm]"
            axes = panel(figure, k + 1, "layers of cells", label, f"({'ab'[k]})")
            measured(axes, [mesh[-1] for mesh in MESHES], [one[k] for one in found.values()], k)
            axes.axhline(float(text), color="black", linewidth=0.8)
            axes.set_xticks([mesh[-1] for mesh in MESHES])
    counts = ", ".join(str(count) for *_, count in found.values())
    return Section(
        "Cardiac benchmark: contraction",
        "Land et al. 2015, problem 3",
        "The ellipsoid with fibres from −90° outside to +90° inside, a pressure of 15 kPa and an "
        "active stress of 60 kPa, κ = 100 MPa. References and tolerance as before.",
        rows,
        f"Newton iterations: {counts}. The inner apex converges slowly, since all fibres "
        "meet there.",
    )
