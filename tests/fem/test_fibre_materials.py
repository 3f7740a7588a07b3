"""Laws with fibres: derivatives, invariance, closed forms, limits."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from dpl import fem
from dpl.fem.materials.tensors import volume_change

FIBRES = {
    "guccione": fem.Guccione(0.4, 8.0, 2.0, 4.0),
    "two_families": fem.HolzapfelGasserOgdenFibres(0.5, 2.0, 0.1, 0.6),
    "one_family": fem.HolzapfelGasserOgdenFibres(0.5, 2.0, 0.2, 0.6, families=1),
    "holzapfel_ogden": fem.HolzapfelOgdenFibres(0.5, 2.0, 0.3, 3.0, 0.2, 1.5),
}
MATRICES = {
    "guccione": fem.VolumetricK2(5.0),
    "two_families": fem.NeoHookeanIsoK4(0.3),
    "one_family": fem.VolumetricK4(3.0),
    "holzapfel_ogden": fem.DemirayK2(0.3, 2.0, 5.0),
}
EYE = torch.eye(3, dtype=torch.float64)


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def gradients(generator) -> Tensor:
    """Displacement gradients H (B, E, Q, 3, 3) of uninverted F, far from rest."""
    H = torch.rand(2, 5, 4, 3, 3, generator=generator, dtype=torch.float64) * 0.5 - 0.25
    assert (volume_change(H) > -0.9).all()
    return H


@pytest.fixture
def frames(generator) -> Tensor:
    """Right-handed frames of five cells."""
    return rotations(5, generator)


@pytest.fixture(params=FIBRES)
def name(request) -> str:
    return request.param


@pytest.fixture
def fibres(name) -> fem.FibreEnergy:
    return FIBRES[name]


@pytest.fixture
def law(name, frames) -> fem.FibreReinforced:
    return fem.FibreReinforced(MATRICES[name], FIBRES[name], frames)


def rotations(count: int, generator: torch.Generator) -> Tensor:
    """Return uniformly distributed rotations, (count, 3, 3)."""
    Q, R = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    Q = Q * R.diagonal(dim1=-2, dim2=-1).sign()[:, None]
    return Q * torch.linalg.det(Q).sign()[:, None, None]


def assert_near(found: Tensor, wanted: Tensor, tolerance: float) -> None:
    """Assert equality relative to the largest entry."""
    assert_close(found, wanted, rtol=0, atol=tolerance * wanted.abs().max().item())


def test_each_cell_has_its_own_frame(law, gradients):
    """Cells are at axis -4 of H; one frame for all cells takes any H."""
    one = law.of_cells(torch.tensor([3]))
    assert one.frames.shape == (1, 1, 3, 3)
    H = gradients[1, 3, 2]
    for quantity in ("energy", "stress", "tangent"):
        found = getattr(one, quantity)(H)
        whole = getattr(law, quantity)(gradients)[1, 3, 2]
        assert_near(found, whole, 1e-13)
    some = law.of_cells(torch.tensor([4, 1]))
    assert_near(some.stress(gradients[:, [4, 1]]), law.stress(gradients)[:, [4, 1]], 1e-14)
    mask = torch.tensor([False, True, False, False, True])
    assert_close(law.of_cells(mask).frames, law.frames[[1, 4]])
    assert one.of_cells(torch.tensor([0, 0])) is one


# ------------------------------------------------------------------ rest and small strains


def moduli_at_rest(fibres: fem.FibreEnergy) -> Tensor:
    """Return dS/dE (3, 3, 3, 3) of the fibres alone, in their frame, at rest."""
    matrix = fem.VolumetricK2(1.0)
    zero = torch.zeros(3, 3, dtype=torch.float64)
    law = fem.FibreReinforced(matrix, fibres, EYE[None])
    return law.response(zero).moduli - matrix.response(zero).moduli


@pytest.mark.parametrize("size", [1e-6, 1e-10, 1e-14])
def test_tiny_strains_keep_their_digits(law, gradients, size):
    """Energy and stress are those of the moduli at rest, up to terms of the order of the strain."""
    local = torch.diag_embed(0.2 + gradients.diagonal(dim1=-2, dim2=-1).abs())
    local = local + 0.02 * gradients.tril(-1)
    local = local + local.mT  # fibres and sheets are stretched
    Q = law.frames
    H = size * Q @ local @ Q.mT
    C = law.tangent(0 * H)
    wanted = torch.einsum("...ijkl,...kl->...ij", C, H)
    tolerance = 100 * size + 1e-13
    assert_near(law.stress(H), wanted, tolerance)
    D = moduli_at_rest(law.fibres)
    strain = size * local
    energy = torch.einsum("...ij,ijkl,...kl->...", strain, D, strain) / 2
    assert_close(law.fibres.energy(2 * strain), energy, rtol=tolerance, atol=0)


def test_average_moduli_are_those_over_all_directions(fibres, generator):
    """The averages of mu and lambda are over rotations: the isotropic part of the moduli."""
    law = fem.FibreReinforced(fem.VolumetricK2(1.0), fibres, EYE[None])
    R = rotations(20000, generator)
    D = law.response(torch.zeros(3, 3, dtype=torch.float64)).moduli
    shear = torch.einsum("ra,rb,rc,rd,abcd->r", R[:, 0], R[:, 1], R[:, 0], R[:, 1], D)
    normal = torch.einsum("ra,rb,rc,rd,abcd->r", R[:, 0], R[:, 0], R[:, 1], R[:, 1], D)
    assert law.mu == pytest.approx(shear.mean().item(), rel=0.05)
    assert law.lam == pytest.approx(normal.mean().item(), rel=0.05)
    assert 0 < law.poisson_ratio < 0.5


def test_fibres_in_all_directions_alike_are_isotropic(gradients, generator):
    """At kappa = 1/3 each family has E = (I1 - 3)/3."""
    fibres = fem.HolzapfelGasserOgdenFibres(0.5, 2.0, 1 / 3, 0.6)
    law, twin = (
        fem.FibreReinforced(fem.VolumetricK2(1.0), fibres, rotations(5, generator))
        for _ in range(2)
    )
    assert_near(law.stress(gradients), twin.stress(gradients), 1e-12)
    assert law.mu == pytest.approx(0, abs=1e-15)
    assert law.lam == pytest.approx(1 + 8 / 9 * 0.5)


# ------------------------------------------------------------------ published energies


def exponential(a: float, b: float, x: Tensor) -> Tensor:
    return a / (2 * b) * ((b * x.square()).exp() - 1)


def guccione(C: Tensor, f: Tensor, s: Tensor, n: Tensor) -> Tensor:
    """Guccione et al. (1991), in Green-Lagrange strains."""
    ff, ss, nn, fs, sn, fn = (
        stretched(C, a, b) / 2 for a, b in ((f, f), (s, s), (n, n), (f, s), (s, n), (f, n))
    )
    Q = 8.0 * ff**2 + 2.0 * (ss**2 + nn**2 + 2 * sn**2) + 4.0 * 2 * (fs**2 + fn**2)
    return 0.4 / 2 * (Q.exp() - 1)


def families(kappa: float, *angles: float):
    """Gasser et al. (2006), with E = kappa I1 + (1 - 3 kappa) I4 - 1 of each direction."""

    def energy(C: Tensor, f: Tensor, s: Tensor, n: Tensor) -> Tensor:
        directions = [math.cos(angle) * f + math.sin(angle) * s for angle in angles]
        strain = [stretched(C, a, a) for a in (f, s, n)]
        E = [kappa * sum(strain) + (1 - 3 * kappa) * stretched(C, a, a) for a in directions]
        return sum(exponential(0.5, 2.0, e.clamp(min=0)) for e in E)

    return energy


def holzapfel_ogden(C: Tensor, f: Tensor, s: Tensor, n: Tensor) -> Tensor:
    """Holzapfel, Ogden (2009), without the isotropic part."""
    fibres = exponential(0.5, 2.0, stretched(C, f, f).clamp(min=0))
    sheets = exponential(0.3, 3.0, stretched(C, s, s).clamp(min=0))
    return fibres + sheets + exponential(0.2, 1.5, stretched(C, f, s))


def stretched(C: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return a . (C - I) b."""
    return torch.einsum("ei,beqij,ej->beq", a, C - EYE, b)


PUBLISHED = {
    "guccione": guccione,
    "two_families": families(0.1, 0.6, -0.6),
    "one_family": families(0.2, 0.6),
    "holzapfel_ogden": holzapfel_ogden,
}


def test_energies_are_the_published_functions_of_the_directions(name, law, gradients):
    """`test_materials` finds stress and tangent to be their slopes."""
    F = EYE + gradients
    wanted = PUBLISHED[name](F.mT @ F, *law.frames[:, 0].unbind(-1))
    found = law.energy(gradients) - law.matrix.energy(gradients)
    assert_close(found, wanted, rtol=1e-10, atol=1e-14)


SHEAR = EYE.clone()
SHEAR[0, 1] = 0.4


@pytest.mark.parametrize("name", ["two_families", "one_family", "holzapfel_ogden"])
def test_shortened_fibres_have_neither_stress_nor_stiffness(name):
    H = torch.tensor([0.9, 0.95, 0.99]).double().diag() - EYE
    law = fem.FibreReinforced(MATRICES[name], FIBRES[name], EYE[None])
    assert law.energy(H) == law.matrix.energy(H)
    assert_close(law.stress(H), law.matrix.stress(H), rtol=0, atol=0)
    if name == "holzapfel_ogden":  # its shear resists either way
        law = fem.FibreReinforced(
            law.matrix, fem.HolzapfelOgdenFibres(0.5, 2, 0.3, 3, 0.0, 1), EYE[None]
        )
    assert_close(law.tangent(H), law.matrix.tangent(H), rtol=0, atol=0)


def test_a_nearly_incompressible_matrix_becomes_compressible_around_the_same_fibres(frames):
    fibres = FIBRES["two_families"]
    law = fem.FibreReinforced(fem.NeoHookeanIsoK2(0.49), fibres, frames)
    found = law.compressible()
    assert found.parts == {**law.parts, "matrix": law.parts["matrix"].compressible()}
    assert float(found.parts["matrix"].poisson_ratio) == pytest.approx(0.0, abs=1e-12)


def test_fibres_have_their_stiffness_at_rest():
    """Stretched fibres decide the moduli there, so that the linear solution resists."""
    zero = torch.zeros(3, 3, dtype=torch.float64)
    for fibres in (FIBRES["two_families"], FIBRES["one_family"], FIBRES["holzapfel_ogden"]):
        law = fem.FibreReinforced(fem.VolumetricK2(1.0), fibres, EYE[None])
        D = law.response(torch.diag(torch.full((3,), 1e-9)).double()).moduli
        assert_near(law.response(zero).moduli, D, 1e-7)


# ------------------------------------------------------------------ isotropic parts


def test_demiray_has_the_closed_forms():
    """Holzapfel, Ogden (2009): sigma11 - sigma22 = a (s^2 - 1/s) exp(b (s^2 + 2/s - 3))."""
    law = fem.DemirayK2(0.3, 2.0, 5.0)
    F = torch.tensor([1.2, 1.2**-0.5, 1.2**-0.5], dtype=torch.float64).diag()
    sigma = law.stress(F - EYE) @ F.mT
    wanted = 0.3 * (1.2**2 - 1 / 1.2) * math.exp(2.0 * (1.2**2 + 2 / 1.2 - 3))
    assert (sigma[0, 0] - sigma[1, 1]).item() == pytest.approx(wanted, rel=1e-12)
    sigma = law.stress(SHEAR - EYE) @ SHEAR.mT
    assert sigma[0, 1].item() == pytest.approx(0.3 * 0.4 * math.exp(2.0 * 0.4**2), rel=1e-12)
    assert (law.mu, law.lam) == (pytest.approx(0.3), pytest.approx(5.0 - 0.2))


@pytest.mark.parametrize(
    ("law", "slope"),
    [
        (fem.VolumetricK2(5.0), lambda J: 5.0 * (J - 1)),
        (fem.VolumetricK4(5.0), lambda J: 5.0 / 2 * (J - 1 / J)),
        (fem.DemirayK2(0.3, 2.0, 5.0), lambda J: 5.0 * (J - 1)),
    ],
)
def test_volumetric_energies_have_their_pressure(law, slope):
    """F = s I has P = U'(J) s^2 I; isochoric shear has no stress of the volumetric laws."""
    for s in (0.8, 1.2):
        P = law.stress((s - 1) * EYE)
        assert_close(P, slope(s**3) * s**2 * EYE, rtol=1e-12, atol=1e-14)
    if not isinstance(law, fem.DemirayK2):
        assert law.stress(SHEAR - EYE).abs().max() < 1e-14
        assert (law.mu, law.lam) == (0, pytest.approx(5.0))


# ------------------------------------------------------------------ bodies, identity, errors


def test_forces_of_a_body_are_the_gradient_of_its_energy(generator):
    """Each point has the frame of its place."""
    name = "two_families"
    mesh = fem.box([1.0, 0.5, 0.5], [4, 3, 3]).translated([7.0, 0.0, 0.0])
    spec = fem.FibreFunction(lambda x: torch.cos(torch.from_numpy(x * [1.0, 2.0, 3.0])).numpy())
    law = fem.FibreReinforced(MATRICES[name], FIBRES[name], spec)
    body = fem.Problem.build(mesh, fem.NeoHookeanIsoK4(0.3))
    law = law.on(body.basis, body.length, body.origin)
    body = replace(body, material=law)
    assert law.frames.shape == (12, 8, 3, 3)
    u = 0.05 * torch.rand(1, *body.shape, generator=generator, dtype=torch.float64)
    exact = torch.func.grad(lambda u: body.energy(u).sum())(u)
    assert_near(body.internal_force(u), exact, 1e-12)


def test_identity_is_plain_data_that_tells_laws_apart(law, generator):
    twin = fem.FibreReinforced(law.matrix, law.fibres, law.directions.clone())
    assert twin.identity() == law.identity()
    assert isinstance(law.identity()["directions"], str)
    other = fem.FibreReinforced(law.matrix, law.fibres, rotations(5, generator))
    assert other.identity() != law.identity()
    assert law.identity()["fibres"]["name"] == type(law.fibres).__name__
    spec = fem.FibreReinforced(law.matrix, law.fibres, fem.ConstantFibres([1.0, 0.0, 0.0]))
    options = {"name": "ConstantFibres", "fibre": [1.0, 0.0, 0.0], "sheet": None}
    assert spec.identity()["directions"] == options


def test_law_needs_its_directions(fibres, gradients):
    law = fem.FibreReinforced(fem.VolumetricK2(1.0), fibres, fem.FibreFunction(lambda x: x))
    with pytest.raises(ValueError, match="FibreFunction must be evaluated on a body"):
        law.stress(gradients)
    assert law.mu >= 0  # averages need no directions
    body = fem.Problem.build(fem.box([1.0, 1.0, 1.0], [2, 2, 2]), fem.NeoHookeanIsoK4(0.3))
    known = fem.FibreReinforced(fem.VolumetricK2(1.0), fibres, EYE.expand(3, 3, 3))
    with pytest.raises(ValueError, match="frames of 3 cells and must have those of 1"):
        known.on(body.basis, body.length, body.origin)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: fem.Guccione(0.0, 1, 1, 1), "c = 0.0 must be a number above 0"),
        (lambda: fem.Guccione(1, 1, -1, 1), "bt = -1 must be a number above 0"),
        (lambda: fem.Guccione(1, 1, 1, math.nan), "bfs = nan must be a number above 0"),
        (lambda: fem.HolzapfelGasserOgdenFibres(0, 1), "k1 = 0 must be a number above 0"),
        (lambda: fem.HolzapfelGasserOgdenFibres(1, math.inf), "k2 = inf must be a number above 0"),
        (lambda: fem.HolzapfelGasserOgdenFibres(1, 1, 0.34), "kappa = 0.34 must be a number"),
        (lambda: fem.HolzapfelGasserOgdenFibres(1, 1, -0.1), "from 0 to 0.333333"),
        (lambda: fem.HolzapfelGasserOgdenFibres(1, 1, 0, math.nan), "angle = nan must be a number"),
        (lambda: fem.HolzapfelGasserOgdenFibres(1, 1, 0, 0, 3), "families = 3 must be 1 or 2"),
        (lambda: fem.HolzapfelOgdenFibres(0, 1, 1, 1, 1, 1), "af = 0 must be a number above 0"),
        (lambda: fem.HolzapfelOgdenFibres(1, 1, -1, 1, 1, 1), "as_ = -1 must be a number from 0"),
        (lambda: fem.HolzapfelOgdenFibres(1, 1, 0, 1, 0, 0), "bfs = 0 must be a number above 0"),
        (lambda: fem.DemirayK2(0, 1, 1), "a = 0 must be a number above 0"),
        (lambda: fem.DemirayK2(1, 0, 1), "b = 0 must be a number above 0"),
        (lambda: fem.DemirayK2(1, 1, 0), "bulk = 0 must be a number above 0"),
        (lambda: fem.VolumetricK2(0), "bulk = 0 must be a number above 0"),
        (lambda: fem.VolumetricK4(math.inf), "bulk = inf must be a number above 0"),
        (lambda: reinforced(matrix=fem.LinearElastic(0.3)), "matrix = LinearElastic must be"),
        (lambda: reinforced(directions=torch.eye(3)), "must have .cells, 3, 3."),
        (lambda: reinforced(directions=2 * EYE[None]), "orthonormal .*; in 1 of 1 cells they do"),
        (lambda: reinforced(directions=math.nan * EYE[None]), "orthonormal columns"),
    ],
)
def test_invalid_constants_are_an_error(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def reinforced(**parts: object) -> fem.FibreReinforced:
    whole = {"matrix": fem.VolumetricK2(1.0), "fibres": FIBRES["guccione"], "directions": EYE[None]}
    return fem.FibreReinforced(**(whole | parts))
