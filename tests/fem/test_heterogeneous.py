"""Bodies of several laws: each cell has its own, with and without compiled loops."""

from dataclasses import replace

import numpy as np
import pytest
import skfem
import torch
from laws import LAWS
from skfem.io.meshio import to_meshio
from solving import assert_derivatives, load_of, uncompiled

from dpl import fem
from dpl.fem.postprocess import RestStiffness

NH, HELD = fem.NeoHookeanLn(0.3), fem.Plane(0, "min")
LEFT = {"core": fem.Box([0.0, 0.0, 0.0], [0.5, 1.0, 1.0])}
FIBRES = fem.FibreReinforced(
    fem.VolumetricK2(5.0), fem.Guccione(0.4, 8.0, 2.0, 4.0), fem.ConstantFibres([1, 1, 0])
)
PAIRS = {
    "one class": (fem.NeoHookeanLn(0.3, 10.0), fem.NeoHookeanLn(0.2)),
    "two classes": (fem.YeohK2(2.0, -0.1, 0.05, 20.0), fem.SaintVenantKirchhoff(0.3)),
    "fibres": (FIBRES, NH),
    "not compiled": (fem.OgdenK2([1.0], [2.0], 5.0), fem.MooneyRivlinK2(0.15, 0.05, 2.0)),
}


def grid(cells=(6, 2, 2)):
    ticks = [np.linspace(0, side, n + 1) for side, n in zip((1, 0.3, 0.3), cells, strict=True)]
    return skfem.MeshHex.init_tensor(*ticks)


def body(core, other, mesh=None, **options):
    laws = {"core": core, "other": other}
    options = {"regions": LEFT, "fixed": HELD} | options
    return fem.Problem.build(mesh or grid(), laws, **options)


def displacement(problem, size=0.01):
    random = torch.Generator().manual_seed(0)
    return size * torch.randn(1, *problem.shape, generator=random, dtype=torch.float64)


FIBRE_LAWS = {
    name: (law, law) for name, law in LAWS.items() if isinstance(law, fem.FibreReinforced)
}


@pytest.mark.parametrize("pair", [*PAIRS, *FIBRE_LAWS])
def test_loops_of_several_laws_are_those_of_the_tensors(pair):
    problem = body(*(PAIRS | FIBRE_LAWS)[pair])
    plain, u = uncompiled(problem), displacement(problem)
    found, expected = problem.linearise(u), plain.linearise(u)
    for name in ("force", "tangent"):
        a, b = getattr(found, name), getattr(expected, name)
        assert (a - b).abs().max() < 1e-13 * b.abs().max()
    gap = problem.update_strain_gap(None, 1.0, u)
    mixed = problem.linearise(u, gap)
    again = plain.linearise(u, plain.update_strain_gap(None, 1.0, u))
    assert (mixed.force - again.force).abs().max() < 1e-13 * again.force.abs().max()
    assert problem.evaluate(u).volume_ratio == pytest.approx(plain.evaluate(u).volume_ratio)


@pytest.mark.parametrize("pair", PAIRS)
def test_force_and_tangent_are_the_slopes_of_energy_and_force(pair):
    problem = body(*PAIRS[pair])
    u = displacement(problem)
    assert_derivatives(problem, u, u.flip(1))


def test_regions_of_one_law_are_a_body_of_this_law():
    law = NH
    problem, one = body(law, law), fem.Problem.build(grid(), law, fixed=HELD)
    u = displacement(one)
    assert torch.equal(problem.evaluate(u).internal, one.evaluate(u).internal)
    assert len(fem.symmetries(problem)) == len(fem.symmetries(one))


def test_a_stiff_half_is_no_image_of_the_soft_one():
    """A body fixed nowhere has 16 symmetries; those that swap the halves are lost."""
    free: dict = {"fixed": None}
    assert len(fem.symmetries(body(NH, NH, **free))) == 16
    assert len(fem.symmetries(body(fem.NeoHookeanLn(0.3, 2.0), NH, **free))) == 8
    spread = fem.NeoHookeanLn(0.3, [1, 9])
    assert len(fem.symmetries(body(spread, spread, **free))) == 8  # though equal in the middle


def test_a_bar_of_two_laws_in_series_has_the_sum_of_their_strains():
    """Uniaxial stress without Poisson's effect: exact in linear elements."""
    problem = body(fem.LinearElastic(0.0, 4.0), fem.LinearElastic(0.0))
    stress, x = 1e-4, problem.points[:, 0]
    force = fem.Traction(fem.Plane(0, "max"), [stress, 0.0, 0.0]).on(problem)
    u = fem.solve(fem.Newton(problem), load_of(force[None])).displacement
    assert u[0, (x - 0.5).abs() < 1e-9, 0].numpy() == pytest.approx(stress * 0.5 / 4, rel=1e-9)
    assert u[0, x > 0.99, 0].numpy() == pytest.approx(stress * (0.5 / 4 + 0.5), rel=1e-9)


def test_a_field_of_stiffness_is_that_of_its_values():
    def stiffness(points):
        return 1 + 9 * (points[:, 0] < 0.5)

    field = fem.Problem.build(grid(), fem.NeoHookeanLn(0.3, fem.CellField(stiffness)), fixed=HELD)
    problem = body(fem.NeoHookeanLn(0.3, 10.0), NH)
    u = displacement(problem)
    assert torch.equal(field.linearise(u).tangent, problem.linearise(u).tangent)
    assert field.material.describe() == "NeoHookeanLn(poisson=0.3, young from 1 to 10)"


def test_tags_of_cells_name_regions():
    mesh = grid().with_subdomains({"core": lambda x: x[0] < 0.5})
    problem = body(*PAIRS["one class"], mesh=mesh, regions={})
    expected = body(*PAIRS["one class"])
    u = displacement(problem)
    assert torch.equal(problem.evaluate(u).internal, expected.evaluate(u).internal)
    tagged = body(*PAIRS["one class"], mesh=mesh, regions={"core": fem.Tag("core")})
    assert torch.equal(tagged.evaluate(u).internal, expected.evaluate(u).internal)


def test_parameters_have_the_name_of_their_region():
    problem = body(fem.NeoHookeanLn(0.3, [1, 100]), fem.YeohK2([0.1, 0.3], 0.0, 0.0, 2.0))
    assert problem.parameter_ranges == {"core.young": (1, 100), "other.c10": (0.1, 0.3)}
    values = torch.tensor([[5.0, 0.2], [80.0, 0.15]]).double()
    batch, u = problem.with_parameters(values), displacement(problem).expand(2, -1, -1)
    for k, (young, c10) in enumerate(values.tolist()):
        one = body(fem.NeoHookeanLn(0.3, young), fem.YeohK2(c10, 0.0, 0.0, 2.0))
        for name in ("energy", "internal_force", "roundoff_bound"):
            found, expected = getattr(batch, name)(u)[k], getattr(one, name)(u[k : k + 1])[0]
            assert torch.allclose(found, expected, rtol=1e-12, atol=1e-18), name
        found = batch.evaluate(u.contiguous()).internal[k]
        assert torch.allclose(found, one.internal_force(u[:1])[0], rtol=1e-10, atol=1e-16)


def test_products_with_the_stiffness_at_rest_are_those_of_each_member():
    problem = body(fem.NeoHookeanLn(0.3, [1, 100]), fem.NeoHookeanLn([0.1, 0.4]))
    values = torch.tensor([[5.0, 0.2], [80.0, 0.35]]).double()
    v = displacement(problem).expand(2, -1, -1)
    found = RestStiffness(problem).product(v, values)
    for k in range(2):
        one = problem.with_parameters(values[k : k + 1])
        free = torch.where(one.free, v[k : k + 1], 0.0)
        expected = one.tangent_product(torch.zeros_like(v[:1]), free)[0] * one.free
        assert (found[k] - expected).abs().max() < 1e-12 * expected.abs().max()


def test_ranges_may_be_logarithmic():
    spread = {"low": 1.0, "high": 100.0, "distribution": "log"}
    problem = body(fem.NeoHookeanLn(0.3, spread), NH)
    ends = problem.parameter_ranges["core.young"]
    assert ends == fem.ParameterRange(1, 100, is_log=True)
    assert ends.middle == pytest.approx(10)
    assert float(ends.at(torch.tensor(0.25).double())) == pytest.approx(10**0.5)
    assert ends.normalise(torch.tensor([1.0, 10.0, 100.0])).tolist() == pytest.approx([-1, 0, 1])
    identity = problem.material.identity()["laws"]["core"]["young"]
    assert identity == {"low": 1.0, "high": 100.0, "distribution": "log"}
    assert problem.reference.material.laws["core"].young == pytest.approx(10)


BOTH = {"core": NH, "other": NH}
BROKEN = [  # laws, regions, message
    (
        {"core": NH, "end": NH, "other": NH},
        LEFT | {"end": fem.Box([0.4, 0.0, 0.0], [1.0, 1.0, 1.0])},
        "regions: 4 cells belong to both core and end",
    ),
    ({"core": NH}, LEFT, "regions: 12 of 24 cells belong to no region; add material.other"),
    (
        BOTH,
        LEFT | {"other": fem.Box([0.9, 0.0, 0.0], [1.0, 1.0, 1.0])},
        "regions: 8 of 24 cells belong to no region; remove regions.other",
    ),
    (BOTH, {"core": fem.Box([0, 0, 0], [2, 1, 1])}, "all cells belong to other regions"),
    (BOTH, {"core": fem.Box([5, 0, 0], [6, 1, 1])}, "material.core: Box.* holds no cell"),
    (
        {"cor": NH, "other": NH},
        {},
        "material.cor: 'cor' must be a group of the mesh, which has none; define regions.cor",
    ),
    ({"other": NH}, LEFT, "regions: core has no law; add material.core"),
    ({"core": fem.LinearElastic(0.3), "other": NH}, LEFT, "LinearElastic is a law of small strain"),
    ({}, {}, "material: there is no law"),
]


@pytest.mark.parametrize(("laws", "regions", "message"), BROKEN)
def test_invalid_regions_are_refused_in_one_line(laws, regions, message):
    with pytest.raises(ValueError, match=message) as caught:
        fem.Problem.build(grid(), laws, regions=regions)
    assert "\n" not in str(caught.value)


def test_a_law_whose_cells_are_not_known_says_so():
    with pytest.raises(ValueError, match=r"use Problem\.build"):
        fem.Heterogeneous({"core": NH}, LEFT).energy(torch.zeros(1, 1, 1, 3, 3))


@pytest.mark.parametrize("values", [[1.0, 2.0], np.full(24, np.nan)])
def test_a_field_without_a_number_for_each_cell_is_refused(values):
    with pytest.raises(ValueError, match=r"^material\.young: .* must be 24 finite numbers"):
        fem.Problem.build(grid(), fem.NeoHookeanLn(0.3, fem.CellField(np.asarray(values))))


SHORT = replace(FIBRES, directions=fem.FibreData([[1.0, 0.0, 0.0]]))
MISFITS = {  # key of the part that does not fit the body -> laws
    "core.poisson": {"core": fem.NeoHookeanLn(fem.CellField([0.3])), "other": NH},
    "other.directions": {"core": NH, "other": SHORT},
    "directions": SHORT,
}


@pytest.mark.parametrize("key", MISFITS)
def test_an_error_names_the_part_of_the_law_that_does_not_fit_the_body(key):
    with pytest.raises(ValueError, match=rf"^material\.{key}: (values|fibre) of shape"):
        fem.Problem.build(grid(), MISFITS[key], regions=LEFT)


@pytest.mark.usefixtures("in_process")
def test_a_field_may_be_cell_data_of_a_mesh_file(tmp_path):
    """In the order of the cells that are read."""
    file, made = str(tmp_path / "body.vtu"), grid()
    stiffness = 1 + np.random.default_rng(0).random(made.nelements)
    points = to_meshio(made, encode_cell_data=False)
    points.cell_data = {"stiffness": [stiffness]}
    points.write(file)
    mesh = fem.read_mesh(file)
    law = fem.NeoHookeanLn(0.3, fem.CellField("stiffness", file))
    problem = fem.Problem.build(mesh, law, fixed=HELD)
    np.testing.assert_allclose(problem.material.young[:, 0], stiffness)
    with pytest.raises(ValueError, match=r"^material\.young: .*no cell data 'softness'"):
        fem.Problem.build(mesh, fem.NeoHookeanLn(0.3, fem.CellField("softness", file)))
    for wrong in (lambda: fem.CellField("stiffness"), lambda: fem.CellField([1.0], file)):
        with pytest.raises(ValueError, match="name of cell data if there is a file"):
            wrong()


@pytest.mark.parametrize("equal", [True, False])
def test_loops_keep_no_view_of_a_tensor(equal):
    """Sending a problem to a worker moves the memory of its tensors."""
    mesh = grid() if equal else skfem.MeshHex(grid().p + 0.01 * grid().p[::-1] ** 2, grid().t)
    turning = fem.FibreFunction(lambda x: np.stack([1 + 0 * x[:, 0], x[:, 1], x[:, 2]], axis=1))
    laws = {"core": replace(FIBRES, directions=turning), "other": FIBRES}
    problem = fem.Problem.build(mesh, laws, regions=LEFT, fixed=HELD, mean_dilatation=True)
    parts = [law.frames for law in problem.material.parts.values()]
    tensors = [x for x in problem.__getstate__().values() if isinstance(x, torch.Tensor)]
    for kernels in problem._compiled.groups:
        arrays = [x for x in vars(kernels).values() if isinstance(x, np.ndarray)]
        assert len(arrays) > 5
        for one in arrays:
            assert not any(np.shares_memory(one, tensor.numpy()) for tensor in tensors + parts)
