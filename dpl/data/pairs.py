"""Training data that another solver computed: pairs of forces and displacements in files."""

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from dpl.data.datamodule import DataModule
from dpl.data.dataset import DataSet
from dpl.data.sources import Stored
from dpl.fem import LinearSolver, Problem
from dpl.fem.mesh.nodal_fields import read_nodal_fields
from dpl.scene import Sample, Scene
from dpl.system.checks import named_errors
from dpl.visualization import plot_misfits

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FEW = 16  # pairs to which constants of the law are fitted
POISSON = (0.0, 0.4999)  # range of Poisson's ratio in this fit [-]
POISSON_TOL = 1e-4  # of the fitted ratio [-]
BATCH = 8  # pairs that are evaluated together


@dataclass(frozen=True, eq=False)
class Pairs:
    """Forces and displacements of another solver, compared with the law of a scene.

    Attributes:
        scene: Body, law and supports, with one Young's modulus and no other ranges.
        path: File of arrays or folder of VTK files, see `dpl.fem.mesh.nodal_fields`.
        force, displacement: Names of the nodal forces and of the displacements.
        force_unit: Unit of the forces [N].
        length_unit: Unit of displacements and points [m].
        tol: Largest relative residual, and relative error of the supports, of a pair that is
            used [-].
    """

    scene: Scene
    path: str | Path
    _: KW_ONLY
    force: str = "force"
    displacement: str = "displacement"
    force_unit: float = 1.0
    length_unit: float = 1.0
    tol: float = 1e-3

    @cached_property
    def samples(self) -> Sample:
        """All pairs in the order of the files, (S, N, D).

        Raises:
            ValueError: The files cannot be read or do not belong to the body.
        """
        body, young = self.scene.problem, self.scene.loads.moduli
        if young[0] != young[1] or self.scene.loads.parameter_ranges:
            raise ValueError(
                "pairs belong to one body; young and constants of the law must be numbers"
            )
        names, unit = (self.force, self.displacement), self.length_unit
        with named_errors(f"path = {self.path}: "):
            force, u = read_nodal_fields(self.path, names, body.points_in_metres, unit)
            if len(force) != len(u):
                counts = f"{len(force)} forces and {len(u)} displacements"
                raise ValueError(f"there are {counts}; they must be pairs")
            if not (np.isfinite(force).all() and np.isfinite(u).all()):
                raise ValueError("all forces and displacements must be finite")
        modulus = torch.full((len(force),), float(young[0]), dtype=torch.float64)
        load = self.scene.load_of(self.force_unit * torch.from_numpy(force), modulus)
        return Sample(load.force, torch.from_numpy(u) * (unit / body.length), modulus)

    @cached_property
    def misfits(self) -> Tensor:
        """Relative residuals under the law, (S,) [-].

        If the law is unknown they are the relative errors of the linear solutions.
        """
        body, fields = self.scene.problem, self.samples[:2]
        if not body.material.is_known:
            return _misfits(body, *fields)
        batches = zip(*(field.split(BATCH) for field in fields), strict=True)
        return torch.cat([body.relative_residual(u, force) for force, u in batches])

    @cached_property
    def support_errors(self) -> Tensor:
        """Largest error at a prescribed displacement over the largest displacement, (S,) [-]."""
        body, u = self.scene.problem, self.samples.displacement
        wrong = torch.where(body.free, 0.0, u - body.prescribed)
        error, moved = (field.flatten(1).abs().amax(dim=1) for field in (wrong, u))
        return error / moved.clamp(min=1e-300)

    @cached_property
    def usable(self) -> Tensor:
        """Numbers of the pairs that are equilibria of the law.

        If the law is unknown they are all pairs with the right motion of the supports, or none
        where the linear solution is as far from the smallest displacements as zero is.
        """
        is_near, balanced = self.misfits[self._smallest].median() < 1, self.misfits <= self.tol
        accepted = balanced | (is_near & (not self.scene.problem.material.is_known))
        return (accepted & (self.support_errors <= self.tol)).nonzero()[:, 0]

    @cached_property
    def _fit(self) -> tuple[Problem, float]:
        """The body and the factor on Young's modulus that fit the smallest pairs best."""
        return fit_law(self.scene.problem, *(field[self._smallest] for field in self.samples[:2]))

    @property
    def _smallest(self) -> Tensor:
        """Numbers of the pairs of smallest displacement, in which laws hardly differ at rest."""
        return self._sizes.argsort()[:FEW]

    @property
    def _sizes(self) -> Tensor:
        """Largest displacements over L, (S,) [-]."""
        return self.samples.displacement.norm(dim=2).amax(dim=1)

    @cached_property
    def fitted_misfits(self) -> Tensor:
        """Misfits with the constants that fit best, (S,) [-]."""
        body, factor = self._fit
        return _misfits(body, *self.samples[:2], factor)

    @property
    def constants(self) -> str:
        """Constants that fit best, as keys of a command."""
        body, factor = self._fit
        words = f"young={factor * float(self.samples.young[0]):.4g}"
        poisson = getattr(body.material, "poisson", None)
        return f"{words} material.poisson={poisson:.4g}" if isinstance(poisson, float) else words

    @property
    def _misfit(self) -> str:
        """Name of the misfits."""
        is_known = self.scene.problem.material.is_known
        return "relative residual" if is_known else "relative error of the linear solution"

    def describe(self) -> str:
        """Return in words how far the pairs are from equilibria of the law."""
        if self.scene.problem.material.is_known:
            used = self.misfits[self.usable]
            shown = f"median {float(used.median()):.2g}, largest {float(used.max()):.2g}"
            return f"residuals under this law: {shown}; others above {self.tol:g}"
        both = self.misfits, self.fitted_misfits
        own, best = (float(one[self._smallest].median()) for one in both)
        return (
            f"law unknown; the linear solution misses the smallest by {own:.2g}, "
            f"with {self.constants} by {best:.2g}"
        )

    def figure(self) -> "Figure":
        """Return a figure of the misfits against the sizes of the displacements."""
        limit = self.tol if self.scene.problem.material.is_known else None
        shown = {"this scene": self.misfits, f"best: {self.constants}": self.fitted_misfits}
        return plot_misfits(self._sizes, shown, self._misfit, limit=limit)

    def refusal(self, needed: int) -> str:
        """Return why too few pairs can be used, and the constants that fit best."""
        moved = int((self.support_errors > self.tol).sum())
        every = self.misfits, self.fitted_misfits, self.fitted_misfits[self._smallest]
        own, best, smallest = (f"{float(misfits.median()):.2g}" for misfits in every)
        return (
            f"path = {self.path}: {len(self.usable)} of {len(self.misfits)} pairs can be used with "
            f"this law, more than {needed} (val and test) are needed; the median {self._misfit} is "
            f"{own} and tol = {self.tol:g}, supports move in {moved} pairs; {self.constants} fit "
            f"the smallest pairs best, to {smallest}, and all pairs to {best}"
        )


class _Read(Stored):
    """Training samples of which nothing has to be solved."""

    def check(self, scene: Scene, batch_size: int) -> None:
        """Accept every scene."""

    def fits(self, dataset: DataSet) -> Iterator[dict[str, int]]:
        yield {"train": self.train, "val": dataset.val, "test": dataset.test}


class PairData(DataModule):
    """Pairs of another solver that are equilibria of the law, divided at random in three splits.

    Attributes:
        pairs: The pairs.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        path: str,
        force: str = "force",
        displacement: str = "displacement",
        force_unit: float = 1.0,
        length_unit: float = 1.0,
        tol: float = 1e-3,
        val: int = 32,
        test: int = 50,
        seed: int = 0,
        shuffle_seed: int = 0,
        batch_size: int = 64,
        symmetry: bool = False,
    ) -> None:
        """Read the pairs and compare them with equilibria of the law.

        Args:
            scene, path, force, displacement, force_unit, length_unit, tol: See `Pairs`.
            val, test: Numbers of pairs to validate and to test on.
            seed: Seed of the division.
            shuffle_seed, batch_size, symmetry: See `DataModule`.

        Raises:
            ValueError: The files cannot be read or do not belong to the body, or too few pairs are
                equilibria; then the message contains the constants of the law that fit best.
        """
        self.pairs = Pairs(
            scene, path, force=force, displacement=displacement, force_unit=force_unit,
            length_unit=length_unit, tol=tol,
        )  # fmt: skip
        if (train := len(self.pairs.usable) - val - test) < 1:
            raise ValueError(self.pairs.refusal(val + test))
        super().__init__(
            scene, train=_Read(train), val=val, test=test, seed=seed, shuffle_seed=shuffle_seed,
            batch_size=batch_size, symmetry=symmetry, workers=0,
        )  # fmt: skip

    def describe(self) -> list[tuple[str, str]]:
        """Return the number of used pairs by split, and a line with their misfits."""
        sizes = ", ".join(f"{size:,} {split}" for split, size in self.sizes.items())
        used, total = len(self.pairs.usable), len(self.pairs.misfits)
        counts = f"{used:,} of {total:,} pairs of {self.pairs.path}: {sizes}"
        return [("data", counts), ("", self.pairs.describe())]

    def figure(self) -> "Figure":
        """Return a figure of the misfits of the pairs."""
        return self.pairs.figure()

    def skipped_work(self) -> list[str]:
        """Return one line for each kind of work that is not needed."""
        return ["no load solved: all displacements are read"]

    def prepare_data(self) -> None:
        """Do nothing: the pairs have been read."""

    def samples(self, split: str) -> Sample:
        """Return a split, (B, ...) in float64."""
        generator, usable = torch.Generator().manual_seed(self.dataset.seed), self.pairs.usable
        order = usable[torch.randperm(len(usable), generator=generator)]
        parts = dict(zip(self.sizes, order.split(list(self.sizes.values())), strict=True))
        return Sample(*(column[parts[split]] for column in self.pairs.samples))


def fit_law(body: Problem, force: Tensor, displacement: Tensor) -> tuple[Problem, float]:
    """Return the constants of a law that fit pairs (S, N, D) [-] best.

    The misfits of a known law are its residuals, those of an unknown one the distances of the
    linear solutions. Young's modulus is a linear least-squares fit. If the law has a number
    `poisson`, it is found by bounded minimisation (Brent 1973).

    Returns:
        The body with this Poisson's ratio, and Young's modulus over that of the body [-].
    """

    def fit(body: Problem) -> tuple[float, float]:
        given, computed = _sides(body, force, displacement)
        factor = (given * computed).sum() / computed.square().sum()
        rest = (given - factor * computed).square().sum()
        return float(factor if body.material.is_known else 1 / factor), float(rest)

    def with_poisson(poisson: float) -> Problem:
        return replace(body, material=replace(cast(Any, body.material), poisson=float(poisson)))

    if isinstance(getattr(body.material, "poisson", None), float):
        body = with_poisson(
            minimize_scalar(
                lambda poisson: fit(with_poisson(poisson))[1],
                bounds=POISSON, method="bounded", options={"xatol": POISSON_TOL},
            ).x
        )  # fmt: skip
    return body, fit(body)[0]


def _misfits(body: Problem, force: Tensor, displacement: Tensor, young: float = 1.0) -> Tensor:
    """Return the relative misfits of pairs, (S,) [-], with `young` times Young's modulus."""
    given, computed = _sides(body, force, displacement)
    factor = young if body.material.is_known else 1 / young
    return (given - factor * computed).norm(dim=1)


def _sides(body: Problem, force: Tensor, displacement: Tensor) -> tuple[Tensor, Tensor]:
    """Return given and computed sides of the equations of pairs, (S, n) each, over the given ones.

    They are external and internal forces under a known law, which is proportional to Young's
    modulus, else the displacements and the linear ones, which are inversely proportional.
    """
    if body.material.is_known:
        parts = displacement.split(BATCH)
        given = body.acting(force).flatten(1)
        computed = torch.cat([body.acting(body.evaluate(u).internal).flatten(1) for u in parts])
    else:
        linear = LinearSolver(body)
        of_supports = linear.solve(torch.zeros_like(force[0]))
        computed = torch.stack([linear.solve(one) - of_supports for one in force]).flatten(1)
        given = (displacement - of_supports).flatten(1)
    size = given.norm(dim=1, keepdim=True).clamp(min=1e-300)
    return given / size, computed / size
