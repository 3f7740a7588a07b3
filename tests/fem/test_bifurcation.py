"""Laws of buckling: a column beyond its critical load, its unstable directions and branches."""

import pytest
import torch

from dpl import fem
from dpl.fem.solvers.bifurcation import unstable_directions


@pytest.fixture(scope="module")
def column() -> fem.Newton:
    """A column 10 x 1 x 0.8 of quadratic hexahedra, nu = 0, clamped at its foot."""
    mesh = fem.box([10.0, 1.0, 0.8], [11, 2, 2])
    law = fem.SaintVenantKirchhoff(0.0)
    return fem.Newton(fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"), degree=2))


@pytest.fixture(scope="module")
def pressed(column) -> tuple[fem.Load, fem.Solution]:
    """The column under 2.5 times its critical load, straight: pi^2 E I / (4 l^2)."""
    critical = torch.pi**2 * (1.0 * 0.8**3 / 12) / 400
    force = fem.Traction(fem.Plane(0, "max"), [-2.0 * critical / 0.8, 0.0, 0.0]).on(column.problem)
    load = fem.Load(force[None], torch.ones(1, dtype=torch.float64))
    return load, fem.solve(column, load)


def test_straight_column_beyond_its_critical_load_is_unstable(pressed):
    _, answer = pressed
    assert answer.status[0] == fem.Status.UNSTABLE
    assert answer.converged[0]
    assert not answer.stable[0]
    assert answer.negative_pivots[0] == 2  # 2 P_cr > 1.5625 P_cr, the stiffer way
    assert answer.displacement[0, :, 1:].abs().max() < 1e-6


def test_unstable_directions_lower_the_energy(column, pressed):
    load, answer = pressed
    directions = unstable_directions(column, answer)
    assert len(directions) == 2
    u, problem = answer.displacement, column.problem
    assert directions.norm(dim=-1).amax() == pytest.approx(1)

    def total(displacement):
        return problem.energy(displacement) - (load.force * displacement).sum((1, 2))

    for direction in directions:
        assert total(u + 1e-3 * direction) < total(u)
    soft = directions[0].abs().amax(dim=0)
    assert soft[2] > 100 * soft[1]  # it bends about its weak axis first


def test_column_buckles_to_either_side(column, pressed):
    load, straight = pressed
    left, right = fem.post_buckling_branches(column, load, straight)
    problem = column.problem
    for answer in (left, right):
        assert answer.status[0] == fem.Status.CONVERGED
        assert answer.negative_pivots[0] == 0
        energy = problem.energy(answer.displacement) - (load.force * answer.displacement).sum()
        assert energy < problem.energy(straight.displacement) - (
            load.force * straight.displacement
        ).sum((1, 2))
    mirrored = left.displacement[0, :, 2].abs().max()
    assert mirrored > 0.3
    assert right.displacement[0, :, 2].abs().max() == pytest.approx(float(mirrored), rel=1e-6)
    tips = [float(a.displacement[0, :, 2].sum()) for a in (left, right)]
    assert tips[0] * tips[1] < 0


def test_stable_solution_has_no_unstable_direction(column):
    force = fem.Traction(fem.Plane(0, "max"), [1e-5, 0.0, 0.0]).on(column.problem)
    load = fem.Load(force[None], torch.ones(1, dtype=torch.float64))
    answer = fem.solve(column, load)
    with pytest.raises(ValueError, match="no unstable direction"):
        unstable_directions(column, answer)
    with pytest.raises(ValueError, match="no unstable direction"):
        fem.post_buckling_branches(column, load, answer)
