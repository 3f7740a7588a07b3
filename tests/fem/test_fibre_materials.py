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
# frames whose fibre f lies along or across the first axis; the sheet lies in the plane of 1 and 2
ALONG = EYE
ACROSS = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]).double()
NORMAL = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]).double()


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
    q = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    w, x, y, z = (q / q.norm(dim=1, keepdim=True)).unbind(1)  # quaternions
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, 1).unflatten(1, (3, 3))


def assert_near(found: Tensor, wanted: Tensor, tolerance: float) -> None:
    """Assert equality relative to the largest entry."""
    assert_close(found, wanted, rtol=0, atol=tolerance * wanted.abs().max().item())


# ------------------------------------------------------------------ derivatives


# ------------------------------------------------------------------ invariance


def test_rotating_fibres_and_body_rotates_the_stress(law, gradients, generator):
    R = rotations(1, generator)[0]
    twin = fem.FibreReinforced(law.matrix, law.fibres, R @ law.frames)
    turned = R @ gradients @ R.mT
    assert_close(twin.energy(turned), law.energy(gradients), rtol=1e-12, atol=1e-14)
    assert_near(twin.stress(turned), R @ law.stress(gradients) @ R.mT, 1e-12)
    A = torch.einsum("ia,Jb,kc,Ld,...abcd->...iJkL", R, R, R, R, law.tangent(gradients))
    assert_near(twin.tangent(turned), A, 1e-12)


def test_each_cell_has_its_own_frame(law, gradients):
    """Cells are at axis -4 of H; one frame for all cells takes any H."""
    one = law.of_cells(torch.tensor([3]))
    assert one.frames.shape == (1, 3, 3)
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
    Q = law.frames[:, None]
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


# ------------------------------------------------------------------ closed forms


def second_stress(fibres: fem.FibreEnergy, frame: Tensor, F: Tensor) -> list[float]:
    """Return S11, S22, S33 and S12 of an isochoric F, of the fibres alone."""
    assert torch.linalg.det(F).item() == pytest.approx(1, rel=1e-12)
    law = fem.FibreReinforced(fem.VolumetricK2(1.0), fibres, frame[None])
    S = torch.linalg.solve(F, law.stress(F - EYE))
    assert S[[0, 1], 2].abs().max() < 1e-14
    return [S[0, 0].item(), S[1, 1].item(), S[2, 2].item(), S[0, 1].item()]


def stretch(*stretches: float) -> Tensor:
    return torch.diag(torch.tensor(stretches, dtype=torch.float64))


def shear(amount: float) -> Tensor:
    F = EYE.clone()
    F[0, 1] = amount
    return F


def values(*stresses: float) -> list:
    return [pytest.approx(s, rel=1e-11, abs=1e-13) for s in stresses]


STRETCH, SHEAR = 1.2, 0.4
UNIAXIAL = stretch(STRETCH, STRETCH**-0.5, STRETCH**-0.5)
EQUIBIAXIAL = stretch(STRETCH, STRETCH, STRETCH**-2)
LONG, SHORT, THIN = STRETCH**2 - 1, 1 / STRETCH - 1, STRETCH**-4 - 1  # C - 1


def test_guccione_has_the_closed_forms():
    """S_ij = c b_ij E_ij exp(Q), b the exponent of each component: Guccione et al. (1991)."""
    c, bf, bt, bfs = 0.4, 8.0, 2.0, 4.0
    fibres, long, short, thin = fem.Guccione(c, bf, bt, bfs), LONG / 2, SHORT / 2, THIN / 2
    f = c * math.exp(bf * long**2 + 2 * bt * short**2)
    assert second_stress(fibres, ALONG, UNIAXIAL) == values(
        f * bf * long, f * bt * short, f * bt * short, 0
    )
    f = c * math.exp(bt * long**2 + (bf + bt) * short**2)
    assert second_stress(fibres, ACROSS, UNIAXIAL) == values(
        f * bt * long, f * bf * short, f * bt * short, 0
    )
    f = c * math.exp((bf + bt) * long**2 + bt * thin**2)
    assert second_stress(fibres, ALONG, EQUIBIAXIAL) == values(
        f * bf * long, f * bt * long, f * bt * thin, 0
    )
    f = c * math.exp(2 * bt * long**2 + bf * thin**2)
    assert second_stress(fibres, NORMAL, EQUIBIAXIAL) == values(
        f * bt * long, f * bt * long, f * bf * thin, 0
    )
    E12, E22 = SHEAR / 2, SHEAR**2 / 2
    f = c * math.exp(bt * E22**2 + 2 * bfs * E12**2)
    assert second_stress(fibres, ALONG, shear(SHEAR)) == values(0, f * bt * E22, 0, f * bfs * E12)
    f = c * math.exp(bf * E22**2 + 2 * bfs * E12**2)
    assert second_stress(fibres, ACROSS, shear(SHEAR)) == values(0, f * bf * E22, 0, f * bfs * E12)


def test_families_have_the_closed_forms():
    """S = sum of 2 k1 E_i exp(k2 E_i^2) (kappa I + (1 - 3 kappa) a_i x a_i): Gasser et al."""
    k1, k2, kappa, angle = 0.5, 2.0, 0.1, 0.8
    fibres = fem.HolzapfelGasserOgdenFibres(k1, k2, kappa, angle)
    cos, sin, axial = math.cos(angle), math.sin(angle), 1 - 3 * kappa

    def factor(E: float) -> float:
        assert E > 0
        return 2 * k1 * E * math.exp(k2 * E**2)

    def both(f: float, *squares: float) -> list:
        """Stress of two families of equal strain; the shear of the two cancels."""
        return values(*(2 * f * (kappa + axial * square) for square in squares), 0)

    trace = LONG + 2 * SHORT
    f = factor(kappa * trace + axial * (cos**2 * LONG + sin**2 * SHORT))
    assert second_stress(fibres, ALONG, UNIAXIAL) == both(f, cos**2, sin**2, 0)
    f = factor(kappa * trace + axial * (sin**2 * LONG + cos**2 * SHORT))
    assert second_stress(fibres, ACROSS, UNIAXIAL) == both(f, sin**2, cos**2, 0)
    trace = 2 * LONG + THIN
    f = factor(kappa * trace + axial * LONG)
    assert second_stress(fibres, ALONG, EQUIBIAXIAL) == both(f, cos**2, sin**2, 0)
    f = factor(kappa * trace + axial * (sin**2 * LONG + cos**2 * THIN))
    assert second_stress(fibres, NORMAL, EQUIBIAXIAL) == both(f, sin**2, 0, cos**2)
    for frame, first, second in ((ALONG, cos, sin), (ACROSS, sin, cos)):
        sheared, normal = axial * 2 * SHEAR * cos * sin, (kappa + axial * second**2) * SHEAR**2
        assert normal - sheared < 0  # one family is shortened
        f = factor(normal + sheared)
        diagonal = (f * (kappa + axial * part) for part in (first**2, second**2, 0))
        wanted = values(*diagonal, f * axial * cos * sin)
        assert second_stress(fibres, frame, shear(SHEAR)) == wanted
        one = fem.HolzapfelGasserOgdenFibres(k1, k2, kappa, angle, families=1)
        assert second_stress(one, frame, shear(SHEAR)) == wanted
        assert second_stress(one, frame, shear(-SHEAR)) == [0, 0, 0, 0]


def test_holzapfel_ogden_has_the_closed_forms():
    """S = 2 a <x> exp(b <x>^2) of fibres and sheets; S12 = afs C12 exp(bfs C12^2), (2009)."""
    fibres = fem.HolzapfelOgdenFibres(0.5, 2.0, 0.3, 3.0, 0.2, 1.5)

    def fibre(x: float) -> float:
        return 2 * 0.5 * x * math.exp(2.0 * x**2)

    def sheet(x: float) -> float:
        return 2 * 0.3 * x * math.exp(3.0 * x**2)

    sheared = 0.2 * SHEAR * math.exp(1.5 * SHEAR**2)
    assert second_stress(fibres, ALONG, UNIAXIAL) == values(fibre(LONG), 0, 0, 0)
    assert second_stress(fibres, ACROSS, UNIAXIAL) == values(sheet(LONG), 0, 0, 0)
    assert second_stress(fibres, NORMAL, UNIAXIAL) == values(sheet(LONG), 0, 0, 0)
    assert second_stress(fibres, ALONG, EQUIBIAXIAL) == values(fibre(LONG), sheet(LONG), 0, 0)
    assert second_stress(fibres, NORMAL, EQUIBIAXIAL) == values(sheet(LONG), 0, 0, 0)
    found = second_stress(fibres, ALONG, shear(SHEAR))
    assert found == values(0, sheet(SHEAR**2), 0, sheared)
    found = second_stress(fibres, ACROSS, shear(SHEAR))
    assert found == values(0, fibre(SHEAR**2), 0, sheared)


@pytest.mark.parametrize("name", ["two_families", "one_family", "holzapfel_ogden"])
def test_shortened_fibres_have_neither_stress_nor_stiffness(name):
    H = stretch(0.9, 0.95, 0.99) - EYE
    law = fem.FibreReinforced(MATRICES[name], FIBRES[name], EYE[None])
    assert law.energy(H) == law.matrix.energy(H)
    assert_close(law.stress(H), law.matrix.stress(H), rtol=0, atol=0)
    if name == "holzapfel_ogden":  # its shear resists either way
        law = fem.FibreReinforced(
            law.matrix, fem.HolzapfelOgdenFibres(0.5, 2, 0.3, 3, 0.0, 1), EYE[None]
        )
    assert_close(law.tangent(H), law.matrix.tangent(H), rtol=0, atol=0)


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
    sigma = law.stress(UNIAXIAL - EYE) @ UNIAXIAL.mT
    wanted = 0.3 * (LONG - SHORT) * math.exp(2.0 * (LONG + 2 * SHORT))
    assert (sigma[0, 0] - sigma[1, 1]).item() == pytest.approx(wanted, rel=1e-12)
    sigma = law.stress(shear(SHEAR) - EYE) @ shear(SHEAR).mT
    wanted = 0.3 * SHEAR * math.exp(2.0 * SHEAR**2)
    assert sigma[0, 1].item() == pytest.approx(wanted, rel=1e-12)
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
        assert law.stress(shear(SHEAR) - EYE).abs().max() < 1e-14
        assert (law.mu, law.lam) == (0, pytest.approx(5.0))


# ------------------------------------------------------------------ bodies, identity, errors


@pytest.mark.parametrize("name", FIBRES)
def test_forces_of_a_body_are_the_gradient_of_its_energy(name, generator):
    """Each point has the frame of its place."""
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
    twin = fem.FibreReinforced(law.matrix, law.fibres, law.frames.clone())
    assert twin == law
    assert hash(twin) == hash(law)
    assert isinstance(law.identity()["directions"], str)
    other = fem.FibreReinforced(law.matrix, law.fibres, rotations(5, generator))
    assert other != law
    assert other.identity() != law.identity()
    assert law.identity()["fibres"]["name"] == type(law.fibres).__name__
    spec = fem.FibreReinforced(law.matrix, law.fibres, fem.ConstantFibres([1.0, 0.0, 0.0]))
    assert spec.identity()["directions"] == {
        "name": "ConstantFibres",
        "fibre": [1.0, 0.0, 0.0],
        "sheet": None,
    }


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
        (lambda: fem.DemirayK2(0, 1, 1), "a = 0 must be above 0"),
        (lambda: fem.DemirayK2(1, 0, 1), "b = 0 must be a number above 0"),
        (lambda: fem.DemirayK2(1, 1, 0), "bulk = 0 must be above 0"),
        (lambda: fem.VolumetricK2(0), "bulk = 0 must be a number above 0"),
        (lambda: fem.VolumetricK4(math.inf), "bulk = inf must be a number above 0"),
        (lambda: reinforced(matrix=fem.LinearElastic(0.3)), "matrix = LinearElastic must be"),
        (lambda: reinforced(directions=torch.eye(3)), "must have .cells, 3, 3."),
        (
            lambda: reinforced(directions=2 * EYE[None]),
            "orthonormal .*; in 1 of 1 cells they do not",
        ),
        (lambda: reinforced(directions=math.nan * EYE[None]), "orthonormal columns"),
    ],
)
def test_invalid_constants_are_an_error(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def reinforced(**parts: object) -> fem.FibreReinforced:
    whole = {"matrix": fem.VolumetricK2(1.0), "fibres": FIBRES["guccione"], "directions": EYE[None]}
    return fem.FibreReinforced(**(whole | parts))
