"""Compare models with those of other packages on the same loads: python scripts/rivals.py.

Each method is fitted to the first 64, 256 and 1,024 loads of one data set and their images under
the symmetries of the body, by one thread, and each network of another package is trained for the
same time. Methods of other packages learn twice: the displacement from the force (`plain`), and the
nonlinear displacement from the linear solution, with the whitening and the gate of this package
(`linear`). Packages that are not installed are left out; requirements are in benchmarks/rivals.txt.
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from numpy.typing import NDArray
from omegaconf import DictConfig
from torch import Tensor, nn

from benchmarks import CONF
from benchmarks.paper_tables import load_sets
from benchmarks.samples import first
from benchmarks.study import picture, record
from benchmarks.subcommands import run_script
from dpl import Sample, config
from dpl.commands.cli import command
from dpl.data.samples import Samples
from dpl.evaluation.timing import latency
from dpl.scene import Scene
from dpl.system.threads import one_thread
from dpl.training.metrics import errors_of
from dpl.training.predictors import OnLinearSolution, Predictor, Scaled

Array = NDArray[np.float64]
Predict = Callable[[Array], Array]
Regression = Callable[..., tuple[Predict, int]]  # returns a prediction and the number of weights
BASES: Mapping[str, type[Predictor]] = {"plain": Scaled, "linear": OnLinearSolution}
MAX_ROWS = 4096  # samples and images to which a kernel method is fitted
MAX_PROCESS = 1024  # of a Gaussian process, whose likelihood is maximised
INPUTS, OUTPUTS = 120, 200  # numbers of POD coordinates
WIDTH = 256  # of the layers of a branch network
OF_STUDY = ("counts", "models", "rivals", "seconds", "count", "folder", "run", "name")
KEYS = (
    (Sequence[int], "counts", 1, 10**6),
    (Sequence[str], "models"),
    (Sequence[str] | None, "rivals"),
    (float, "seconds", 1e-3, 1e6),
)


@dataclass(frozen=True)
class Row:
    """Errors and costs of one method, fitted to one number of loads."""

    method: str  # its name, with its package
    base: str  # "plain", "linear" (it adds to the linear solution), or "own"
    loads: int  # number of loads of the fit
    median: float  # median relative L2 error of the test loads [-]
    worst: float  # largest relative L2 error [-]
    e_mean: float
    SNR_min: float
    small_median: float  # median error of loads of 0.01 to 0.1 of the range [-]
    small_worst: float
    twice_median: float  # median error of loads of 1 to 2 times the range [-]
    twice_worst: float
    ms: float  # median time of one prediction on one thread [ms]
    fit_seconds: float  # time of the fit [s]: processor time, of models of this package wall time
    weights: int  # numbers that a prediction reads, without those of the linear solution


# ---------------------------------------------------------------------- regressions of coordinates


def kernel_ridge(X: Array, Y: Array, held: tuple[Array, Array], _: float) -> tuple[Predict, int]:
    """Ridge regression with a Gaussian kernel (scikit-learn); held-out samples choose its options.

    Samples are weighted by the inverse of their size, so that relative errors count.
    """
    from sklearn.kernel_ridge import KernelRidge

    weight = 1 / np.linalg.norm(Y, axis=1)
    scale = 1 / np.median(np.square(X - X.mean(axis=0)).sum(axis=1))
    fits: list[tuple[float, int, Any]] = []
    for gamma in scale * np.array([0.03, 0.1, 0.3, 1.0]):
        for alpha in 10.0 ** np.arange(-9, -2, 2):
            model = KernelRidge(alpha=alpha, kernel="rbf", gamma=gamma)
            model.fit(X, Y, sample_weight=weight * len(weight) / weight.sum())
            fits.append((_median_error(model.predict, *held), len(fits), model))
    model = min(fits)[2]
    return model.predict, model.dual_coef_.size + X.size


def gaussian_process(
    X: Array, Y: Array, held: tuple[Array, Array], _: float
) -> tuple[Predict, int]:
    """Gaussian process with a fitted length and noise (scikit-learn)."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    X, Y = X[:MAX_PROCESS], Y[:MAX_PROCESS]
    length = float(np.sqrt(np.square(X - X.mean(axis=0)).sum(axis=1).mean()))
    kernel = ConstantKernel() * RBF(length, (0.1 * length, 100 * length)) + WhiteKernel(1e-6)
    model = GaussianProcessRegressor(kernel, normalize_y=True, random_state=0).fit(X, Y)
    return model.predict, model.alpha_.size + X.size


def radial_basis(X: Array, Y: Array, held: tuple[Array, Array], _: float) -> tuple[Predict, int]:
    """Interpolation by radial basis functions (EZyRB)."""
    from ezyrb import RBF

    few = slice(min(X.shape[1], len(X) // 2))  # its linear part needs more samples than inputs
    model = RBF()
    model.fit(X[:, few], Y)
    return lambda x: model.predict(x[:, few]), X.size + Y.size


def vkoga(X: Array, Y: Array, held: tuple[Array, Array], _: float) -> tuple[Predict, int]:
    """Greedy kernel interpolation (pyMOR); held-out samples choose the length of the kernel."""
    from pymor.algorithms.ml.vkoga import GaussianKernel, VKOGARegressor
    from pymor.core.logger import set_log_levels

    set_log_levels({"pymor": "ERROR"})
    length = float(np.sqrt(np.square(X - X.mean(axis=0)).sum(axis=1).mean()))
    fits: list[tuple[float, int, Any]] = []
    for factor in (1.0, 3.0, 10.0):
        kernel = GaussianKernel(factor * length)
        model = VKOGARegressor(kernel, max_centers=min(len(X), 500), tol=1e-8)
        model.fit(X, Y)
        fits.append((_median_error(model.predict, *held), len(fits), model))
    return min(fits)[2].predict, min(len(X), 500) * (X.shape[1] + Y.shape[1])


def pod_deeponet(
    X: Array, Y: Array, held: tuple[Array, Array], seconds: float
) -> tuple[Predict, int]:
    """Branch network to POD coordinates (DeepXDE, PODDeepONet), Adam with a decaying rate."""
    from deepxde.nn import PODDeepONet

    torch.manual_seed(0)
    shift, size = X.mean(axis=0), X.std() or 1.0
    layers = [X.shape[1], WIDTH, WIDTH, WIDTH, Y.shape[1]]
    basis = torch.eye(Y.shape[1])
    net = PODDeepONet(basis.numpy(), layers, "relu", "Glorot normal")
    scale, place = float(np.sqrt(np.square(Y).mean())), torch.zeros(1, 1)
    run = lambda x: net((x, place))  # noqa: E731
    inputs = torch.from_numpy((X - shift) / size).float()
    _train(net, run, inputs, torch.from_numpy(Y / scale).float(), seconds, batch=64)

    def predict(x: Array) -> Array:
        with torch.inference_mode():
            return scale * run(torch.from_numpy((x - shift) / size).float()).double().numpy()

    return predict, sum(p.numel() for p in net.parameters())


REGRESSIONS: dict[str, tuple[str, Regression]] = {  # with the package that is imported
    "kernel ridge (scikit-learn)": ("sklearn", kernel_ridge),
    "Gaussian process (scikit-learn)": ("sklearn", gaussian_process),
    "RBF (EZyRB)": ("ezyrb", radial_basis),
    "VKOGA (pyMOR)": ("pymor", vkoga),
    "POD-DeepONet (DeepXDE)": ("deepxde", pod_deeponet),
}


def _median_error(predict: Predict, X: Array, Y: Array) -> float:
    return float(np.median(np.linalg.norm(predict(X) - Y, axis=1) / np.linalg.norm(Y, axis=1)))


def _train(
    net: nn.Module,
    run: Callable[[Tensor], Tensor],
    inputs: Tensor,
    outputs: Tensor,
    seconds: float,
    *,
    batch: int,
) -> None:
    """Train a network by Adam for a processor time [s]; the rate decays from 1e-3 as a cosine."""
    optimizer, start = torch.optim.Adam(net.parameters(), lr=1e-3), time.process_time()
    while (part := (time.process_time() - start) / seconds) < 1:
        for rows in torch.randperm(len(inputs)).split(batch):
            optimizer.param_groups[0]["lr"] = 5e-4 * (1 + np.cos(np.pi * min(part, 1.0)))
            optimizer.zero_grad()
            missed = (run(inputs[rows]) - outputs[rows]).flatten(1).norm(dim=1)
            (missed / outputs[rows].flatten(1).norm(dim=1)).mean().backward()
            optimizer.step()
            if (part := (time.process_time() - start) / seconds) >= 1:
                break


# ---------------------------------------------------------------------- networks of fields


class Learner(nn.Module):
    """A method of another package as a network of this package.

    Attributes:
        weights: Numbers that a prediction reads.
    """

    weights = 0

    def __init__(self) -> None:
        """Begin to record inputs."""
        super().__init__()
        self.seen: list[tuple[Tensor, Tensor]] | None = []

    def forward(self, field: Tensor, scalars: Tensor) -> Tensor:
        """Return outputs, (B, N, D); before the fit zeros, and the inputs are recorded."""
        if self.seen is None:
            return self.outputs(field, scalars)
        self.seen.append((field, scalars))
        return torch.zeros_like(field)

    def outputs(self, field: Tensor, scalars: Tensor) -> Tensor:
        """Return outputs, (B, N, D), of fields (B, N, D) and scalars (B, S)."""
        raise NotImplementedError

    def learn(self, sets: Sequence[Sequence[Tensor]], seconds: float) -> None:
        """Fit to fields, scalars and wanted outputs; the second set is held out."""
        raise NotImplementedError

    def learn_from(self, predictor: Predictor, parts: Sequence[Sample], seconds: float) -> None:
        """Fit to samples; those of the second part are held out."""
        sets = []
        for part in parts:
            self.seen = []
            with torch.no_grad():
                predictor(part.load)
            sets.append(
                [*map(torch.cat, zip(*self.seen, strict=True)), predictor.examples(part)[1]]
            )
        self.seen = None
        self.learn(sets, seconds)


class InCoordinates(Learner):
    """A regression from POD coordinates of fields, and scalars, to POD coordinates of outputs."""

    def __init__(self, regression: Regression) -> None:
        """Take the regression."""
        super().__init__()
        self.regression = regression

    def learn(self, sets: Sequence[Sequence[Tensor]], seconds: float) -> None:
        """Fit the regression."""
        (fields, scalars, wanted), held = ([one.double() for one in part] for part in sets)
        self.inputs = _pod(fields[:MAX_ROWS], INPUTS)
        self.modes = _pod(wanted[:MAX_ROWS], OUTPUTS)
        coordinates = fields[:MAX_ROWS].flatten(1) @ self.inputs
        self.scale = float(coordinates.square().sum(dim=1).mean().sqrt())
        X = self._read(fields[:MAX_ROWS], scalars[:MAX_ROWS])
        Y = (wanted[:MAX_ROWS].flatten(1) @ self.modes).numpy()
        known = self._read(*held[:2]), (held[2].flatten(1) @ self.modes).numpy()
        self.predict, count = self.regression(X, Y, known, seconds)
        self.weights = count + self.inputs.numel() + self.modes.numel()

    def outputs(self, field: Tensor, scalars: Tensor) -> Tensor:
        """Return outputs, (B, N, D)."""
        x = self._read(field.double(), scalars.double())
        y = torch.from_numpy(np.asarray(self.predict(x)).reshape(len(x), -1))
        return (y @ self.modes.T).reshape(field.shape).to(field.dtype)

    def _read(self, field: Tensor, scalars: Tensor) -> Array:
        """Return coordinates of mean square 1, and scalars, which lie between -1 and 1."""
        found: Array = torch.cat([field.flatten(1) @ self.inputs / self.scale, scalars], 1).numpy()
        return found


class FourierOperator(Learner):
    """FNO (neuraloperator) on the nodes of a box, which are the points of a regular grid."""

    def __init__(self, points: Tensor) -> None:
        """Find the grid of nodes (N, D)."""
        super().__init__()
        columns = _columns(points)
        values = [column.unique() for column in columns]
        self.shape = [len(one) for one in values]
        places = [torch.searchsorted(*pair) for pair in zip(values, columns, strict=True)]
        self.order = torch.from_numpy(np.ravel_multi_index([p.numpy() for p in places], self.shape))

    def learn(self, sets: Sequence[Sequence[Tensor]], seconds: float) -> None:
        """Train the operator; scalars are constant channels."""
        from neuralop.models import FNO

        torch.manual_seed(0)
        fields, scalars, wanted = sets[0]
        dim, modes = fields.shape[2], tuple(min(12, -(-n // 2) + 1) for n in self.shape)
        channels = {"in_channels": dim + scalars.shape[1], "out_channels": dim}
        self.net = FNO(modes, **channels, hidden_channels=24, n_layers=4)
        self.weights = sum(p.numel() for p in self.net.parameters())
        self.size = float(fields.square().mean().sqrt()), float(wanted.square().mean().sqrt())
        rows = self._channels(fields, scalars), (wanted / self.size[1]).float()
        _train(self.net, self._run, *rows, seconds, batch=8)

    def outputs(self, field: Tensor, scalars: Tensor) -> Tensor:
        """Return outputs, (B, N, D)."""
        return self.size[1] * self._run(self._channels(field, scalars)).to(field.dtype)

    def _channels(self, field: Tensor, scalars: Tensor) -> Tensor:
        constants = scalars[:, None].expand(-1, field.shape[1], -1)
        return torch.cat([field / self.size[0], constants], dim=2).float()

    def _run(self, field: Tensor) -> Tensor:
        grid = torch.zeros(len(field), int(np.prod(self.shape)), field.shape[2])
        grid[:, self.order] = field
        grid = grid.reshape(len(field), *self.shape, -1).movedim(-1, 1)
        return self.net(grid).movedim(1, -1).flatten(1, -2)[:, self.order]


def _pod(fields: Tensor, count: int) -> Tensor:
    """Return the first POD modes of fields (S, N, D), (N D, R)."""
    rows = fields.flatten(1)
    squares, vectors = torch.linalg.eigh(rows @ rows.T)
    kept = (squares > 1e-12 * squares[-1]).nonzero()[-count:, 0].flip(0)
    return rows.T @ (vectors[:, kept] / squares[kept].sqrt())


def _columns(points: Tensor) -> list[Tensor]:
    """Return coordinates in whole millionths of the longest side, (N,) each."""
    return list(points.mul(1e6).round().T.contiguous())


def networks(scene: Scene) -> dict[str, Callable[[], Any]]:
    """Return the methods of the packages that are installed, by name."""
    from importlib.util import find_spec

    found: dict[str, Callable[[], Any]] = {
        name: partial(InCoordinates, regression)
        for name, (package, regression) in REGRESSIONS.items()
        if find_spec(package)
    }
    points = scene.problem.points
    is_grid = np.prod([len(column.unique()) for column in _columns(points)]) == len(points)
    if find_spec("neuralop") and is_grid:
        found["FNO (neuraloperator)"] = partial(FourierOperator, scene.problem.points)
    return found


# ---------------------------------------------------------------------- measurement


def rivals(
    scene: Scene, train: Sample, held: Sample, names: Sequence[str] | None, seconds: float
) -> Iterator[tuple[str, str, Predictor, float, int]]:
    """Yield name, base, predictor, processor time of the fit [s] and weights of each method."""
    for name, build in networks(scene).items():
        for base, kind in BASES.items():
            if names is not None and not any(one in name for one in names):
                continue
            net = build()
            predictor = kind(net, scene)
            start = time.process_time()
            with one_thread():
                net.learn_from(predictor, (train, held), seconds)
            yield name, base, predictor, time.process_time() - start, net.weights


def own(
    scene: Scene, names: Sequence[str], loads: int, folder: Path, seconds: float
) -> Iterator[tuple[str, str, Predictor, float, int]]:
    """Train models of this package by its own command; yield the same as `rivals`."""
    task = [one for one in HydraConfig.get().overrides.task if not one.startswith(OF_STUDY)]
    for name in names:
        run = folder / f"{name}-{loads}"
        limit = f"trainer.max_time={{seconds: {seconds:g}}}"
        if not (run / "evaluation.json").is_file():
            options = [f"model={name}", f"data.train={loads}", f"run={run}", limit]
            with one_thread():
                run_script("train", [*task, *options])
        surrogate = config.load_run(run, scene=scene)[1]
        sessions = map(json.loads, (run / "training.jsonl").read_text().splitlines())
        count = sum(tensor.numel() for tensor in surrogate.net.state_dict().values())
        yield name, "own", surrogate.predictor, sum(one["seconds"] for one in sessions), count


def measured(
    method: tuple[str, str, Predictor, float, int], loads: int, sets: Mapping[str, Sample]
) -> Row:
    """Return the errors of a method on sets of loads, and the time of a prediction."""
    name, base, predictor, seconds, weights = method
    predictor.eval()
    found: dict[str, dict[str, float]] = {}
    with one_thread(), torch.inference_mode():
        for title, samples in sets.items():
            answers = torch.cat([predictor(load) for load in samples.load.unbatch()])
            found[title] = errors_of(predictor.problem, answers, samples)
    time_of = latency(predictor, sets["in range"].load.unbatch(), repeats=3)
    others = {
        f"{title}_{which}": found[title][f"rel_L2_{which}"]
        for title in ("small", "twice")
        for which in ("median", "worst")
    }
    test = found["in range"]
    return Row(
        name, base, loads, test["rel_L2_median"], test["rel_L2_worst"], test["e_mean"],
        test["SNR_min"], **others, ms=time_of.p50, fit_seconds=seconds, weights=weights,
    )  # fmt: skip


def linear_solution(scene: Scene) -> tuple[str, str, Predictor, float, int]:
    """Return the linear solution alone as a method: a network before its fit adds zeros."""
    return "linear solution", "linear", OnLinearSolution(Learner(), scene), 0.0, 0


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw error against time of a prediction, and against the number of loads."""
    from benchmarks.study import method_colours

    rows = [row for row in rows if row.loads] or rows  # without the linear solution
    most = max(row.loads for row in rows)
    best: dict[str, list[Row]] = {}
    for row in rows:
        best.setdefault(f"{row.method}, {row.base}", []).append(row)
    colours = method_colours([name.split(", ")[0] for name in best])
    with picture(path, 4.2) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for name, some in best.items():
            method, base = name.rsplit(", ", 1)
            style = {"color": colours[method], "marker": "o", "ms": 4}
            style |= {"mfc": "white", "ls": "--"} if base == "plain" else {}
            last = [row for row in some if row.loads == most]
            left.plot([row.ms for row in last], [row.median for row in last], **style, label=name)
            right.plot([row.loads for row in some], [row.median for row in some], **style)
        left.set(xscale="log", yscale="log", xlabel="time of a prediction [ms]")
        left.set_ylabel("median relative L2 error")
        right.set(xscale="log" if most else "linear", xlabel="loads of the fit")
        for ax in (left, right):
            ax.grid(visible=True)
        figure.legend(loc="outside lower center", ncols=3, fontsize=6)


@command("rivals", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Fit and measure all methods."""
    scene = config.build_scene(cfg)
    data = config.load_data(cfg, scene)
    train, held, test = (data.samples(split) for split in ("train", "val", "test"))
    sets = load_sets(scene, test, cfg.count)
    folder = Path(cfg.folder)
    folder.mkdir(parents=True, exist_ok=True)

    def rows() -> Iterator[Row]:
        yield measured(linear_solution(scene), 0, sets)
        for loads in cfg.counts:
            every = Samples(first(train, loads), data.group)
            some = every.__getitems__(list(range(len(every))))
            for method in rivals(scene, some, held, cfg.rivals, cfg.seconds):
                yield measured(method, loads, sets)
            for method in own(scene, cfg.models, loads, folder / "runs", cfg.seconds):
                yield measured(method, loads, sets)

    record(rows(), folder / cfg.name, "models of other packages on the same loads", draw)
