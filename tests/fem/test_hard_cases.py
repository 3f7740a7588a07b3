"""Slender beams and tiny loads: what `benchmarks.stress` does not assert of its cases T5 and T6."""

import pytest
from laws import ISOTROPIC, LAWS

from benchmarks.stress.fixtures import as_load
from dpl import fem


def test_slender_beam_takes_steps_where_one_does_not_do(mixed):
    """Stress case T5: NH-ln 20 x 1 x 1, nu = 0, P L^2 / EI = 1: w / L = .302130893."""
    law = fem.NeoHookeanLn(0.0)
    mesh = fem.box([20.0, 1.0, 1.0], [21, 2, 2])
    problem = fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"), degree=2)
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -1 / 12 / 400]).on(problem)
    states = list(fem.Newton(problem, mixed_integration=mixed).iterate(as_load(force)))
    assert states[-1].status.item() == fem.Status.CONVERGED
    mean = force[:, 2] @ states[-1].displacement[0, :, 2] / force[:, 2].sum()
    assert -mean.item() == pytest.approx(0.302130893, abs=5.1e-10)
    stepped = any(0 < state.load_factor.item() < 1 for state in states)
    assert stepped != mixed  # mixed points spare the steps


@pytest.mark.parametrize(
    ("name", "q"), [*((name, 1e-12) for name in ISOTROPIC), ("neo_hookean_ln", 1e-2)]
)
def test_tiny_load_of_isotropic_laws_ends_at_the_linear_answer(beam, pull, corner, name, q):
    """Stress case T6: u / q within 1e-6 of the linear one; no law stalls above 1e-8."""
    problem = beam(LAWS[name])
    load = as_load(pull(problem, q)[0])
    answer, linear = (fem.solve(kind(problem), load) for kind in (fem.Newton, fem.LinearSolver))
    assert answer.status.item() == fem.Status.CONVERGED
    assert answer.iterations.item() <= 3
    assert answer.residual.item() < 1e-8
    ratio = corner(problem, answer.displacement)[2] / corner(problem, linear.displacement)[2]
    assert ratio.item() == pytest.approx(1.0, abs=max(1e-2 * q, 1e-11))


@pytest.mark.parametrize(
    ("name", "q"), [("holzapfel_gasser_ogden", 1e-2), ("holzapfel_ogden", 1e-12)]
)
def test_tiny_load_of_fibres_without_compression_converges(beam, pull, name, q):
    """Fibres that are shortened do not resist, so that the solution is not the linear one."""
    problem = beam(LAWS[name])
    answer = fem.solve(fem.Newton(problem), as_load(pull(problem, q)[0]))
    assert answer.status.item() == fem.Status.CONVERGED
    assert answer.iterations.item() <= 6
    assert answer.residual.item() < 1e-8
