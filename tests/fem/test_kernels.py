"""Compiled element loops give the results of the tensor operations."""

import importlib.util
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from multiprocessing.reduction import ForkingPickler
from types import ModuleType

import numpy as np
import pytest
import skfem
import torch
from laws import COMPILED, LAWS
from numba import njit
from solving import rest, uncompiled
from torch import Tensor

from dpl import fem
from dpl.fem.assembly.numba_laws import Law
from dpl.fem.assembly.simd import SIMD_WIDTH, expm1, load, log1p, sqrt, store
from dpl.fem.materials.tensors import green_lagrange, invariants

CLOSE = 1e-13  # of the largest entry
KINDS = list(product(("triangle", "quad", "tetra", "hexahedron"), (1, 2)))


def cubed(x):
    """Return x^3, of numbers of any kind."""
    return x * x * x


@dataclass(frozen=True)
class Coupled(fem.YoungPoissonMaterial, fem.InvariantBasedMaterial):
    """NH-ln + (I1 - 3)^3 / 50 + (I1 - 3)(I2 - 3) / 20 + (I2 - 3)^2 / 40: all derivatives."""

    def energy(self, H):
        """Return the energy density."""
        i1, second, _ = invariants(2 * green_lagrange(H))
        i2 = 2 * i1 + second
        more = i1**3 / 50 + i1 * i2 / 20 + i2**2 / 40
        return fem.NeoHookeanLn(self.poisson).energy(H) + more

    @property
    def constants(self):
        """Return lambda, mu and the factors of the three terms."""
        return self.lam, self.mu, 1 / 50, 1 / 20, 1 / 40

    @staticmethod
    def invariant_derivatives(c, i1, i2, j, log_j, m1):
        """Return the derivatives."""
        rest, p = c[0] * log_j, c[0] * log_j - c[1]
        W1 = c[2] * 3 * (cubed(i1) - (i1 - 1) * i1 * i1) + c[3] * i2  # of what NH-ln has not
        W2 = c[3] * i1 + 2 * c[4] * i2
        rest = rest + 2 * W1 + 4 * W2
        return rest, W2, p, 6 * c[2] * i1, c[3], 2 * c[4], 0.0, 0.0, c[0]


BODIES = [("neo_hookean_ln", cell, d, equal) for cell, d in KINDS for equal in (True, False)]
BODIES += [  # each other law in a plane body and in a solid, on all elements in turn
    (name, *kind, (number + k) % 2 == 0)
    for number, name in enumerate([*sorted(set(COMPILED) - {"neo_hookean_ln"}), "own"])
    for k, kind in enumerate((KINDS[number % 4], KINDS[4 + (number + 1) % 4]))
]


@pytest.fixture(params=BODIES, ids=str)
def body(request, grid, chain) -> fem.Problem:
    """Bodies of each kind of element, with an incomplete last block of SIMD lanes."""
    name, cell, degree, equal = request.param
    mesh = chain(cell, 2 * SIMD_WIDTH + 3) if equal else grid(cell, 3, 0.12)
    law = Coupled(0.3) if name == "own" else LAWS[name]
    problem = fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"), degree=degree)
    assert problem.discretisation.equal_cells == equal
    assert len(problem.cells) % SIMD_WIDTH
    return problem


def check_equal(found: Tensor, expected: Tensor) -> None:
    """Assert that arrays agree to rounding, relative to the largest entry."""
    assert found.shape == expected.shape
    assert (found - expected).abs().max() < CLOSE * expected.abs().max()


def as_tensor(gap: list[tuple[np.ndarray, np.ndarray]], cells: int) -> Tensor:
    """Return strains E (1, cells, Q, 3, 3) of the kernels' 2 E (blocks, Q, 6, SIMD_WIDTH)."""
    rows = torch.from_numpy(gap[0][0]).permute(0, 3, 1, 2).flatten(0, 1)[:cells]  # (E, Q, 6)
    return rows[..., [[0, 3, 5], [3, 1, 4], [5, 4, 2]]][None] / 2


def test_the_derivatives_of_the_law_of_this_file_are_those_of_its_energy():
    """So that the kernels below can be held against it: stress and energy agree."""
    law = Coupled(0.3)
    random = torch.Generator().manual_seed(0)
    H = torch.rand(20, 3, 3, generator=random, dtype=torch.float64) * 0.5 - 0.25
    slope = torch.func.vmap(torch.func.grad(law.energy))(H)
    assert (law.stress(H) - slope).abs().max() < 1e-12
    curvature = torch.func.vmap(torch.func.hessian(law.energy))(H)
    assert (law.tangent(H) - curvature).abs().max() < 1e-11


def test_force_volume_ratio_and_tangent_are_those_of_the_tensors(body, bend):
    check_system(body, bend(body.points, 2))


def turned(mesh: skfem.MeshHex) -> skfem.MeshHex:
    """Return the mesh with random numbers of nodes and cells, each cell turned by a third."""
    random = np.random.default_rng(0)
    number = random.permutation(mesh.p.shape[1])
    corners = mesh.elem.doflocs
    third = [(corners == corner[[1, 2, 0]]).all(axis=1).argmax() for corner in corners]
    t = number[mesh.t].copy()
    t[:, ::2] = t[third, ::2]
    return skfem.MeshHex(mesh.p[:, number.argsort()], t[:, random.permutation(t.shape[1])])


SHEAR = np.array([[1.0, 0.3, -0.2], [0.1, 0.8, 0.4], [0.0, -0.3, 1.2]])
PARALLELEPIPEDS = {
    "equal": lambda p: SHEAR @ p,
    "graded": lambda p: SHEAR @ (p + 0.3 * p**2),
}
HEXAHEDRA = PARALLELEPIPEDS | {"general": lambda p: p + 0.3 * p[[1, 2, 0]] * p[[2, 0, 1]]}


@pytest.mark.parametrize("order", [lambda mesh: mesh, turned], ids=["grid", "turned"])
@pytest.mark.parametrize("shape", HEXAHEDRA)
def test_hexahedra_of_any_shape_and_numbering_are_those_of_the_tensors(shape, order, grid, bend):
    """Parallelepipeds share the inverse Jacobian of a cell, or of all cells if these are equal."""
    plain = grid("hexahedron", 3)
    mesh = order(skfem.MeshHex(HEXAHEDRA[shape](plain.p), plain.t))
    body = fem.Problem.build(mesh, fem.NeoHookeanLn(0.3), fixed=fem.Plane(0, "min"))
    (kernels,) = body._compiled.groups
    assert kernels.reference is None
    assert (kernels.inverse.shape[1] == 1) == (shape in PARALLELEPIPEDS)
    check_system(body, bend(body.points, 2))


def check_system(body: fem.Problem, u: Tensor) -> None:
    """Assert that the loops give force, volume ratio and tangent of the tensor operations."""
    plain = uncompiled(body)
    assert body._compiled is not None
    found, expected = body.evaluate(u), plain.evaluate(u)
    check_equal(found.internal, expected.internal)
    check_equal(found.volume_ratio, expected.volume_ratio)
    system, exact = body.linearise(u[:1]), plain.linearise(u[:1])
    check_equal(system.force, exact.force)
    check_equal(system.tangent, exact.tangent)
    assert torch.equal(system.valid, exact.valid)


def test_system_of_mixed_points_is_that_of_the_tensors(body, bend):
    """Two steps of points, and the system at the strains where they end."""
    if not body.material.has_response:
        pytest.skip("strains are no unknowns of the linear law")
    u, v, w = (0.7 * bend(body.points, seed=seed) for seed in range(3))
    gap = body.update_strain_gap(body.update_strain_gap(None, 1.0, v), 0.25, w)
    plain = uncompiled(body)
    wide = plain.update_strain_gap(plain.update_strain_gap(None, 1.0, v), 0.25, w)
    check_equal(as_tensor(gap, len(body.cells)), wide)
    assert wide.abs().max() > 1e-3
    found, expected = body.linearise(u, gap), plain.linearise(u, wide)
    check_equal(found.force, expected.force)
    check_equal(found.tangent, expected.tangent)
    assert found.valid.item()
    assert expected.valid.item()


NEO_HOOKEAN = pytest.mark.parametrize("body", BODIES[: 2 * len(KINDS)], indirect=True, ids=str)


@NEO_HOOKEAN
def test_body_at_rest_has_no_force(body):
    internal, volume = body.evaluate(rest(body))
    assert not internal.any()
    assert volume.item() == 1


@NEO_HOOKEAN
def test_tiny_displacements_keep_their_digits(body, bend):
    """At |u|/L = 1e-12 the strain would be lost in the rounding of F."""
    u = bend(body.points)
    tiny = 1e-12 * u
    slope = body.tangent_product(torch.zeros_like(u), u)
    assert (1e12 * body.evaluate(tiny).internal - slope).abs().max() < 1e-10 * slope.abs().max()


@NEO_HOOKEAN
def test_nan_in_a_displacement_gives_no_volume_ratio(body):
    """In any cell, the last one of a block that is not full among them."""
    for bad, node in product((math.nan, math.inf), (0, body.shape[0] // 2, body.shape[0] - 1)):
        u = rest(body)
        u[0, node, 0] = bad
        assert body.evaluate(u).volume_ratio.item() == -math.inf


def test_inverted_body_has_the_force_of_the_tensors(body, bend):
    """A law that is defined there feels it; one with ln J has no force in either."""
    mirror = torch.eye(body.shape[1], dtype=torch.float64)
    mirror[0, 0] = -1
    u = (body.points + 0.5 * bend(body.points)) @ mirror - body.points
    found, expected = body.evaluate(u), uncompiled(body).evaluate(u)
    assert found.volume_ratio < 0
    check_equal(found.volume_ratio, expected.volume_ratio)
    assert torch.equal(found.internal.isnan(), expected.internal.isnan())
    assert (found.internal - expected.internal).nan_to_num().abs().max() < 1e-14


@pytest.mark.parametrize(
    "count", [1, 2, SIMD_WIDTH - 1, SIMD_WIDTH, SIMD_WIDTH + 1, 2 * SIMD_WIDTH]
)
def test_number_of_cells_does_not_matter(chain, bend, count):
    """Blocks of SIMD lanes that are full, almost full, almost empty; equal and unequal cells."""
    body = fem.Problem.build(chain("quad", count), fem.NeoHookeanLn(0.3), length=1.0)
    several = replace(body, dN=body.dN.repeat(count, 1, 1, 1), dV=body.dV.repeat(count, 1))
    u = bend(body.points / count)
    for problem in (body, several):
        plain = uncompiled(problem)
        check_equal(problem.evaluate(u).internal, plain.evaluate(u).internal)
        check_equal(problem.linearise(u).tangent, plain.linearise(u).tangent)
        gap = as_tensor(problem.update_strain_gap(None, 1.0, u), count)
        check_equal(gap, plain.update_strain_gap(None, 1.0, u))


def test_order_of_axes_in_memory_does_not_matter(grid, bend):
    """Displacements from a network or a transposed file are not contiguous."""
    body = fem.Problem.build(grid("hexahedron"), fem.NeoHookeanLn(0.3))
    u = bend(body.points, 2)
    strided = u.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    assert not strided.is_contiguous()
    assert torch.equal(body.evaluate(strided).internal, body.evaluate(u).internal)
    first = body.linearise(strided[:1]).tangent
    assert torch.equal(first, body.linearise(u[:1]).tangent)


def test_law_without_invariant_derivatives_is_not_compiled(grid, laws, bend):
    body = fem.Problem.build(grid("hexahedron"), laws["ogden_k2"])
    assert body._compiled is None
    u = bend(body.points)
    assert torch.equal(body.evaluate(u).internal, body.internal_force(u))
    assert torch.equal(body.linearise(u).tangent, body.tangent(u))


def test_problem_sent_to_another_process_keeps_its_arrays(grid, bend):
    """Torch moves the memory of tensors that it sends; arrays made of them must not dangle."""
    body = fem.Problem.build(grid("hexahedron"), fem.NeoHookeanLn(0.3))
    u = bend(body.points)
    before = body.evaluate(u).internal
    (kernels,) = body._compiled.groups
    for array, tensor in product((kernels.cells, kernels.dV), (body.cells, body.dV)):
        assert not np.shares_memory(array, tensor.numpy())
    ForkingPickler.dumps(body)
    assert torch.equal(body.evaluate(u).internal, before)


LAW = """
from dataclasses import dataclass

from dpl.fem import InvariantBasedMaterial, YoungPoissonMaterial

FACTOR = {factor}

def inner(x):
    return {inner} * x

def outer(x):
    return {outer} * x

@dataclass(frozen=True)
class Mine(YoungPoissonMaterial, InvariantBasedMaterial):
    @property
    def constants(self):
        return (self.mu,)

    @staticmethod
    def invariant_derivatives(c, i1, i2, j, log_j, m1):
        return outer(c[0] * i1), {slope}, 0.0, c[0], 0.0, 0.0, 0.0, 0.0, 0.0
"""


@pytest.fixture
def written(tmp_path, monkeypatch) -> Callable[..., ModuleType]:
    """Writes modules with a law in them and imports these."""

    def written(name: str, **parts: str) -> ModuleType:
        path = tmp_path / f"{name}.py"
        given = {"factor": "0.5", "inner": "4", "outer": "2 * FACTOR", "slope": "-c[0] / 2"}
        path.write_text(LAW.format(**given | parts))
        spec = importlib.util.spec_from_file_location(name, path)
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, module)
        spec.loader.exec_module(module)
        return module

    return written


PARTS = {
    "slopes": {"slope": "-c[0] / 4"},
    "helper": {"outer": "3 * FACTOR"},
    "number of the module": {"factor": "0.7"},
    "helper of a helper": {"outer": "inner(0.7)"},
}


def name_of(module: ModuleType) -> str:
    """Return the name of the type of a module's law, by which its machine code is found."""
    return Law.of(module.Mine(0.3).compiled_form, "code of the loops").kind.name


@pytest.mark.parametrize("part", PARTS)
def test_type_of_a_law_changes_with_the_source_of_its_derivatives(written, part):
    """So that no machine code of another law is taken from the disk."""
    first, again = name_of(written("first")), name_of(written("again"))
    assert first == again
    assert name_of(written("other", **PARTS[part])) != first


def test_type_of_a_law_changes_with_the_code_of_the_loops_and_not_with_the_name_of_the_law():
    """Laws with the same source and number of constants share their compiled loops."""
    form = fem.NeoHookeanLn(0.3).compiled_form
    assert Law.of(form, "one").kind.name != Law.of(form, "another").kind.name
    kinds = [
        Law.of(LAWS[name].compiled_form, "code of the loops").kind
        for name in ("linear_elastic", "saint_venant_kirchhoff", "neo_hookean_ln")
    ]
    assert kinds[0] == kinds[1] != kinds[2]


@pytest.mark.parametrize("part", [None, "helper of a helper"])  # each is compiled
def test_laws_of_one_name_are_not_confused(written, grid, bend, part):
    body = fem.Problem.build(grid("quad"), written("module", **PARTS.get(part, {})).Mine(0.3))
    u = bend(body.points)
    check_equal(body.evaluate(u).internal, uncompiled(body).evaluate(u).internal)


@njit
def _arithmetic(a, b, out):
    x, y = load(a, 0), load(b, 0)
    results = (
        *(x + y, x - y, x * y, x / y, -x, sqrt(y)),
        *(x + 2.0, 2.0 + x, x - 2.0, 2.0 - x, x * 3.0, 3.0 * x, x / 4.0, 4.0 / x),
        *(x + 2, 2 - x, x * 3, 4 / x),
    )
    row = 0
    for value in results:
        store(out, row, value)
        row += 1
    store(out, row, 7.5)
    store(out, row + 1, load(a, 1))


def test_simd_vectors_add_multiply_and_divide_like_numbers():
    random = np.random.default_rng(0)
    a, b = random.uniform(0.5, 2.0, (2, 2, SIMD_WIDTH))
    a[:, ::2] *= -1
    out = np.full((20, SIMD_WIDTH), np.nan)
    _arithmetic(a, b, out)
    x, y = a[0], b[0]
    expected = [
        *(x + y, x - y, x * y, x / y, -x, np.sqrt(y)),
        *(x + 2, 2 + x, x - 2, 2 - x, x * 3, 3 * x, x / 4, 4 / x),
        *(x + 2, 2 - x, x * 3, 4 / x),
        *(np.full(SIMD_WIDTH, 7.5), a[1]),
    ]
    assert out == pytest.approx(np.array(expected), rel=1e-15)


@njit
def _logarithm_and_exponential(a, out):
    store(out, 0, log1p(load(a, 0)))
    store(out, 1, expm1(load(a, 1)))


def test_logarithm_and_exponential_have_the_digits_of_numpy():
    """Of small numbers, of 1 + x close to 0, and of large ones."""
    random = np.random.default_rng(0)
    small = random.choice([-1, 1], 4000) * 10.0 ** random.uniform(-300, -0.01, 4000)
    large, near = 10.0 ** random.uniform(-1, 300, 4000), 10.0 ** random.uniform(-15, 0, 4000) - 1
    x, y = np.concatenate([small, large, near]), random.uniform(-600, 600, 8000)
    values = np.stack([x, np.concatenate([small, y])]).reshape(2, -1, SIMD_WIDTH)
    values = np.ascontiguousarray(values.swapaxes(0, 1))
    out = np.empty_like(values)
    for pair, result in zip(values, out, strict=True):
        _logarithm_and_exponential(pair, result)
    assert out[:, 0] == pytest.approx(np.log1p(values[:, 0]), rel=1e-15, abs=0)
    assert out[:, 1] == pytest.approx(np.expm1(values[:, 1]), rel=1e-15, abs=0)


def test_logarithm_of_no_positive_number_is_nan():
    beyond = np.full((2, SIMD_WIDTH), -1.0)
    beyond[0, 1:] = -1.5, math.nan, *[-math.inf] * (SIMD_WIDTH - 3)
    out = np.zeros((2, SIMD_WIDTH))
    _logarithm_and_exponential(beyond, out)
    assert np.isnan(out[0]).all()
