"""Newton-Krylov on a batch finds what Newton finds."""

import pytest
import torch
from torch.testing import assert_close

from dpl.fem import (
    BatchedNewton,
    DirichletBC,
    Load,
    ModalLoads,
    NeoHookeanLn,
    Newton,
    Plane,
    Problem,
    Status,
    YeohK2,
    box,
    solve,
)


@pytest.fixture(scope="module", params=[NeoHookeanLn(0.3), YeohK2(0.2, -0.02, 0.005, 2.0)])
def body(request) -> tuple[Problem, Load]:
    """A beam under six random loads, one of them zero."""
    problem = Problem.build(box([4.0, 1, 1], [9, 3, 3]), request.param, fixed=Plane(0, "min"))
    load = ModalLoads(Newton(problem).linear_solver, n_modes=4, deflection=0.2).sample(3, range(6))
    load.force[2] = 0
    return problem, load


def test_batch_has_the_answers_of_newton_in_as_many_iterations(body):
    problem, load = body
    together, alone = solve(BatchedNewton(problem), load), solve(Newton(problem), load)
    assert (together.status == Status.CONVERGED).all()
    assert_close(together.iterations, alone.iterations)
    assert_close(together.displacement, alone.displacement, rtol=0, atol=1e-9)
    assert (together.residual < 1e-8).all()


def test_load_that_is_done_is_left_as_it_is(body):
    problem, load = body
    states = list(BatchedNewton(problem).iterate(load))
    ends = states[-1].iterations
    assert int(ends[2]) == 0
    assert len(states) == int(ends.max()) + 1
    for k, end in enumerate(ends.tolist()):
        assert torch.equal(states[end].displacement[k], states[-1].displacement[k])


def test_load_beyond_its_reach_is_no_answer_and_spoils_no_other(body):
    problem, load = body
    force = load.force.clone()
    force[0] *= 1e3
    answer = solve(BatchedNewton(problem, max_iter=8), Load(force, load.young))
    assert answer.status[0] == Status.NOT_CONVERGED
    assert (answer.status[1:] == Status.CONVERGED).all()
    assert_close(
        answer.displacement[1:], solve(Newton(problem), load).displacement[1:], rtol=0, atol=1e-9
    )


def test_moved_supports_and_ranges_are_refused(body):
    problem, _ = body
    with pytest.raises(ValueError, match="tol"):
        BatchedNewton(problem, tol=0.0)
    pulled = Problem.build(
        problem.mesh,
        problem.material,
        supports=[DirichletBC(Plane(0, "min")), DirichletBC(Plane(0, "max"), [0.1, 0, 0])],
    )
    with pytest.raises(ValueError, match="prescribed"):
        BatchedNewton(pulled)


@pytest.mark.gpu
def test_gpu_has_the_answers_of_the_processor(body):
    problem, load = body
    there = solve(BatchedNewton(problem.to("cuda")), load)
    assert_close(
        there.displacement.cpu(), solve(Newton(problem), load).displacement, rtol=0, atol=1e-9
    )
