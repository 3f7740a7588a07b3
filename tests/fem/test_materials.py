"""Laws of both materials: closed forms of VERIFICATION 1.2 to 1.4 and 1.11, invariance, Hooke."""

import math
from dataclasses import dataclass

import pytest
import torch
from scipy.optimize import brentq
from torch import Tensor
from torch.testing import assert_close

from dpl.fem.materials import (
    Material,
    NeoHookeanLn,
    SaintVenantKirchhoff,
    green_lagrange,
    volume_change,
)

SVK, NH = SaintVenantKirchhoff(0.3), NeoHookeanLn(0.3)
EYE = torch.eye(3, dtype=torch.float64)
SHEAR = torch.zeros(3, 3, dtype=torch.float64).index_put_(
    (torch.tensor(0), torch.tensor(1)), torch.tensor(1.0, dtype=torch.float64)
)


@dataclass(frozen=True)
class EnergyAlone(Material):
    """A law of which nothing is known but its energy: derivatives by autodiff."""

    law: Material

    def energy(self, H):
        return self.law.energy(H)


def digits(printed: float, count: int = 8):
    """Return what equals any number that rounds to the printed one."""
    if printed == 0:
        return pytest.approx(0, abs=1e-14)
    unit = 10.0 ** (math.floor(math.log10(abs(printed))) - count + 1)
    return pytest.approx(printed, rel=0, abs=0.5001 * unit)


def principal(law: Material, *stretches: float) -> list[float]:
    """Return the principal stresses P11, P22, P33 of principal stretches."""
    return (
        law.stress(torch.diag(torch.tensor(stretches, dtype=torch.float64)) - EYE).diag().tolist()
    )


def uniaxial(law: Material, stretch: float) -> tuple[float, float]:
    """Return the lateral stretch that leaves the sides free, and P11."""
    side = brentq(lambda s: principal(law, stretch, s, s)[1], 0.05, 5, xtol=1e-15, rtol=1e-15)
    return side, principal(law, stretch, side, side)[0]


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


@pytest.mark.parametrize(
    ("law", "stretch", "lateral", "stress"),
    [
        (SVK, 0.7, 1.0737784, -0.1785),
        (SVK, 0.9, 1.0281051, -0.0855),
        (SVK, 1.1, 0.9679876, 0.1155),
        (SVK, 1.5, 0.79056942, 0.9375),
        (SVK, 2.0, 0.31622777, 3.0),
        (NH, 0.7, 1.1079347, -0.40523042),
        (NH, 0.9, 1.0317024, -0.10872219),
        (NH, 1.1, 0.97149295, 0.093077432),
        (NH, 1.5, 0.88017459, 0.37828018),
        (NH, 2.0, 0.79807754, 0.64674466),
    ],
)
def test_uniaxial_tension_has_the_tabulated_lateral_stretch_and_stress(
    law, stretch, lateral, stress
):
    """VERIFICATION 1.2."""
    side, axial = uniaxial(law, stretch)
    assert side == digits(lateral)
    assert axial == digits(stress)


@pytest.mark.parametrize(("law", "cauchy"), [(SVK, 1.5), (NH, 0.48828786)])
def test_cauchy_stress_of_uniaxial_tension_is_tabulated(law, cauchy):
    """VERIFICATION 1.2, sigma11 = P11 / lateral^2 at a stretch of 1.5."""
    side, axial = uniaxial(law, 1.5)
    assert axial / side**2 == digits(cauchy)


@pytest.mark.parametrize("stretch", [0.7, 0.9, 1.1, 1.5])
@pytest.mark.parametrize("poisson", [0.0, 0.1, 0.3, 0.49])
def test_uniaxial_tension_follows_the_closed_form(poisson, stretch):
    """VERIFICATION 1.2, closed forms, tolerance 1e-8."""
    side, axial = uniaxial(SaintVenantKirchhoff(poisson), stretch)
    assert axial == pytest.approx(stretch * (stretch**2 - 1) / 2, rel=1e-8)
    assert side**2 == pytest.approx(1 - poisson * (stretch**2 - 1), rel=1e-8)
    law = NeoHookeanLn(poisson)
    side, axial = uniaxial(law, stretch)
    log_J = math.log(stretch * side**2)
    assert law.mu * (side - 1 / side) + law.lam * log_J / side == pytest.approx(0, abs=1e-13)
    assert axial == pytest.approx(
        law.mu * (stretch - 1 / stretch) + law.lam * log_J / stretch, rel=1e-8
    )


@pytest.mark.parametrize(
    ("law", "stretch", "thickness", "stress"),
    [
        (SVK, 0.8, 1.1439281, -0.20571429),
        (SVK, 1.3, 0.63919592, 0.64071429),
        (NH, 0.8, 1.187912, -0.37073795),
        (NH, 1.3, 0.77345679, 0.32300727),
    ],
)
def test_equibiaxial_tension_has_the_tabulated_thickness_and_stress(
    law, stretch, thickness, stress
):
    """VERIFICATION 1.3."""
    free = brentq(lambda s: principal(law, stretch, stretch, s)[2], 0.2, 5, xtol=1e-15, rtol=1e-15)
    assert free == digits(thickness)
    assert principal(law, stretch, stretch, free)[:2] == [digits(stress)] * 2


@pytest.mark.parametrize(
    ("law", "stretch", "P11", "P22"),
    [
        (SVK, 0.6, -0.25846154, -0.18461538),
        (SVK, 1.4, 0.90461538, 0.27692308),
        (NH, 0.6, -0.90143489, -0.29470709),
        (NH, 1.4, 0.40239241, 0.1941186),
    ],
)
def test_confined_stretch_has_the_tabulated_stresses(law, stretch, P11, P22):
    """VERIFICATION 1.3."""
    assert principal(law, stretch, 1.0, 1.0) == [digits(P11), digits(P22), digits(P22)]


@pytest.mark.parametrize(
    ("law", "stretch", "stress"),
    [(SVK, 0.8, -0.36), (SVK, 1.2, 0.66), (NH, 0.8, -0.65583941), (NH, 1.2, 0.40398942)],
)
def test_swelling_has_the_tabulated_stress(law, stretch, stress):
    """VERIFICATION 1.3, volumetric states F = s I."""
    assert principal(law, *[stretch] * 3) == [digits(stress)] * 3


@pytest.mark.parametrize(
    ("law", "shear", "P12", "P21", "P11", "P33"),
    [
        (SVK, 0.5, 0.27644231, 0.19230769, 0.16826923, 0.072115385),
        (SVK, 1.0, 1.0576923, 0.38461538, 0.67307692, 0.28846154),
        (NH, 0.5, 0.19230769, 0.19230769, 0.0, 0.0),
        (NH, 1.0, 0.38461538, 0.38461538, 0.0, 0.0),
    ],
)
def test_simple_shear_has_the_tabulated_stresses(law, shear, P12, P21, P11, P33):
    """VERIFICATION 1.4."""
    P = law.stress(shear * SHEAR).tolist()
    assert [P[0][1], P[1][0]] == [digits(P12), digits(P21)]
    assert [P[0][0], P[1][1], P[2][2]] == [digits(P11), digits(P11), digits(P33)]


@pytest.mark.parametrize("shear", [0.1, 0.5, 1.0, 2.0])
def test_normal_stresses_of_simple_shear_are_universal(law, shear):
    """VERIFICATION 1.4: sigma11 - sigma22 = shear sigma12 for every isotropic law."""
    cauchy = law.stress(shear * SHEAR) @ (EYE + shear * SHEAR).T
    assert (cauchy[0, 0] - cauchy[1, 1]).item() == pytest.approx(
        shear * cauchy[0, 1].item(), rel=1e-12
    )


@pytest.mark.parametrize(
    ("law", "printed"),
    [
        (
            SaintVenantKirchhoff(0.25),
            [401316, 145696, -98546, 109033, 127627, 126699, -99618.4, 116577.6, 267958],
        ),
        (
            NeoHookeanLn(0.25),
            [
                *[205618.06845586, 97900.28180473, -61907.80758191],
                *[81983.06535369, 29475.07868947, 102746.94162323],
                *[-65396.04814315, 97426.15125187, 138099.72478590],
            ],
        ),
    ],
    ids=["svk", "neo-hookean"],
)
def test_general_deformation_has_the_tabulated_stress(law, printed):
    """VERIFICATION 1.4, general F, E = 1e6 (P31 of neo-Hookean: misprint there, here by mpmath)."""
    F = torch.tensor(
        [[1.2, 0.2, -0.1], [0.05, 0.95, 0.15], [-0.08, 0.12, 1.1]], dtype=torch.float64
    )
    assert (1e6 * law.stress(F - EYE)).flatten().tolist() == pytest.approx(printed, rel=1e-12)


def test_closed_form_stress_is_the_slope_of_the_energy(law, gradients):
    assert_close(
        law.stress(gradients),
        EnergyAlone(law.poisson, law).stress(gradients),
        rtol=1e-12,
        atol=1e-14,
    )


def test_closed_form_tangent_is_the_curvature_of_the_energy(law, gradients):
    assert_close(
        law.tangent(gradients),
        EnergyAlone(law.poisson, law).tangent(gradients),
        rtol=1e-11,
        atol=1e-13,
    )


def test_differences_of_stress_follow_the_tangent(law, gradients):
    """VERIFICATION 1.4: central differences with h = 1e-6 to 1e-9, independent of autodiff."""
    direction = gradients.flip(0)
    slope = (
        law.stress(gradients + 1e-6 * direction) - law.stress(gradients - 1e-6 * direction)
    ) / 2e-6
    assert_close(
        torch.einsum("nijkl,nkl->nij", law.tangent(gradients), direction),
        slope,
        rtol=1e-9,
        atol=1e-9,
    )


def test_tangent_is_symmetric(law, gradients):
    A = law.tangent(gradients)
    assert_close(A, A.permute(0, 3, 4, 1, 2), rtol=1e-14, atol=1e-14)


def test_batch_shape_does_not_matter(law, gradients):
    folded = gradients.reshape(2, 5, 2, 3, 3)
    for method in (
        law.energy,
        law.stress,
        law.tangent,
        lambda H: EnergyAlone(law.poisson, law).stress(H),
    ):
        assert_close(method(folded).flatten(0, 2), method(gradients), rtol=1e-14, atol=1e-15)


def test_rotated_body_feels_the_rotated_stress(law, gradients, rotation):
    turned = rotation @ (EYE + gradients) - EYE
    assert_close(law.stress(turned), rotation @ law.stress(gradients), rtol=1e-12, atol=1e-13)
    assert_close(law.energy(turned), law.energy(gradients), rtol=1e-12, atol=1e-14)


def test_material_has_no_preferred_direction(law, gradients, rotation):
    turned = (EYE + gradients) @ rotation - EYE
    assert_close(law.stress(turned), law.stress(gradients) @ rotation, rtol=1e-12, atol=1e-13)
    assert_close(law.energy(turned), law.energy(gradients), rtol=1e-12, atol=1e-14)


def test_body_at_rest_has_neither_energy_nor_stress(law):
    rest = torch.zeros(3, 3, dtype=torch.float64)
    assert law.energy(rest) == 0
    assert not law.stress(rest).any()
    assert not EnergyAlone(law.poisson, law).stress(rest).any()


@pytest.mark.parametrize("poisson", [-0.9, 0.0, 0.3, 0.4999])
@pytest.mark.parametrize("kind", [SaintVenantKirchhoff, NeoHookeanLn])
def test_tangent_at_rest_is_hooke(kind, poisson):
    law, rest = kind(poisson), torch.zeros(3, 3, dtype=torch.float64)
    hooke = law.lam * torch.einsum("ij,kl->ijkl", EYE, EYE)
    hooke += law.mu * torch.einsum("ik,jl->ijkl", EYE, EYE)
    hooke += law.mu * torch.einsum("il,jk->ijkl", EYE, EYE)
    assert_close(law.tangent(rest), hooke, rtol=1e-14, atol=1e-14)
    assert_close(EnergyAlone(law.poisson, law).tangent(rest), hooke, rtol=1e-13, atol=1e-13)


def test_moduli_are_those_of_young_and_poisson():
    """VERIFICATION 1: mu and lambda at E = 1, nu = 0.3."""
    assert digits(0.3846153846, 10) == SVK.mu
    assert digits(0.5769230769, 10) == SVK.lam


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


@pytest.mark.parametrize("poisson", [-1.0, 0.5, 0.7, -3.0, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", [SaintVenantKirchhoff, NeoHookeanLn])
def test_poisson_ratio_out_of_range_is_an_error(kind, poisson):
    with pytest.raises(ValueError, match="poisson"):
        kind(poisson)


def test_volume_change_is_exact_for_tiny_gradients(gradients):
    tiny = 1e-12 * gradients
    assert_close(volume_change(tiny), tiny.diagonal(dim1=-2, dim2=-1).sum(-1), rtol=1e-9, atol=0.0)
    assert_close(
        1 + volume_change(gradients), torch.linalg.det(EYE + gradients), rtol=1e-13, atol=0
    )


def test_saint_venant_softens_below_its_limit_stretch():
    """VERIFICATION 1.11: max |P| = 1 / (3 sqrt 3) at 1 / sqrt 3."""
    limit = 1 / math.sqrt(3)
    peak = uniaxial(SVK, limit)[1]
    assert peak == digits(-0.1924500897, 10)
    assert peak < uniaxial(SVK, limit - 1e-3)[1]
    assert peak < uniaxial(SVK, limit + 1e-3)[1]


def test_saint_venant_is_blind_to_reflection_and_lets_a_body_collapse():
    """VERIFICATION 1.11."""
    mirrored = torch.diag(torch.tensor([-2.0, 0.0, 0.0], dtype=torch.float64))
    assert SVK.energy(mirrored) == 0
    assert not SVK.stress(mirrored).any()
    assert SVK.energy(-EYE).item() == pytest.approx(0.9375, rel=1e-12)


@pytest.mark.parametrize(
    ("stretch", "stress"),
    [(0.5, -1.376708), (0.1, -17.09184), (0.01, -304.1406), (0.001, -4369.858)],
)
def test_neo_hookean_resists_collapse_without_bound(stretch, stress):
    """VERIFICATION 1.11, confined compression."""
    assert principal(NH, stretch, 1.0, 1.0)[0] == digits(stress, 7)


@pytest.mark.parametrize(
    ("stress", "stretch"),
    [(-1, 0.4835138104), (-10, 0.1073321638), (1, 2.780359487), (10, 26.00274671)],
)
def test_neo_hookean_answers_every_uniaxial_load(stress, stretch):
    """VERIFICATION 1.11."""
    found = brentq(lambda s: uniaxial(NH, s)[1] - stress, 0.05, 50, xtol=1e-14, rtol=1e-14)
    assert found == digits(stretch, 10)


def test_neo_hookean_is_infinite_at_zero_volume_and_undefined_below():
    flat = torch.diag(torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64))
    assert NH.energy(flat) == math.inf
    assert NH.energy(2 * flat).isnan()


def test_response_is_the_first_stress_pulled_back(law, gradients):
    """S = F^-1 P, as a function of the Green-Lagrange strain alone."""
    S = law.response(green_lagrange(gradients)).stress
    P = EnergyAlone(law.poisson, law).stress(gradients)
    assert_close((EYE + gradients) @ S, P, rtol=1e-11, atol=1e-13)
    assert_close(S, S.mT, rtol=1e-12, atol=1e-13)


def test_moduli_are_the_slope_of_the_response(law, gradients):
    """For symmetric changes of strain."""
    E, change = green_lagrange(gradients), green_lagrange(gradients.flip(0))
    slope = torch.func.jvp(lambda strain: law.response(strain).stress, (E,), (change,))[1]
    assert_close(law.response(E).product(change), slope, rtol=1e-11, atol=1e-13)


def test_law_without_response_says_so():
    assert SVK.has_response
    assert NH.has_response
    assert not Material(0.3).has_response
    with pytest.raises(NotImplementedError, match="Material"):
        Material(0.3).response(EYE)


def test_law_without_energy_says_so():
    with pytest.raises(NotImplementedError, match="Material has no energy"):
        Material(0.3).energy(EYE)
