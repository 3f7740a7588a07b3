"""Methods of other packages as networks of this package; see `benchmarks.rivals`."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dpl import Sample
from dpl.fem import Problem
from dpl.models.graph import mesh_graph
from dpl.training.predictors import Predictor

Array = NDArray[np.float64]
Predict = Callable[[Array], Array]
Regression = Callable[..., tuple[Predict, int]]  # returns a prediction and the number of weights
Run = Callable[[Tensor], Tensor]  # from channels of the nodes (B, N, C) to outputs (B, N, D)
MAX_ROWS = 4096  # samples and images to which a kernel method is fitted
MAX_PROCESS = 1024  # of a Gaussian process, whose likelihood is maximised
INPUTS, OUTPUTS = 120, 200  # numbers of POD coordinates
WIDTH = 256  # of the layers of a branch network


# ---------------------------------------------------------------------- regressions of coordinates


def kernel_ridge(X: Array, Y: Array, held: tuple[Array, Array], *_: Any) -> tuple[Predict, int]:
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


def gaussian_process(X: Array, Y: Array, *_: Any) -> tuple[Predict, int]:
    """Gaussian process with a fitted length and noise (scikit-learn)."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    X, Y = X[:MAX_PROCESS], Y[:MAX_PROCESS]
    length = float(np.sqrt(np.square(X - X.mean(axis=0)).sum(axis=1).mean()))
    kernel = ConstantKernel() * RBF(length, (0.1 * length, 100 * length)) + WhiteKernel(1e-6)
    model = GaussianProcessRegressor(kernel, normalize_y=True, random_state=0).fit(X, Y)
    return model.predict, model.alpha_.size + X.size


def radial_basis(X: Array, Y: Array, *_: Any) -> tuple[Predict, int]:
    """Interpolation by radial basis functions (EZyRB)."""
    from ezyrb import RBF

    few = slice(min(X.shape[1], len(X) // 2))  # its linear part needs more samples than inputs
    model = RBF()
    model.fit(X[:, few], Y)
    return lambda x: model.predict(x[:, few]), X.size + Y.size


def vkoga(X: Array, Y: Array, held: tuple[Array, Array], *_: Any) -> tuple[Predict, int]:
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
    X: Array, Y: Array, _: tuple[Array, Array], train: Callable[..., None]
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
    train(net, run, inputs, torch.from_numpy(Y / scale).float(), batch=64)

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


# ---------------------------------------------------------------------- networks of fields


class Learner(nn.Module):
    """A method of another package as a network of this package.

    Attributes:
        weights: Numbers that a prediction reads.
        epochs: Passes over the samples and images of a training by gradients.
    """

    weights, epochs = 0, 0.0

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

    def train_for(
        self, seconds: float, net: nn.Module, run: Run, *rows: Tensor, batch: int
    ) -> None:
        """Train by Adam for a processor time [s]; the rate decays from 1e-3 as a cosine."""
        optimizer, start = torch.optim.Adam(net.parameters(), lr=1e-3), time.process_time()
        while True:
            for part in torch.randperm(len(rows[0])).split(batch):
                if (elapsed := time.process_time() - start) >= seconds:
                    return
                optimizer.param_groups[0]["lr"] = 5e-4 * (1 + np.cos(np.pi * elapsed / seconds))
                optimizer.zero_grad()
                inputs, wanted = (column[part] for column in rows)
                missed = (run(inputs) - wanted).flatten(1).norm(dim=1)
                (missed / wanted.flatten(1).norm(dim=1)).mean().backward()
                optimizer.step()
                self.epochs += len(part) / len(rows[0])

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
        train = partial(self.train_for, seconds)
        self.predict, count = self.regression(X, Y, known, train)
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


def fourier_operator(problem: Problem, inputs: int) -> tuple[nn.Module, Run]:
    """FNO (neuraloperator) on the nodes of a box, which are the points of a regular grid."""
    from neuralop.models import FNO

    columns = _columns(problem.points)
    values = [column.unique() for column in columns]
    shape = [len(one) for one in values]
    places = [torch.searchsorted(*pair).numpy() for pair in zip(values, columns, strict=True)]
    order, dim = torch.from_numpy(np.ravel_multi_index(places, shape)), problem.points.shape[1]
    modes = tuple(min(12, -(-n // 2) + 1) for n in shape)
    net = FNO(modes, in_channels=inputs, out_channels=dim, hidden_channels=24, n_layers=4)

    def run(rows: Tensor) -> Tensor:
        grid = rows[:, order.argsort()].reshape(len(rows), *shape, -1).movedim(-1, 1)
        return net(grid).movedim(1, -1).flatten(1, -2)[:, order]

    return net, run


def transolver(problem: Problem, inputs: int) -> tuple[nn.Module, Run]:
    """Transolver (PhysicsNeMo): attention between slices of the nodes."""
    from physicsnemo.models.transolver import Transolver

    points, dim = problem.points.float(), problem.points.shape[1]
    sizes = {"n_layers": 4, "n_hidden": 64, "n_head": 4, "slice_num": 32}
    net = Transolver(inputs, dim, embedding_dim=dim, use_te=False, **sizes)
    return net, lambda rows: net(rows, points.expand(len(rows), -1, -1))


def mesh_graph_net(problem: Problem, inputs: int) -> tuple[nn.Module, Run]:
    """MeshGraphNet (PhysicsNeMo): 15 messages along the edges of the mesh."""
    from physicsnemo.models.meshgraphnet import MeshGraphNet
    from torch_geometric.data import Data

    mesh, (nodes, dim) = mesh_graph(problem), problem.points.shape
    ends, edges = np.stack([mesh.sender, mesh.receiver]), torch.from_numpy(mesh.features()).float()
    names = ("processor", "node_encoder", "edge_encoder", "node_decoder")
    widths = {f"hidden_dim_{name}": 32 for name in names}
    net = MeshGraphNet(inputs, edges.shape[1], dim, **widths)

    @cache
    def graph(count: int) -> Any:
        every = ends[:, None] + nodes * np.arange(count)[:, None]
        index = torch.from_numpy(every.reshape(2, -1))
        return Data(edge_index=index, num_nodes=count * nodes)

    def run(rows: Tensor) -> Tensor:
        flat = net(rows.flatten(0, 1), edges.repeat(len(rows), 1), graph(len(rows)))
        return flat.reshape(*rows.shape[:2], -1)

    return net, run


NODAL: dict[str, tuple[str, Callable[[Problem, int], tuple[nn.Module, Run]], int]] = {
    "FNO (neuraloperator)": ("neuralop", fourier_operator, 8),  # with package and batch size
    "Transolver (PhysicsNeMo)": ("physicsnemo", transolver, 4),
    "MeshGraphNet (PhysicsNeMo)": ("torch_scatter", mesh_graph_net, 4),
}


class OnNodes(Learner):
    """A network from channels of the nodes to outputs of the nodes."""

    def __init__(self, build: Callable[..., Any], batch: int, problem: Problem) -> None:
        """Take the function that builds the network, and the batch size."""
        super().__init__()
        self.build, self.batch, self.problem = build, batch, problem

    def learn(self, sets: Sequence[Sequence[Tensor]], seconds: float) -> None:
        """Train the network; scalars are constant channels."""
        torch.manual_seed(0)
        fields, scalars, wanted = sets[0]
        self.net, self.run = self.build(self.problem, fields.shape[2] + scalars.shape[1])
        self.weights = sum(p.numel() for p in self.net.parameters())
        self.size = float(fields.square().mean().sqrt()), float(wanted.square().mean().sqrt())
        rows = self._channels(fields, scalars), (wanted / self.size[1]).float()
        self.train_for(seconds, self.net, self.run, *rows, batch=self.batch)

    def outputs(self, field: Tensor, scalars: Tensor) -> Tensor:
        """Return outputs, (B, N, D)."""
        return self.size[1] * self.run(self._channels(field, scalars)).to(field.dtype)

    def _channels(self, field: Tensor, scalars: Tensor) -> Tensor:
        constants = scalars[:, None].expand(-1, field.shape[1], -1)
        return torch.cat([field / self.size[0], constants], dim=2).float()


def _pod(fields: Tensor, count: int) -> Tensor:
    """Return the first POD modes of fields (S, N, D), (N D, R)."""
    rows = fields.flatten(1)
    squares, vectors = torch.linalg.eigh(rows @ rows.T)
    kept = (squares > 1e-12 * squares[-1]).nonzero()[-count:, 0].flip(0)
    return rows.T @ (vectors[:, kept] / squares[kept].sqrt())


def _columns(points: Tensor) -> list[Tensor]:
    """Return coordinates in whole millionths of the longest side, (N,) each."""
    return list(points.mul(1e6).round().T.contiguous())


def networks(problem: Problem) -> Mapping[str, Callable[[], Learner]]:
    """Return the methods of the packages that are installed, by name; FNO needs a grid."""
    found: dict[str, Callable[[], Learner]] = {
        name: partial(InCoordinates, regression)
        for name, (package, regression) in REGRESSIONS.items()
        if find_spec(package)
    }
    grid = np.prod([len(column.unique()) for column in _columns(problem.points)])
    for name, (package, build, batch) in NODAL.items():
        if find_spec(package) and (grid == len(problem.points) or build is not fourier_operator):
            found[name] = partial(OnNodes, build, batch, problem)
    return found
