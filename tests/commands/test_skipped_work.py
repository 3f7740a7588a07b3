"""Each line of the plan is true: what it says is skipped is counted and not there."""

import pytest
import torch
from scipy.sparse import linalg

from dpl.data import DataModule
from dpl.data.solving.solve import LoadKey, solve_load
from dpl.fem import Load, Problem, solve
from dpl.fem.assembly import element_loops
from dpl.fem.assembly.discretisation import Discretisation
from dpl.fem.linear import SuperLU
from dpl.models import FCNN
from dpl.training import MSE, LrPlus, LrStar, Surrogate


@pytest.fixture
def calls(monkeypatch):
    """How often what is costly is done; counts begin anew with `calls.clear()`."""
    counts = {}

    def watch(owner, name, key):
        original = getattr(owner, name)

        def counted(*args, **kwargs):
            counts[key] = counts.get(key, 0) + 1
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, counted)

    def splu(matrix, **options):
        ordered = options.get("permc_spec") != "NATURAL"
        counts["ordering"] = counts.get("ordering", 0) + ordered
        return linalg.splu(matrix, **options)

    watch(SuperLU, "factorise", "factorise")
    watch(Problem, "tangent", "tangent")
    watch(Problem, "linearise", "tangent")
    for name in ("internal_force", "residual", "evaluate"):
        watch(Problem, name, "residual")
    monkeypatch.setattr("dpl.fem.linear.superlu.splu", splu)
    return counts


def says(scene, words):
    return any(words in line for line in scene.skipped_work())


def test_rest_stiffness_is_factorised_once_for_modes_answers_and_first_steps(make_scene, calls):
    scene = make_scene()
    scene.loads.eigenmodes  # noqa: B018
    assert calls["factorise"] == 1
    load = scene.loads.sample((0, 0), range(3))
    for force in load.force:
        scene.linear.solve(force)
    solve(scene.linear, load)
    Surrogate(FCNN(scene, width=4), MSE(), scene)
    assert calls["factorise"] == 1
    for k in range(3):
        states = scene.solver.iterate(Load(load.force[k : k + 1], load.young[k : k + 1]))
        next(states)
        next(states)  # the first step
    assert calls["factorise"] == 1
    assert says(
        scene, "K(0) factorised once for modes, linear solutions and every first Newton step"
    )


def test_one_law_without_fibres_has_nothing_of_its_cells(make_scene, monkeypatch):
    """One pass of the loops with the constants of all cells; no frames, no volume functions."""
    passes, original = [], element_loops.add_system

    def counted(law, constants, frames, *rest):
        passes.append((constants.shape[0], frames.size, rest[7]))
        return original(law, constants, frames, *rest)

    counted.stats = original.stats
    monkeypatch.setattr(element_loops, "add_system", counted)
    scene = make_scene()
    scene.problem.evaluate(torch.zeros(1, *scene.problem.shape, dtype=torch.float64))
    assert passes == [(1, 0, None)]


def test_pattern_and_ordering_are_analysed_once(make_scene, calls, monkeypatch):
    scene = make_scene()
    analysed = []
    original = Discretisation.pattern.func
    monkeypatch.setattr(Discretisation.pattern, "func", lambda p: analysed.append(p) or original(p))
    load = scene.loads.sample((0, 0), range(4))
    solve(scene.solver, load)
    solve(scene.solver, load)
    assert calls["factorise"] > 6
    assert len(analysed) == 1
    backends = 2  # that of K(0) keeps its factor, that of Newton replaces it
    assert calls["ordering"] <= backends
    assert says(scene, "symmetric, pattern and ordering analysed once")


def test_only_the_upper_half_of_the_tangent_is_computed(scene):
    problem = scene.problem
    rest = torch.zeros(1, *problem.shape, dtype=torch.float64)
    rows = torch.repeat_interleave(
        torch.arange(problem.pattern.size), torch.tensor(problem.pattern.indptr).diff()
    )
    half = problem.tangent(rest).shape[1]
    assert half == len(problem.pattern.indices)
    assert (torch.tensor(problem.pattern.indices) >= rows).all()
    assert says(scene, f"{half:,} tangent entries of {2 * half - int(problem.free.sum()):,}")


@pytest.mark.parametrize(("size", "iterations"), [(1e-12, 1), (0.0, 0)])
def test_loads_whose_linear_answer_meets_the_tolerance_cost_no_factorisation(
    make_scene, calls, size, iterations
):
    """The zero load is its own answer."""
    scene = make_scene()
    drawn = scene.loads.sample((0, 0), range(3))
    calls.clear()
    answer = solve(scene.solver, Load(size * drawn.force, drawn.young))
    assert answer.converged.all()
    assert (answer.iterations == iterations).all()
    assert bool(answer.displacement.any()) == (size > 0)
    assert not calls.keys() & {"factorise", "tangent"}
    assert says(scene, "no factorisation for loads whose linear solution meets the tolerance")


def test_equal_cells_share_gradients_and_constant_gradients_have_one_point(make_scene, scene):
    assert len(scene.problem.dN) == len(scene.problem.dV) == 1
    assert len(scene.problem.cells) == 16
    assert scene.problem.dN.shape[1] == 8
    assert says(scene, "one set of shape gradients for 16 equal cells")
    assert not says(scene, "one quadrature point")
    tetrahedra = make_scene(cell="tetra")
    assert tetrahedra.problem.dN.shape[:2] == (96, 1)
    assert not says(tetrahedra, "equal cells")
    assert says(tetrahedra, "one quadrature point for each of 96 cells")


def test_young_is_no_input_and_changes_no_answer(make_scene, scene):
    one = solve_load(scene, LoadKey((0, 0), 0))
    wide = make_scene(young=[1e6, 2e11])
    other = solve_load(wide, LoadKey((0, 0), 0))
    moduli = [s.loads.young_at(torch.from_numpy(one.point)[None]) for s in (scene, wide)]
    assert moduli[0] != moduli[1]
    assert (one.force == other.force).all()
    assert (one.displacement == other.displacement).all()
    net, problem = FCNN(scene), scene.problem
    assert net.stages[0].in_features == int(scene.loads.loadable_dofs.sum())
    assert net.stages[0].in_features == int((problem.boundary[:, None] & problem.free).sum())
    assert net.stages[-1].out_features == int(problem.free.sum())
    assert any("parameters" in line for line in net.skipped_work())
    assert says(scene, "no E input, no samples per E")


@pytest.mark.parametrize(
    ("loss", "evaluated"), [(MSE(), False), (LrStar(), True), (LrPlus(), True)]
)
def test_mse_trains_without_finite_elements(scene, batch, calls, loss, evaluated):
    surrogate = Surrogate(FCNN(scene, width=4), loss, scene)
    calls.clear()
    loss(surrogate.predict(batch.load), batch, surrogate.physics).backward()
    assert ("residual" in calls) is evaluated
    assert (
        any("no finite-element evaluation" in line for line in surrogate.skipped_work())
        != evaluated
    )


def test_lr_star_sends_no_gradient_through_the_residual(scene, batch, monkeypatch):
    tracked = []

    def watch(original):
        def watched(problem, displacement):
            tracked.append(torch.is_grad_enabled() and displacement.requires_grad)
            return original(problem, displacement)

        return watched

    for name in ("internal_force", "evaluate"):
        monkeypatch.setattr(Problem, name, watch(getattr(Problem, name)))
    prediction = (batch.displacement + 1e-3).requires_grad_()
    surrogate = Surrogate(FCNN(scene, width=4), LrStar(), scene)
    surrogate.loss(prediction, batch, surrogate.physics)
    assert tracked
    assert not any(tracked)
    assert any("no backward pass through the residual" in line for line in surrogate.skipped_work())
    LrPlus()(prediction, batch, surrogate.physics)
    assert any(tracked)


def test_a_plan_computes_no_sample(scene, tmp_path, calls):
    module = DataModule(scene, folder=str(tmp_path / "none"), workers=0)
    scene.loads.eigenmodes  # noqa: B018
    calls.clear()
    assert scene.skipped_work()
    (where,) = module.skipped_work()
    assert where.startswith("one data set for every size and Young's modulus of this body")
    assert not (tmp_path / "none").exists()
    assert calls == {}


def test_images_under_symmetries_are_not_solved(scene, folder, data, calls, monkeypatch):
    sizes = {"train": 12, "val": 4, "test": 4, "workers": 0}
    module = DataModule(scene, folder=str(folder), symmetry=True, **sizes)
    line = module.skipped_work()[-1]
    count = int(line.split()[0])
    images = f"{count} samples of each load solved, in gradient descent only"
    assert line == f"{images}: symmetries of the body"
    monkeypatch.setattr(
        "dpl.data.solving.worker_pool.solve_load", lambda *job: pytest.fail("solved")
    )
    module.prepare_data()
    calls.clear()
    assert sum(len(batch.force) for batch in module.train_dataloader()) == 12 * count
    assert calls == {}
