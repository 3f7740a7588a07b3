"""Networks, and predictors that stand for them, with Newton: T18 to T21, T23 and a sweep."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import torch
from torch import Tensor

from benchmarks.plain_newton import PlainNewton
from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import Case, Outcome, classify, expect_error
from benchmarks.stress.fixtures import MAX_TRACTION, YOUNG, as_load, end_traction
from benchmarks.stress.loads import AMPLITUDES, describe, level
from benchmarks.verification.bodies import paper_beam
from benchmarks.verification.report import Row
from dpl import Scene, fem
from dpl.inference import Direct, Hybrid, prefer_prediction
from dpl.inference.hybrid import Predict
from dpl.models import FCNN
from dpl.training import MSE, Surrogate

SVK, NH = fem.SaintVenantKirchhoff(0.3), fem.NeoHookeanLn(0.3)
INVALID = ("not a number", "one not a number", "infinite", "inverted")
# T20: rms noise over L -> residual ratio of the prediction, plain iterations
NOISE = {1e-2: ("592", "14"), 1e-3: ("53.6", "5"), 1e-4: ("5.47", "3"), 1e-5: (".534", "2")}
# T21: error of a uniform factor -> ||R||/||f||
REFERENCE_CORNER = {1e-1: "8.96", 1e-2: ".818", 1e-3: ".081"}
FLOAT32 = 1.5e-4  # T18: residual ratio of an exact answer, rounded to float32, 1275 DOF


@cache
def scene() -> Scene:
    """Return the beam of 8 x 2 x 2 cells of NH-ln with three modes."""
    problem = paper_beam(NH, (8, 2, 2))
    newton = fem.Newton(problem)
    return Scene(problem, fem.ModalLoads(newton.linear_solver, n_modes=3, young=YOUNG), newton)


@cache
def bent_beam() -> tuple[fem.Newton, fem.Load, Tensor]:
    """Return the beam of 16 x 4 x 4 cells of SVK, q = 20 Pa and the exact answer (1, N, 3)."""
    problem = paper_beam(SVK, (16, 4, 4))
    load = as_load(end_traction(problem, 20.0))
    newton = fem.Newton(problem, linear="auto")
    return newton, load, fem.solve(replace(newton, tol=1e-12), load).displacement


def constant_prediction(displacement: Tensor) -> Predict:
    """Return a predictor with a constant prediction, (1, N, D) [-]."""
    return lambda load: displacement


def hybrids(newton: fem.Newton) -> dict[str, Callable[[Tensor], fem.Solver]]:
    """Return hybrid solvers by name, as functions of the prediction (1, N, D) [-]."""
    return {
        "natural_monotonicity": lambda guess: Hybrid(constant_prediction(guess), newton),
        "paper": lambda guess: Hybrid(constant_prediction(guess), newton, "paper"),
        "steps": lambda guess: Hybrid(
            constant_prediction(guess), newton, steps=fem.AndersonSolver(newton)
        ),
    }


def _invalid_predictions(problem: fem.Problem, truth: Tensor) -> dict[str, Tensor]:
    """Return invalid predictions (1, N, D) by name."""
    one = truth.clone()
    one[:, -1, 0] = torch.nan
    return {
        "not a number": torch.full_like(truth, torch.nan),
        "one not a number": one,
        "infinite": torch.where(problem.free, torch.inf, torch.zeros_like(truth)),
        "inverted": torch.where(problem.free, -1.5 * problem.points, 0.0)[None],
    }


def invalid_prediction(name: str, auditor: Auditor) -> Outcome:
    """Start the hybrid from an invalid prediction: the solution is Newton's, bit for bit."""
    newton, load, truth = bent_beam()
    problem, guess = newton.problem, _invalid_predictions(newton.problem, truth)[name]
    classic, rows = fem.solve(newton, load), []
    for way, hybrid in hybrids(newton).items():
        state = auditor.solve(hybrid(guess), problem, load)
        same = torch.equal(state.displacement, classic.displacement)
        more = float(state.iterations - classic.iterations)
        rows += [
            Row(f"{way}: Newton's solution, bit for bit", "1", float(same), 0),
            Row(f"{way}: prediction used", "0", float(state.from_guess), 0),
            Row(f"{way}: iterations more than Newton", "0", more, 0),
        ]
    (alone,) = Direct(constant_prediction(guess), problem).iterate(load)
    rows.append(Row("network alone: converged", "0", float(alone.converged), 0))
    return classify(
        f"Newton's solution in {int(classic.iterations)} iterations, prediction not used", rows
    )


def poor_prediction(name: str, auditor: Auditor) -> Outcome:
    """Start the hybrid from a finite prediction with a large error."""
    newton, load, truth = bent_beam()
    guess = {"huge": 1e6 * truth, "minus": -truth, "half": 0.5 * truth, "zero": 0 * truth}[name]
    rows, failures, messages = [], [], []
    for way, hybrid in hybrids(newton).items():
        state = auditor.solve(hybrid(guess), newton.problem, load)
        messages.append(f"{way} {int(state.iterations)}")
        if not state.converged.all():
            failures.append(f"{way}: {describe(state)}")
            continue
        off = float((state.displacement - truth).abs().max())
        rows.append(Row(f"{way}: off Newton's answer, over L", "< 1e-8", off))
    return classify(f"Newton's answer; iterations: {', '.join(messages)}", rows, failures=failures)


def noisy_prediction(size: float, auditor: Auditor) -> Outcome:
    """Start from the exact solution with noise; it is used where its residual is smaller."""
    newton, load, truth = bent_beam()
    problem, random = newton.problem, torch.Generator().manual_seed(0)
    noise = size * torch.randn(truth.shape, generator=random, dtype=torch.float64)
    guess = truth + torch.where(problem.free, noise, 0.0)
    printed, count = NOISE[size]
    plain = PlainNewton(newton)
    *_, first = (state for state, _ in zip(plain.iterate(load), range(2), strict=False))
    *_, corrected = plain.iterate(load, guess=guess)
    (alone,) = Direct(constant_prediction(guess), problem).iterate(load)
    rows = [
        Row("||R|| / ||f|| of the prediction", printed, float(alone.residual), 0.1),
        Row("the same after one step from rest", "95.6", float(first.residual), 1e-3),
        Row("network alone: converged", "0", float(alone.converged), 0),
    ]
    failures = []
    for way, hybrid in hybrids(newton).items():
        states = list(auditor.wrap(hybrid(guess), problem, newton.tol).iterate(load))
        if not states[-1].converged.all():
            failures.append(f"{way}: {describe(states[-1])}")
            continue
        off = float((states[-1].displacement - truth).abs().max())
        rows.append(Row(f"{way}: off Newton's answer, over L", "< 1e-8", off))
        if way == "paper":
            wanted = bool(alone.volume_ratio > 0) and float(alone.residual) < float(first.residual)
            used = float(prefer_prediction(*states[:2]))
            rows.append(Row("paper: prediction used", f"{int(wanted)}", used, 0))
    taken = int(corrected.iterations)
    if taken > int(count) if size < 1e-2 else taken <= 6:  # at 1e-2 the draw decides how many
        failures.append(f"plain Newton takes {taken} iterations, printed {count}")
    messages = f"|R|/|f| {float(alone.residual):.3g}, plain Newton from it {taken} iterations"
    return classify(messages, rows, failures=failures)


def scaled_prediction(auditor: Auditor) -> Outcome:
    """Multiply the exact solution by a factor, an error with a large residual."""
    newton, load, truth = bent_beam()
    rows = []
    for error, printed in REFERENCE_CORNER.items():
        (alone,) = Direct(constant_prediction((1 + error) * truth), newton.problem).iterate(load)
        rows.append(Row(f"{error:.1%} too long: ||R|| / ||f||", printed, float(alone.residual)))
        rows.append(Row(f"{error:.1%}: converged", "0", float(alone.converged), 0))
    return classify(", ".join(f"{row.value:.3g}" for row in rows[::2]), rows)


def rounded_prediction(auditor: Auditor) -> Outcome:
    """Round an exact solution to float32 and bfloat16: the smallest residual of a network."""
    newton, load, truth = bent_beam()
    rows, messages = [], []
    for dtype, bound in ((torch.float32, FLOAT32), (torch.bfloat16, None)):
        guess, name = truth.to(dtype).double(), str(dtype).removeprefix("torch.")
        (alone,) = Direct(constant_prediction(guess), newton.problem).iterate(load)
        state = auditor.solve(Hybrid(constant_prediction(guess), newton), newton.problem, load)
        ratio = float(alone.residual)
        messages.append(f"{name} {ratio:.2g}, then {int(state.iterations)} iterations")
        if bound is not None:
            rows.append(Row(f"{name}: ||R|| / ||f||", f"{bound}", ratio, 0.5))
        off = float((state.displacement - truth).abs().max())
        rows += [
            Row(f"{name}: converged alone", "0", float(alone.converged), 0),
            Row(f"{name}: off Newton's answer, over L", "< 1e-8", off),
        ]
    return classify("; ".join(messages), rows)


def network_precision(dtype: torch.dtype, device: str, auditor: Auditor) -> Outcome:
    """Predict with a network of another precision: its output is float64, evaluated in float64."""
    own = scene()
    torch.manual_seed(0)
    surrogate = Surrogate(FCNN(own, width=64), MSE(), own).to(device, dtype)
    drawn = own.loads.sample((0, 9), range(4))

    def predict(load: fem.Load) -> Tensor:
        return surrogate.predict(fem.Load(*(column.to(device) for column in load))).cpu()

    with torch.inference_mode():
        said = predict(drawn)
        state = auditor.solve(Hybrid(predict, own.newton), own.problem, drawn)
    exact = fem.solve(replace(own.newton, tol=1e-12), drawn).displacement
    off = float((state.displacement - exact).abs().max())
    rows = [
        Row("the prediction is float64", "1", float(said.dtype == torch.float64), 0),
        Row("the answer is float64", "1", float(state.displacement.dtype == torch.float64), 0),
        Row("off Newton's answers, over L", "< 1e-6", off),
    ]
    failures = [] if state.converged.all() else [describe(state)]
    return classify(f"4 loads, {int(state.iterations.sum())} iterations", rows, failures=failures)


def float32_forces(auditor: Auditor) -> Outcome:
    """Solve with forces in float32: no solution may have that precision."""
    newton, load, truth = bent_beam()
    try:
        state = fem.solve(newton, fem.Load(load.force.float(), load.young, load.parameters))
    except (RuntimeError, TypeError, ValueError) as error:
        return classify(f"{type(error).__name__}: {error}")
    off = float((state.displacement.double() - truth).abs().max())
    rows = [Row("off the answer of float64, over L", "< 1e-6", off)]
    return classify(f"answer in {state.displacement.dtype}, off {off:.0e} L", rows)


def load_sweep(auditor: Auditor) -> Outcome:
    """Solve loads of growing amplitude with hybrids that start from the linear solution."""
    own, levels, failures = scene(), [], []
    problem, unit, rows = own.problem, end_traction(own.problem, MAX_TRACTION), list[Row]()
    for way in ("natural_monotonicity", "paper", "steps"):
        for amplitude in AMPLITUDES:
            load = as_load(amplitude * unit)
            guess = fem.solve(fem.LinearSolver(problem), load).displacement
            exact = fem.solve(own.solver, load)
            hybrid = hybrids(own.newton)[way](guess)
            states = list(auditor.wrap(hybrid, problem, own.solver.tol).iterate(load))
            last = states[-1]
            apart = float((last.displacement - exact.displacement).norm())
            error = apart / float(exact.displacement.norm())
            min_detF = min(float(s.volume_ratio) for s in states if s.iterations > 0 or s is last)
            levels.append(level(f"hybrid, {way}", amplitude, last, min_detF, error))
            if not last.converged.all():
                failures.append(f"{way}, {amplitude:g}: {describe(last)}")
            elif amplitude <= 1:
                rows.append(Row(f"{way}, {amplitude:g}: off Newton", "< 1e-6", error))
    done = sum(one.status in ("converged", "unstable") for one in levels)
    most = max(one.iterations for one in levels)
    said = f"{done} of {len(levels)} answered, at most {most} iterations"
    return classify(said, rows, failures=failures, levels=levels)


def too_large(auditor: Auditor) -> Outcome:
    """Build the paper's network on a mesh of more than 100,000 degrees of freedom."""
    mesh = fem.box([1.0, 1.0, 1.0], [33, 33, 33])
    problem = fem.Problem.build(mesh, NH, fixed=fem.Plane(0, "min"))
    newton = fem.Newton(problem)
    own = Scene(problem, fem.ModalLoads(newton.linear_solver, n_modes=1, young=YOUNG), newton)
    size = problem.points.numel()
    text = f"{4 * size**2 + 7 * size:,} parameters"
    build = partial(FCNN, own, all_dofs=True, memory_limit=128.0)
    return expect_error(f"{size:,} degrees of freedom", build, text)


def cases() -> list[Case]:
    """Return the cases of this module."""
    expected = f"{FLOAT32:g} in float32; never converged; the hybrid exact to 1e-8 L"
    description = "exact answer, rounded to float32 and bfloat16"
    found = [Case("T18", description, expected, rounded_prediction)]
    expected = "predictions and answers in float64, answers Newton's to 1e-6 L"
    for dtype in (torch.float32, torch.bfloat16):
        name, run = str(dtype).removeprefix("torch."), partial(network_precision, dtype, "cpu")
        found.append(Case("T18", f"network in {name}", expected, run))
    if torch.cuda.is_available():
        found.append(Case("T18", "network in float32 with TF32, on the GPU", expected, _with_tf32))
    expected = "an error, or the answer of float64; none in float32"
    found.append(Case("T18", "Newton, given forces in float32", expected, float32_forces))
    for name in INVALID:
        expected = "Newton's solution bit for bit, with as many iterations; prediction not used"
        found.append(Case("T19", f"prediction {name}", expected, partial(invalid_prediction, name)))
    for name in ("huge", "minus", "half", "zero"):
        run = partial(poor_prediction, name)
        found.append(Case("T19", f"prediction {name}", "Newton's answer to 1e-8 L", run))
    for size, (printed, count) in NOISE.items():
        expected = f"|R|/|f| {printed}, {count} plain iterations; prediction used if below 95.6"
        found.append(Case("T20", f"noise of {size:g} L", expected, partial(noisy_prediction, size)))
    expected, description = "|R|/|f| 8.96, .818, .081: none converged", "10 %, 1 %, 0.1 % too long"
    found.append(Case("T21", f"exact answer, {description}", expected, scaled_prediction))
    expected = "refused with its parameters, before any memory is taken"
    found.append(Case("T23", "the paper's network, 107,811 DOF, 128 GB", expected, too_large))
    expected = "Newton's answers in range; beyond, an answer or a status"
    description = "hybrids from the linear solution, 1e-9 to 25 times the range"
    return [*found, Case("sweep", description, expected, load_sweep)]


def _with_tf32(auditor: Auditor) -> Outcome:
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = True
    try:
        return network_precision(torch.float32, "cuda", auditor)
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before
