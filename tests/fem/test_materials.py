"""Laws of all materials: tabulated stresses, closed forms, invariance, Hooke."""

import math
from dataclasses import dataclass
from itertools import cycle

import pytest
import torch
from laws import HOOKEAN, ISOTROPIC, LAWS
from scipy.optimize import brentq
from torch import Tensor
from torch.testing import assert_close

from benchmarks.verification.uniaxial import LAWS as TABULATED
from benchmarks.verification.uniaxial import STRETCHES, UNIAXIAL
from dpl import fem
from dpl.fem.materials.tensors import green_lagrange, volume_change

SVK, NH, SNH = fem.SaintVenantKirchhoff(0.3), fem.NeoHookeanLn(0.3), fem.StableNeoHookean(0.3)
EYE = torch.eye(3, dtype=torch.float64)
SHEAR = torch.zeros(3, 3, dtype=torch.float64).index_put_(
    (torch.tensor(0), torch.tensor(1)), torch.tensor(1.0, dtype=torch.float64)
)
MORE = {  # laws and parts of laws beside those of conf/material
    "demiray": fem.DemirayK2(0.3, 2.0, 5.0),
    "volumetric_k4": fem.VolumetricK4(5.0),
    "one_family": fem.FibreReinforced(
        fem.VolumetricK2(3.0),
        fem.HolzapfelGasserOgdenFibres(0.5, 2.0, 0.2, 0.6, families=1),
        fem.ConstantFibres([1.0, 2.0, -0.5], [0.3, -1.0, 0.4]),
    ),
}


@dataclass(frozen=True)
class EnergyAlone(fem.Material):
    """A law of which nothing is known but its energy: derivatives by autodiff."""

    law: fem.Material

    def energy(self, H):
        return self.law.energy(H)


CONFINED = {  # P11 and P22 at a stretch of 0.6 and of 1.4
    "SVK": [(-0.25846154, -0.18461538), (0.90461538, 0.27692308)],
    "NH-ln": [(-0.90143489, -0.29470709), (0.40239241, 0.1941186)],
    "NHiso-k2": [(-0.71780406, -0.084658781), (0.47382802, 0.36832039)],
    "NHiso-k4": [(-0.82891518, -0.15132545), (0.42620897, 0.30165372)],
    "SNH": [(-0.52747253, -0.085958486), (0.54755997, 0.37353184)],
    "Mooney-Rivlin": [(-1.2404064, -0.34787808), (0.93877454, 1.0228578)],
    "Yeoh": [(-1.1774821, -0.36675538), (0.94160919, 1.0208736)],
    "Ogden": [(-1.2346369, -0.34960893), (0.95766777, 1.0096326)],
}
SIMPLE_SHEAR = {  # P12, P21, P11 = P22, P33 at a shear of 1
    "SVK": (1.0576923, 0.38461538, 0.67307692, 0.28846154),
    "NH-ln": (0.38461538, 0.38461538, 0.0, 0.0),
    "NHiso-k2": (0.38461538, 0.51282051, -0.12820513, -0.12820513),
    "NHiso-k4": (0.38461538, 0.51282051, -0.12820513, -0.12820513),
    "SNH": (0.41025641, 0.38461538, 0.025641026, 0.025641026),
    "Mooney-Rivlin": (0.4, 0.56666667, -0.16666667, -0.066666667),
    "Yeoh": (0.35, 0.46666667, -0.11666667, -0.11666667),
    "Ogden": (0.49219584, 0.64932677, -0.15713093, -0.17793398),
}


def digits(printed: float, count: int = 8):
    """Return what equals any number that rounds to the printed one."""
    if printed == 0:
        return pytest.approx(0, abs=1e-14)
    unit = 10.0 ** (math.floor(math.log10(abs(printed))) - count + 1)
    return pytest.approx(printed, rel=0, abs=0.5001 * unit)


def diagonal(*entries: float) -> Tensor:
    """Return a diagonal matrix (3, 3)."""
    return torch.diag(torch.tensor(entries, dtype=torch.float64))


def principal(law: fem.Material, *stretches: float) -> list[float]:
    """Return the principal stresses P11, P22, P33 of principal stretches."""
    return law.stress(diagonal(*stretches) - EYE).diag().tolist()


def uniaxial(law: fem.Material, stretch: float, low: float = 0.05, high: float = 5.0):
    """Return the lateral stretch, between two bounds, that leaves the sides free, and P11."""
    side = brentq(lambda s: principal(law, stretch, s, s)[1], low, high, xtol=1e-15, rtol=1e-15)
    return side, principal(law, stretch, side, side)[0]


@pytest.fixture(params=HOOKEAN)
def hookean(request) -> type[fem.YoungPoissonMaterial]:
    """Each law that at rest is Hooke's."""
    return request.param


@pytest.fixture(params=LAWS | MORE)
def law(request) -> fem.Material:
    """Each of all laws."""
    return (LAWS | MORE)[request.param]


@pytest.fixture
def finite(law) -> fem.Material:
    """Each law of large rotations."""
    if isinstance(law, fem.LinearElastic):
        pytest.skip("holds for small rotations only")
    return law


@pytest.fixture
def without_fibres(law) -> None:
    """Skip laws with fibres, which test_fibre_materials.py tests."""
    if isinstance(law, fem.FibreReinforced):
        pytest.skip("holds for isotropic laws only")


@pytest.fixture
def gradients() -> Tensor:
    """Displacement gradients of uninverted F, far from rest."""
    random = torch.Generator().manual_seed(0)
    H = torch.rand(20, 3, 3, generator=random, dtype=torch.float64) * 0.5 - 0.25
    assert (volume_change(H) > -0.9).all()
    return H


@pytest.fixture
def rotation() -> Tensor:
    """A rotation about no special axis."""
    axis = torch.tensor([0.3, -0.7, 0.5], dtype=torch.float64)
    return torch.matrix_exp(torch.linalg.cross(EYE, axis.expand(3, 3)))


@pytest.mark.parametrize("name", UNIAXIAL)
def test_uniaxial_tension_has_the_tabulated_lateral_stretch_and_stress(name):
    stresses, sides = ([*map(float, text.split())] for text in UNIAXIAL[name])
    for stretch, lateral, stress in zip(STRETCHES, sides, stresses, strict=True):
        side, axial = uniaxial(TABULATED[name], stretch, 0.8 * lateral, 1.2 * lateral)
        assert side == digits(lateral)
        assert axial == digits(stress)


@pytest.mark.parametrize("name", ISOTROPIC)
def test_young_is_the_slope_of_a_tensile_test(name):
    law, strain = LAWS[name], 1e-6
    side, axial = uniaxial(law, 1 + strain, 1 - 0.6 * strain, 1.0)
    assert axial / strain == pytest.approx(1, rel=1e-5)
    assert (1 - side) / strain == pytest.approx(float(law.poisson_ratio), rel=1e-5)


def test_constants_in_pascal_give_stresses_in_pascal():
    """Treloar (1944), Trans. Faraday Soc. 40: nominal stress in tension; law of Ogden (1972)."""
    law = fem.OgdenK2([4.095e5, 3e3, 1e4], [1.3, 5.0, -2.0], poisson=0.4999)
    assert law.mu == pytest.approx(4.225e5)
    for stretch, stress in ((1.24, 0.23e6), (2.18, 0.58e6), (3.02, 0.85e6), (5.36, 1.94e6)):
        assert uniaxial(law, stretch, 0.3, 1.0)[1] == pytest.approx(stress, rel=0.15)
    young = law.young_at_rest
    assert young == pytest.approx(2 * 4.225e5 * 1.4999)
    one = law.over(young)
    for stretch in STRETCHES:
        over = [young * P for P in principal(one, stretch, 1.1, 0.9)]
        assert principal(law, stretch, 1.1, 0.9) == pytest.approx(over, rel=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: fem.YeohK2(0.2, 0.0, 0.0), "bulk or poisson must be given.*none is"),
        (lambda: fem.YeohK2(0.2, 0.0, 0.0, 2.0, 0.3), "the other be null; both are"),
        (lambda: fem.OgdenK2([1.0], [2.0], poisson=0.5), "poisson = 0.5 must lie between"),
        (lambda: EnergyAlone(NH).over(2.0), "EnergyAlone are over Young's modulus; set young"),
        (lambda: fem.VolumetricK2(1.0).young_at_rest, "at rest = 0.0 must be above 0"),
        (lambda: fem.NeoHookeanLn(fem.CellField([0.3])).young_at_rest, "poisson is a field"),
    ],
)
def test_moduli_without_a_unit_or_a_value_are_an_error(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("name", CONFINED)
def test_confined_stretch_has_the_tabulated_stresses(name):
    for stretch, (P11, P22) in zip((0.6, 1.4), CONFINED[name], strict=True):
        found = principal(TABULATED[name], stretch, 1.0, 1.0)
        assert found == [digits(P11), digits(P22), digits(P22)]


@pytest.mark.parametrize("name", SIMPLE_SHEAR)
def test_simple_shear_has_the_tabulated_stresses(name):
    P12, P21, P11, P33 = SIMPLE_SHEAR[name]
    P = TABULATED[name].stress(SHEAR).tolist()
    assert [P[0][1], P[1][0]] == [digits(P12), digits(P21)]
    assert [P[0][0], P[1][1], P[2][2]] == [digits(P11), digits(P11), digits(P33)]
    assert [P[0][2], P[1][2], P[2][0], P[2][1]] == [pytest.approx(0, abs=1e-15)] * 4


@pytest.mark.parametrize(
    ("law", "printed"),
    [
        (
            fem.SaintVenantKirchhoff(0.25),
            [401316, 145696, -98546, 109033, 127627, 126699, -99618.4, 116577.6, 267958],
        ),
        (
            fem.NeoHookeanLn(0.25),
            [
                *[205618.06845586, 97900.28180473, -61907.80758191],
                *[81983.06535369, 29475.07868947, 102746.94162323],
                *[-65396.04814315, 97426.15125187, 138099.72478590],
            ],
        ),
        (
            fem.NeoHookeanIsoK4(0.25),
            [
                *[191096.15853363, 85520.54615522, -53689.81488467],
                *[69887.02053818, 38843.51112474, 88872.72329322],
                *[-56337.72372917, 83943.20715009, 132673.96472219],
            ],
        ),
    ],
    ids=["saint_venant_kirchhoff", "neo_hookean_ln", "neo_hookean_iso_k4"],
)
def test_general_deformation_has_the_tabulated_stress(law, printed):
    """Compare with an independent code at a general F, E = 1e6."""
    F = torch.tensor(
        [[1.2, 0.2, -0.1], [0.05, 0.95, 0.15], [-0.08, 0.12, 1.1]], dtype=torch.float64
    )
    assert (1e6 * law.stress(F - EYE)).flatten().tolist() == pytest.approx(printed, rel=1e-12)


def test_stress_is_the_slope_of_the_energy(law, gradients):
    expected = EnergyAlone(law).stress(gradients)
    assert_close(law.stress(gradients), expected, rtol=1e-11, atol=1e-13)


def test_tangent_is_the_curvature_of_the_energy(law, gradients):
    """At states of distinct principal stretches: elsewhere Ogden's energy has no Hessian."""
    expected = EnergyAlone(law).tangent(gradients)
    assert_close(law.tangent(gradients), expected, rtol=1e-9, atol=1e-11)


@pytest.mark.usefixtures("without_fibres")
@pytest.mark.parametrize(
    "stretches",
    [(1.0, 1.0, 1.0), (1.3, 1.3, 1.3), (1.4, 0.9, 0.9), (1.2, 1.2 + 3e-7, 0.8)],
    ids=str,
)
def test_coinciding_stretches_are_no_exception(law, gradients, rotation, stretches):
    """Principal axes are not unique there: the limit takes the place of the quotients."""
    turned = rotation @ diagonal(*stretches) @ rotation.T
    H, direction = turned - EYE, gradients[0]
    slope = (law.stress(H + 1e-5 * direction) - law.stress(H - 1e-5 * direction)) / 2e-5
    product = torch.einsum("ijkl,kl->ij", law.tangent(H), direction)
    assert_close(product, slope, rtol=0, atol=2e-8)
    exact = torch.func.jvp(law.stress, (H,), (direction,))[1]
    assert_close(exact, product, rtol=0, atol=2e-6)


def test_stress_can_be_differentiated_at_rest(law, gradients):
    """By tangents and by gradients; eigenvectors would make them NaN."""
    rest, v, w = torch.zeros(3, 3, dtype=torch.float64), gradients[0], gradients[1]
    along = torch.func.jvp(law.stress, (rest,), (v,))[1]
    back = torch.func.grad(lambda H: (law.stress(H) * w).sum())(rest)
    hooke = torch.einsum("ijkl,kl->ij", law.tangent(rest), v)
    assert_close(along, hooke, rtol=1e-12, atol=1e-14)
    assert_close((back * v).sum(), (hooke * w).sum(), rtol=1e-12, atol=1e-14)


def test_rotated_body_feels_the_rotated_stress(finite, gradients, rotation):
    turned = rotation @ (EYE + gradients) - EYE
    expected = rotation @ finite.stress(gradients)
    assert_close(finite.stress(turned), expected, rtol=1e-11, atol=1e-12)
    assert_close(finite.energy(turned), finite.energy(gradients), rtol=1e-12, atol=1e-13)


@pytest.mark.usefixtures("without_fibres")
def test_material_has_no_preferred_direction(law, gradients, rotation):
    """Body and load turned alike: true for the linear law too."""
    turned = rotation @ gradients @ rotation.T
    expected = rotation @ law.stress(gradients) @ rotation.T
    assert_close(law.stress(turned), expected, rtol=1e-11, atol=1e-12)
    assert_close(law.energy(turned), law.energy(gradients), rtol=1e-12, atol=1e-13)


def test_body_at_rest_has_neither_energy_nor_stress(law):
    """Only the energy of SNH at rest is not zero; differences of the energy matter alone."""
    rest = torch.zeros(3, 3, dtype=torch.float64)
    energy = law.energy(rest).item()
    assert energy == (digits(-0.2730425102, 10) if isinstance(law, fem.StableNeoHookean) else 0)
    assert not law.stress(rest).any()
    if not isinstance(law, fem.OgdenK2):  # its gradient at equal stretches is not defined
        assert EnergyAlone(law).stress(rest).abs().max() < 1e-15


@pytest.mark.parametrize(
    ("law", "ratio"),
    [
        (fem.NeoHookeanLn(0.4999), 0.0),
        (fem.YeohK2(0.2, -0.02, 0.005, bulk=4e4), 0.0),
        (fem.Heterogeneous({"soft": fem.OgdenK2([1.0], [2.0], poisson=0.49)}, {}), 0.0),
        (fem.NeoHookeanLn(0.45), 0.45),
        (fem.NeoHookeanLn((0.2, 0.49)), 0.49),
    ],
)
def test_a_nearly_incompressible_law_becomes_compressible(law, ratio):
    """Laws of other bodies, and those with a range, stay as they are."""
    found = law.compressible()
    laws = found.parts.values() or [found]
    assert max(one.largest_poisson_ratio for one in laws) == pytest.approx(ratio, abs=1e-12)
    assert found.compressible() is found


@pytest.mark.parametrize("poisson", [-0.9, 0.0, 0.3, 0.4999])
def test_tangent_at_rest_is_hooke(hookean, poisson):
    law, rest = hookean(poisson), torch.zeros(3, 3, dtype=torch.float64)
    hooke = law.lam * torch.einsum("ij,kl->ijkl", EYE, EYE)
    hooke += law.mu * torch.einsum("ik,jl->ijkl", EYE, EYE)
    hooke += law.mu * torch.einsum("il,jk->ijkl", EYE, EYE)
    size = hooke.abs().max().item()
    assert_close(law.tangent(rest), hooke, rtol=0, atol=1e-14 * size)
    assert_close(EnergyAlone(law).tangent(rest), hooke, rtol=0, atol=1e-13 * size)


@pytest.mark.usefixtures("without_fibres")
def test_moduli_at_rest_are_those_of_the_tangent(law):
    """Young's modulus need not be 1: MR and Yeoh have a shear modulus of 0.4, Ogden of 0.42."""
    A = law.tangent(torch.zeros(3, 3, dtype=torch.float64))
    assert law.mu == pytest.approx(A[0, 1, 0, 1].item(), rel=1e-14)
    assert law.lam == pytest.approx(A[0, 0, 1, 1].item(), rel=1e-14)
    ratio = float(law.lam / (2 * (law.lam + law.mu)))
    assert law.poisson_ratio == pytest.approx(ratio, rel=1e-14)


@pytest.mark.usefixtures("without_fibres")
@pytest.mark.parametrize("size", [1e-10, 1e-14])
def test_tiny_gradients_keep_the_digits_of_hooke(law, gradients, size):
    """With F = I + H a strain of 1e-10 would keep six digits."""
    H = size * gradients
    strain = (H + H.mT) / 2
    volume = strain.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
    hooke = law.lam * volume * EYE + 2 * law.mu * strain
    scale = hooke.flatten(1).norm(dim=1)
    error = (law.stress(H) - hooke).flatten(1).norm(dim=1) / scale
    assert error.max() < 1e-9


def test_saint_venant_is_blind_to_reflection_and_lets_a_body_collapse():
    mirrored = diagonal(-2.0, 0.0, 0.0)
    assert SVK.energy(mirrored) == 0
    assert not SVK.stress(mirrored).any()
    assert SVK.energy(-EYE).item() == pytest.approx(0.9375, rel=1e-12)
    assert SVK.stress(-EYE).isfinite().all()


def test_neo_hookean_is_infinite_at_zero_volume_and_undefined_below():
    flat = diagonal(-1.0, 0.0, 0.0)
    assert NH.energy(flat) == math.inf
    assert NH.energy(2 * flat).isnan()
    assert NH.stress(2 * flat).isnan().any()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_ogden_has_no_stress_where_there_is_no_strain(bad):
    """Its eigenvalues do not exist; the points beside it have theirs."""
    law, H = TABULATED["Ogden"], torch.zeros(3, 3, 3, dtype=torch.float64)
    H[0, 0, 0], H[1, 2, 1] = 0.1, bad
    for quantity in (law.energy, law.stress, law.tangent):
        found = quantity(H).reshape(3, -1)
        assert found[1].isnan().any()
        assert found[0].isfinite().all()
        assert torch.equal(found[[0, 2]], quantity(H[[0, 2]]).reshape(2, -1))


@pytest.mark.parametrize(
    ("stretches", "energy"),
    [((0.0, 0.0, 0.0), 0.1465201465), ((-1.0, 1.0, 1.0), 2.291060054), ((1, 1, 1), -0.2730425102)],
)
def test_stable_neo_hookean_is_finite_everywhere(stretches, energy):
    """The states are collapsed, reflected and at rest."""
    assert SNH.energy(diagonal(*stretches) - EYE).item() == digits(energy, 10)


def test_inverted_body_of_stable_neo_hookean_has_the_slope_of_its_energy_as_stress(gradients):
    H = diagonal(-2.0, 0.0, 0.0) + 0.5 * gradients
    assert (volume_change(H) < -1.5).all()
    assert_close(SNH.stress(H), EnergyAlone(SNH).stress(H), rtol=1e-12, atol=1e-13)


def test_response_is_the_first_stress_pulled_back(finite, gradients):
    """S = F^-1 P, as a function of the Green-Lagrange strain alone."""
    S = finite.response(green_lagrange(gradients)).stress
    P = EnergyAlone(finite).stress(gradients)
    assert_close((EYE + gradients) @ S, P, rtol=1e-10, atol=1e-12)
    assert_close(S, S.mT, rtol=1e-12, atol=1e-13)


def test_linear_law_is_hooke_at_any_gradient(gradients, laws):
    """No strain is too large for it, no rotation too small to be felt."""
    law = laws["linear_elastic"]
    strain = (gradients + gradients.mT) / 2
    volume = strain.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
    assert_close(law.stress(gradients), law.lam * volume * EYE + 2 * law.mu * strain)
    assert_close(law.tangent(gradients), law.tangent(0 * gradients), rtol=0, atol=0)
    assert not law.has_response


def test_a_law_says_what_it_has_not():
    assert SVK.has_response
    assert not fem.Material().has_response
    calls = fem.Material().response, fem.Material().energy, fem.InvariantBasedMaterial().stress
    for call in calls:
        with pytest.raises(NotImplementedError):
            call(0.1 * EYE)


# ------------------------------------------------------------------ a batch of Poisson's ratios


@dataclass(frozen=True)
class SoleEnergy(fem.YoungPoissonMaterial):
    """The energy of NH-ln with a Poisson's ratio for each member of a batch, and nothing else."""

    def energy(self, H):
        return fem.NeoHookeanLn(self.poisson).energy(H)


RATIOS = torch.tensor([-0.3, 0.0, 0.2, 0.3, 0.45], dtype=torch.float64)


@pytest.mark.parametrize("kind", [*HOOKEAN, SoleEnergy])
def test_members_of_a_batch_answer_as_bodies_with_their_own_poissons_ratio(kind, gradients):
    """H is (B, E, Q, 3, 3), and each member's ratio holds in all of its cells and points."""
    H = gradients.reshape(5, 2, 2, 3, 3)
    ranged = kind([-0.3, 0.45])
    whole = ranged.with_parameters(RATIOS[:, None])
    assert whole.value("poisson").shape == (5, 1, 1)
    for k, ratio in enumerate(RATIOS.tolist()):
        one = ranged.with_parameters(RATIOS[k].view(1, 1))
        assert one == kind(ratio)
        assert_close(whole.energy(H)[k], one.energy(H[k]), rtol=1e-12, atol=1e-15)
        assert_close(whole.stress(H)[k], one.stress(H[k]), rtol=1e-12, atol=1e-14)
        if kind is not SoleEnergy:
            assert_close(whole.tangent(H)[k], one.tangent(H[k]), rtol=1e-12, atol=1e-13)
        if whole.has_response and kind is not SoleEnergy:
            E = green_lagrange(H)
            found, wanted = whole.response(E), one.response(E[k])
            assert_close(found.stress[k], wanted.stress, rtol=1e-12, atol=1e-14)
            assert_close(found.moduli[k], wanted.moduli, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("span", [(0.2, 0.4), [-0.999, 0.499], [0, 0.4]])
def test_a_law_with_a_range_says_so_and_has_no_moduli(span):
    law = fem.NeoHookeanLn(span)
    assert law.parameter_ranges == {"poisson": tuple(span)}
    assert all(isinstance(end, float) for end in law.parameter_ranges["poisson"])
    for modulus in ("mu", "lam", "bulk_modulus", "poisson_ratio"):
        with pytest.raises(ValueError, match=r"poisson = .* is a range"):
            getattr(law, modulus)


def test_a_law_of_numbers_has_no_ranges_and_takes_no_parameters(law):
    assert law.parameter_ranges == {}
    assert law.with_parameters(torch.zeros(3, 0)) is law
    with pytest.raises(ValueError, match=r"has ranges of \[\]"):
        law.with_parameters(torch.tensor([[0.3]]))


# ------------------------------------------------------------------ shapes, precision, extremes


def test_a_gradient_alone_is_answered_like_one_of_a_batch(law, gradients):
    H = gradients.reshape(5, 2, 2, 3, 3)
    for quantity, axes in ((law.energy, 0), (law.stress, 2), (law.tangent, 4)):
        found = quantity(H)
        assert found.shape == (5, 2, 2, *[3] * axes)
        assert_close(found[3, 1, 0], quantity(H[3, 1, 0]), rtol=1e-12, atol=1e-13)


def test_single_precision_stays_single_and_is_as_exact(law, gradients):
    for quantity in (law.energy, law.stress, law.tangent):
        single, double = quantity(gradients.float()), quantity(gradients)
        assert single.dtype == torch.float32
        size = double.abs().max().item()
        assert_close(single.double(), double, rtol=0, atol=1e-4 * size)


def test_moduli_may_be_negative_where_the_body_still_resists():
    """Only the shear and the bulk modulus at rest have a sign."""
    assert fem.MooneyRivlinK2(0.2, -0.1, 2.0).mu == pytest.approx(0.2)
    assert fem.YeohK2(0.2, -0.1, -0.1, 2.0).mu == pytest.approx(0.4)
    assert fem.OgdenK2([0.3, -0.1], [2.0, -2.0], 0.5).mu == pytest.approx(0.2)
    assert fem.OgdenK2([0.3], [2.0], 0.5).lam + 2 / 3 * 0.3 == pytest.approx(0.5)


RATIO, RANGE = "poisson = .* must lie between", "poisson = .* must be a range"
RATIOS_OUT = [-1.0, 0.5, 0.7, -3.0, math.nan, math.inf, -math.inf]
ENDS_OUT = [[-1.0, 0.3], [0.2, 0.5], [-2.0, 0.3], [0.2, 0.6]]
NO_RANGES = [[0.4, 0.2], [0.3, 0.3], [], [0.2], [0.1, 0.2, 0.3], [math.nan, 0.3], [0.2, math.nan]]
INVALID = [
    *((kind, (bad,), RATIO) for kind, bad in zip(cycle(HOOKEAN), RATIOS_OUT + ENDS_OUT)),
    *((kind, (bad,), RANGE) for kind, bad in zip(cycle(HOOKEAN), NO_RANGES)),
    (fem.MooneyRivlinK2, (0.1, -0.1, 2.0), "c10"),
    (fem.MooneyRivlinK2, (0.1, -0.2, 2.0), "c10"),
    (fem.MooneyRivlinK2, (math.nan, 0.1, 2.0), "c10"),
    (fem.MooneyRivlinK2, (0.1, math.inf, 2.0), "c01"),
    (fem.MooneyRivlinK2, (0.1, 0.1, 0.0), "bulk"),
    (fem.MooneyRivlinK2, (0.1, 0.1, math.inf), "bulk"),
    (fem.YeohK2, (0.0, 0.1, 0.1, 2.0), "c10"),
    (fem.YeohK2, (-0.1, 0.1, 0.1, 2.0), "c10"),
    (fem.YeohK2, (0.2, math.nan, 0.1, 2.0), "c20 = nan must be a number"),
    (fem.YeohK2, (0.2, 0.1, math.inf, 2.0), "c30 = inf must be a number"),
    (fem.YeohK2, (0.2, 0.1, 0.1, -2.0), "bulk"),
    (fem.YeohK2, (0.2, 0.1, 0.1, math.nan), "bulk"),
    (fem.OgdenK2, ([0.1, 0.2], [1.3], 2.0), "exponents"),
    (fem.OgdenK2, ([0.1], [1.3, 2.0], 2.0), "exponents"),
    (fem.OgdenK2, ([0.1, 0.2], [1.3, 0.0], 2.0), "exponents"),
    (fem.OgdenK2, ([0.1], [math.nan], 2.0), "exponents"),
    (fem.OgdenK2, ([0.1, -0.2], [1.3, 2.0], 2.0), "shear"),
    (fem.OgdenK2, ([], [], 2.0), "shear"),
    (fem.OgdenK2, ([0.1], [2.0], math.inf), "bulk"),
]


@pytest.mark.parametrize(("kind", "constants", "message"), INVALID)
def test_invalid_constants_are_an_error(kind, constants, message):
    with pytest.raises(ValueError, match=message):
        kind(*constants)


@pytest.mark.parametrize(
    "ratios", [[0.5], [-1.0, 0.3], [0.3, 0.5], [0.3, math.nan], [0.3, 0.7], [-2.0, 0.3]]
)
def test_parameters_that_the_law_refuses_are_an_error(ratios):
    with pytest.raises(ValueError, match=RATIO):
        fem.NeoHookeanLn([0.2, 0.4]).with_parameters(torch.tensor(ratios).double()[:, None])


@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-9, 1e-7, 3e-7, 3e-6, 1e-5])
def test_ogden_is_continuous_where_stretches_meet(gap, rotation):
    """The quotient of stresses and its limit give the same tangent on either side of 1e-6."""
    law = TABULATED["Ogden"]
    E = rotation @ diagonal(0.2, 0.2 + gap, -0.1) @ rotation.mT
    D = law.response(E).moduli
    change = torch.tensor([[0.3, 0.1, -0.2], [0.1, -0.4, 0.5], [-0.2, 0.5, 0.2]]).double()
    ahead, behind = (law.response(E + h * change).stress for h in (1e-4, -1e-4))
    slope = (ahead - behind) / 2e-4
    found = torch.einsum("ijkl,kl->ij", D, change)
    assert_close(found, slope, rtol=0, atol=1e-6 * slope.abs().max().item())


@pytest.mark.parametrize("J", [-0.5, -1e-3, -2.0])
def test_ogdens_stress_is_not_a_number_where_a_body_is_inverted(J):
    law = fem.OgdenK2(shear=[0.4], exponents=[1.5], bulk=2.0)
    assert law.stress(diagonal(J, 1.0, 1.0) - EYE).isnan().all()
