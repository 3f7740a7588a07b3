"""A user adds a part with one class or function and one YAML file; every command accepts it."""

import json
import sys

import pytest
import torch

from dpl import Simulator, config
from dpl.fem import LoadFamily, ReferenceSolver
from dpl.viewer import Body
from dpl.viewer.frames import ViewSettings

PARTS = """
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import skfem
import torch
from scipy.linalg import ldl, solve
from torch import nn

import dpl.fem as fem
from dpl.fem.linear import Factor, SingularMatrix, full_matrix
from dpl.fem.materials.tensors import trace, volume_change
from dpl.training import Loss


@dataclass(frozen=True)
class Law(fem.YoungPoissonMaterial):
    ranged = ("poisson", "stiffening")

    stiffening: float | Sequence[float] = 0.0

    def energy(self, H):
        log_J = torch.log1p(volume_change(H))
        first = 2 * trace(H) + H.square().sum((-2, -1))
        more = self.stiffening * first.square().square()
        return self.mu / 2 * (first - 2 * log_J) + self.lam / 2 * log_J.square() + more


def bar(length=4.0):
    ticks = [np.linspace(0, side, count) for side, count in ((length, 4), (1, 2), (1, 2))]
    return skfem.MeshHex.init_tensor(*ticks)


def bimodal(t, gap=0.5):
    signed = 2 * t - 1
    return np.where(signed < 0, -1.0, 1.0) * (gap + (1 - gap) * np.abs(signed))


@dataclass(frozen=True, eq=False)
class TipLoads(fem.RandomLoads):
    size: float = 1e-3

    n_force = 3

    @property
    def largest_force(self):
        return 3**0.5 * self.size

    def force_at(self, point):
        force = torch.zeros(self.problem.shape, dtype=torch.float64)
        force[self.problem.points[:, 0].argmax()] = self.size * torch.from_numpy(2 * point - 1)
        return force


class NoLoads:
    def __init__(self, linear, young, constant_force):
        pass


class Net(nn.Module):
    def __init__(self, scene, *, width: int = 8):
        super().__init__()
        size = scene.problem.free.numel()
        self.layers = nn.Sequential(nn.Linear(size, width), nn.Tanh(), nn.Linear(width, size))

    def forward(self, force, scalars):
        return self.layers(force.flatten(1)).reshape(force.shape)


class L1(Loss):
    def __call__(self, prediction, batch, physics):
        return (prediction - batch.displacement).abs().mean()


@dataclass(frozen=True, eq=False)
class ModifiedNewton:
    problem: fem.Problem
    tol: float = 1e-8
    max_iter: int = 200

    @cached_property
    def linear_solver(self):
        return fem.LinearSolver(self.problem, self.tol, "superlu")

    def iterate(self, load):
        u = self.problem.prescribed.expand_as(load.force)
        for k in range(self.max_iter):
            state = fem.evaluate_solution(self.problem, u, load, self.tol, iterations=k)
            yield state
            if state.converged.all():
                return
            residual = load.force - self.problem.evaluate(u).internal
            u = u + torch.stack([self.linear_solver.solve_force(r) for r in residual])

    def identity(self):
        return {"name": "ModifiedNewton", "tol": self.tol}


@dataclass(frozen=True, eq=False)
class DenseFactor(Factor):
    matrix: np.ndarray

    @property
    def negative_pivots(self):
        return int((np.linalg.eigvalsh(ldl(self.matrix)[1]) < 0).sum())

    def solve(self, right, rtol=1e-12):
        return solve(self.matrix, right, assume_a="sym")

    def apply(self, right):
        return self.solve(right)


@dataclass(frozen=True, eq=False)
class Dense:
    pattern: object
    near_null: object = None

    def factorise(self, values):
        if not np.isfinite(values).all():
            raise SingularMatrix("entries are not finite")
        return DenseFactor(full_matrix(self.pattern, values).toarray())
"""

OPTIONS = {
    "material/ranges": "_target_: my_parts.Law\npoisson: [0.2, 0.3]\nstiffening: [0.0, 2.0]\n",
    "mesh/own": "_target_: my_parts.bar\nlength: 3.0\n",
    "loads/bimodal": "defaults: [modal, _self_]\n"
    "distribution: {_target_: my_parts.bimodal, _partial_: true, gap: 0.3}\n",
    "loads/tip": "_target_: my_parts.TipLoads\n_partial_: true\nsize: 1.0e-4\n",
    "model/own": "_target_: my_parts.Net\n_partial_: true\nwidth: 4\n",
    "loss/own": "_target_: my_parts.L1\n",
    "solver/modified": "_target_: my_parts.ModifiedNewton\n_partial_: true\n",
    "solver/dense": "defaults: [newton, _self_]\n"
    "linear: {_target_: my_parts.Dense, _partial_: true}\n",
}
RUNS = {  # runs in which every own part has its turn, and what of them is exported
    "law with ranges, mesh function, distribution, loss and linear backend": (
        [
            *("material=ranges", "mesh=own", "loads=bimodal", "loads.n_modes=2", "loss=own"),
            *("solver=dense", "model=fcnn", "model.width=4"),
        ],
        "[results]",
    ),
    "load family, network and solver over decades of moduli": (
        [
            *("loads=tip", "loads.size=1e-5", "model=own", "solver=modified", "mesh.nodes=[4,2,2]"),
            "young={low:1e6,high:1e10,distribution:log}",
        ],
        "[model,results]",
    ),
}
TINY = ["data.train=4", "data.val=2", "data.test=2", "data.batch_size=2", "data.workers=0"]
TINY += ["trainer.max_epochs=1", "trainer.check_val_every_n_epoch=1"]


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A user's folder with own parts and options; the parts can be imported."""
    (tmp_path / "my_parts.py").write_text(PARTS)
    for name, text in OPTIONS.items():
        path = tmp_path / "my_conf" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "my_parts", raising=False)
    yield tmp_path
    sys.modules.pop("my_parts", None)


@pytest.mark.parametrize("name", RUNS)
def test_parts_of_a_user_are_trained_evaluated_viewed_and_exported(script, home, name):
    def run(command, *arguments):
        ended = script(command, *arguments, cwd=home)
        assert ended.status == 0, ended.err[-2000:]

    choices, outputs = RUNS[name]
    run("train", "--config-dir", "my_conf", *choices, *TINY, "run=runs/a")
    refused = script("evaluate", "run=runs/a", cwd=home)
    assert refused.status == 2
    assert "my_parts" in refused.err
    assert "trust=true" in refused.err
    run("evaluate", "run=runs/a", "trust=true")
    rows = {row["solver"] for row in json.loads((home / "runs/a/evaluation.json").read_text())}
    assert "Newton, tol=1e-6" in rows
    few = ["count=1", "solve_reference=false"]
    run("export", "run=runs/a", "trust=true", f"outputs={outputs}", *few)
    assert list((home / "runs/a/export/results").glob("*.vtu"))
    if "model" in outputs:
        meta = (home / "runs/a/export/meta.json").read_text()
        assert '"distribution": "log"' in meta
    view(config.load_run(home / "runs/a", trust=True)[1])


def view(surrogate):
    """Compute the frames that the page shows of a random load and of a pull at a node."""
    body, scene = Body(Simulator(surrogate)), surrogate.scene
    assert isinstance(scene.loads, LoadFamily)
    assert isinstance(scene.solver, ReferenceSolver)
    settings, request = ViewSettings(), body.sample(0)
    frame = body.solve(request, settings)
    (*_, last) = body.newton_frames(request, settings, frame)
    assert last.answer.converged
    patch = body.patch(int(scene.problem.points[:, 0].argmax()), 0.4)
    force = patch.force_along(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 0.5)
    assert bool(force.any())


def test_a_class_that_lacks_members_of_the_protocol_is_refused_by_their_names(compose, home):
    cfg = compose("mesh.nodes=[4,2,2]")
    cfg.loads = {"_target_": "my_parts.NoLoads", "_partial_": True}
    with pytest.raises(config.ConfigError, match=r"must give LoadFamily.* project, .*sample"):
        config.build_scene(cfg)
