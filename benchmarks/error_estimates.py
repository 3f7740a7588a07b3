"""Estimated over true errors of predictions: calibration of the `error` of the simulator."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path

import lightning as L
import numpy as np
import torch
from torch import Tensor

from benchmarks.ablation import solved
from dpl import Sample, Scene
from dpl.data import OfflineData
from dpl.evaluation.timing import latency
from dpl.fem import (
    Load,
    ModalLoads,
    NeoHookeanLn,
    Newton,
    Plane,
    Problem,
    SubspaceNewton,
    Tag,
    box,
    propeller,
)
from dpl.fem.loads.family import MAX_DISTANCE
from dpl.inference import corotational_error, estimate_error
from dpl.inference.answer import ROUNDOFF
from dpl.models import FCNN, Correctable, HasCorrection, PODNet, Unrolled
from dpl.models.newton_choice import MAX_STEPS
from dpl.system.threads import one_thread
from dpl.training import MSE, Muon, RMSELoss, Surrogate

Predict = Callable[[Load], Tensor]  # -> displacement (B, N, D) [-]
IN_RANGE, TWICE = "in range", "twice the range"
STEPPED = " + steps"  # end of the name of a prediction that is corrected in modes
STEP_TOL = 1e-3  # estimated error within the modes at which the steps end [-]
MODES = 60  # of the correction of `pod`
CUBATURE_TOL = 1e-2  # of its cells [-]
ESTIMATORS = ("corotational", "modes", "reported")
REPEATS = 5  # timed calls with each load
SHARES = (0.05, 0.5, 0.95)  # quantiles of the ratio


@dataclass(frozen=True)
class Sizes:
    """Amount of work for each body.

    Attributes:
        train, val, test: Numbers of loads.
        epochs: Epochs of the networks.
    """

    train: int
    val: int
    test: int
    epochs: int


@dataclass(frozen=True)
class Estimate:
    """True and estimated relative error of a prediction under one load.

    Attributes:
        body, prediction, loads: Names of the body, the prediction and the set of loads.
        error: ||u - v|| / ||v|| with the solution v [-].
        corotational: Estimate by `dpl.inference.corotational_error` [-].
        modes: Estimate by Newton's correction in the modes of the model, plus the error outside of
            them [-]; NaN without modes.
        reported: `error` of the simulator, see `dpl.inference.estimate_error` [-].
    """

    body: str
    prediction: str
    loads: str
    error: float
    corotational: float
    modes: float
    reported: float


@dataclass(frozen=True)
class Row:
    """Distribution of the ratio of estimated and true error over the loads of a set.

    Attributes:
        body, prediction, loads: See `Estimate`.
        count: Number of loads.
        unknown: Number of loads with an infinite estimate, which the quantiles leave out.
        error: Median of the true relative error [-].
        corotational_p5, corotational_median, corotational_p95: Quantiles of the ratio [-].
        modes_p5, modes_median, modes_p95: The same of the estimate in the modes [-]; NaN without.
        reported_p5, reported_median, reported_p95: The same of the `error` of the simulator [-].
    """

    body: str
    prediction: str
    loads: str
    count: int
    unknown: int
    error: float
    corotational_p5: float
    corotational_median: float
    corotational_p95: float
    modes_p5: float
    modes_median: float
    modes_p95: float
    reported_p5: float
    reported_median: float
    reported_p95: float


def beam() -> Scene:
    """Return the default beam."""
    return _scene(Problem.build(box([100.0, 25.0, 25.0], [17, 5, 5]), NeoHookeanLn(0.3), fixed=END))


def propeller_scene() -> Scene:
    """Return the propeller of the paper."""
    problem = Problem.build(propeller(), NeoHookeanLn(0.3), fixed=Tag("bore"))
    return _scene(problem, n_modes=10, deflection=0.055)


def bracket() -> Scene:
    """Return an L-bracket of quadratic tetrahedra, nearly incompressible."""
    whole = box([1.0, 1.0, 0.25], [7, 7, 3], "tetra")
    x, y = whole.p[:2, whole.t].mean(axis=1)
    mesh = whole.restrict(np.flatnonzero((x < 1 / 3) | (y < 1 / 3)))
    problem = Problem.build(mesh, NeoHookeanLn(0.45), fixed=Plane(1, "max"), degree=2)
    return _scene(problem)


def plate() -> Scene:
    """Return a plate of quadratic hexahedra, fifty times as long as thick."""
    mesh = box([100.0, 50.0, 2.0], [13, 7, 2])
    return _scene(Problem.build(mesh, NeoHookeanLn(0.3), fixed=END, degree=2))


END = Plane(0, "min")
BODIES: Mapping[str, Callable[[], Scene]] = {
    "beam": beam,
    "propeller": propeller_scene,
    "bracket": bracket,
    "plate": plate,
}


def _scene(problem: Problem, *, n_modes: int = 5, deflection: float = 0.4) -> Scene:
    newton = Newton(problem)
    loads = ModalLoads(newton.linear_solver, n_modes=n_modes, deflection=deflection)
    return Scene(problem, loads, newton)


def cost(scene: Scene, samples: Sample) -> str:
    """Return the times of a corotational estimate and of a residual on one thread as a line."""
    pairs = list(zip(samples.load.unbatch(), samples.displacement.split(1), strict=True))
    problem, solver = scene.problem, scene.linear
    known = [(load, u, problem.evaluate(u)) for load, u in pairs]
    estimate = latency(lambda one: corotational_error(solver, *one), known, repeats=REPEATS)
    residual = latency(lambda one: problem.evaluate(one[1]), known, repeats=REPEATS)
    return f"estimate {estimate.p50:.2f} ms, residual {residual.p50:.2f} ms"


def solved_data(scene: Scene, sizes: Sizes, folder: Path) -> OfflineData:
    """Return the data set of a scene in a folder; missing loads are solved."""
    data = OfflineData(
        scene, folder=str(folder), train=sizes.train, val=sizes.val, test=sizes.test, workers=0
    )
    data.prepare_data()
    return data


def estimates(
    body: str, scene: Scene, data: OfflineData, surrogates: Mapping[str, Surrogate], count: int
) -> Iterator[Estimate]:
    """Yield the estimates of the linear solution and of trained surrogates.

    Args:
        body: Name of the body.
        scene: The scene.
        data: Its data set.
        surrogates: Surrogates of the scene, by name.
        count: Largest number of test loads, which are also doubled.
    """
    test = Sample(*(column[:count] for column in data.samples("test")))
    doubled = solved(scene, test.load._replace(force=2 * test.force))
    print(f"{body}: {cost(scene, test)}", flush=True)
    states = data.samples("train").displacement
    for title, samples in ((IN_RANGE, test), (TWICE, doubled)):
        measure = partial(measured, scene, samples)
        for name, predict, newton in _predictions(scene, surrogates, states):
            for stepped in (False, True) if newton else (False,):
                with one_thread(), torch.inference_mode():
                    for found in measure(predict, newton, stepped=stepped):
                        label = name + STEPPED * stepped
                        yield replace(found, body=body, prediction=label, loads=title)


def trained(scene: Scene, data: OfflineData, epochs: int) -> dict[str, Surrogate]:
    """Return trained surrogates of several accuracies, by name."""
    torch.manual_seed(0)
    muon = partial(Muon, lr=5e-3)
    surrogates = {
        "fcnn": Surrogate(FCNN(scene, width=64), MSE(), scene, optimizer=muon),
        "pod": Surrogate(PODNet(scene, rank=60), RMSELoss(), scene, optimizer=muon),
        "unrolled": Surrogate(Unrolled(scene), MSE(), scene),
    }
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    for surrogate in surrogates.values():
        trainer = L.Trainer(
            max_epochs=epochs, accelerator="cpu", enable_checkpointing=False,
            check_val_every_n_epoch=epochs, **quiet,
        )  # fmt: skip
        trainer.fit(surrogate, datamodule=data)
        surrogate.eval()
    return surrogates


def _predictions(
    scene: Scene, surrogates: Mapping[str, Surrogate], states: Tensor
) -> Iterator[tuple[str, Predict, SubspaceNewton | None]]:
    """Yield predictions by name, each with Newton's method in the modes of the model, if any."""

    def linear(load: Load) -> Tensor:
        return torch.stack([scene.linear.solve(force) for force in load.force])

    yield "linear", linear, None
    for name, surrogate in surrogates.items():
        net = surrogate.net
        newton = None
        if isinstance(net, HasCorrection):
            newton = net.correction()
        elif isinstance(net, Correctable):
            newton = net.galerkin(states, rank=MODES, tolerance=CUBATURE_TOL)
        yield name, surrogate.predict, newton


def measured(
    scene: Scene,
    samples: Sample,
    predict: Predict,
    newton: SubspaceNewton | None,
    *,
    stepped: bool = False,
) -> Iterator[Estimate]:
    """Yield true and estimated errors of a prediction for each load; the names are empty.

    Args:
        scene: The scene.
        samples: Loads with their solutions.
        predict: Function from a load to displacements, (B, N, D) [-].
        newton: Newton's method in the modes of the model; None: the estimate in modes is NaN.
        stepped: Correct the prediction by `newton` first, with which the simulator begins, too.
    """
    for load, exact in zip(samples.load.unbatch(), samples.displacement, strict=True):
        u, modes = predict(load), math.nan
        if newton is not None:
            states = newton.states(
                load, guess=u, max_iter=MAX_STEPS if stepped else 0, error_tol=STEP_TOL
            )
            *_, last = states
            u, modes = last.displacement, last.error + newton.outside_error
        error = float((u[0] - exact).norm() / exact.norm())
        corotational, known = corotational_error(scene.linear, load, u), math.inf
        amplitude, distance = scene.loads.project(load.force)
        in_range = amplitude < 1 + ROUNDOFF and distance <= MAX_DISTANCE  # False if it is NaN
        if newton is not None and newton.outside_error > 0 and in_range:
            known = modes
        reported = estimate_error(scene.linear, load, u, in_modes=known).error
        yield Estimate("", "", "", error, corotational, modes, reported)


def summarised(found: Sequence[Estimate]) -> list[Row]:
    """Return a row for each body, prediction and set of loads."""
    rows = []
    for names, group in groupby(found, key=lambda one: (one.body, one.prediction, one.loads)):
        members = list(group)
        errors = np.array([one.error for one in members])
        estimated = [np.array([getattr(one, name) for one in members]) for name in ESTIMATORS]
        quantiles = [value for each in estimated for value in _quantiles(each / errors)]
        unknown = int(np.isinf(estimated[-1]).sum())
        rows.append(Row(*names, len(members), unknown, float(np.median(errors)), *quantiles))
    return rows


def _quantiles(ratios: np.ndarray) -> list[float]:
    """Return the quantiles `SHARES` of the finite ratios; NaN without any."""
    finite = ratios[np.isfinite(ratios)]
    return np.quantile(finite, SHARES).tolist() if len(finite) else [math.nan] * len(SHARES)
