"""Training data that another solver computed: pairs of forces and displacements in files."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from dpl.data.datamodule import DataModule
from dpl.data.dataset import DataSet
from dpl.data.sources import Stored
from dpl.fem import Problem
from dpl.fem.mesh.nodal_fields import read_nodal_fields
from dpl.scene import Sample, Scene
from dpl.system.checks import named_errors

FEW = 16  # pairs to which constants of the law are fitted
POISSON = (0.0, 0.4999)  # range of Poisson's ratio in this fit [-]
BATCH = 8  # pairs whose residuals are computed together


class _Read(Stored):
    """Training samples of which nothing has to be solved."""

    def fits(self, dataset: DataSet) -> Iterator[dict[str, int]]:
        yield {"train": self.train, "val": dataset.val, "test": dataset.test}


class PairData(DataModule):
    """Forces and displacements of another solver, divided at random into three splits.

    Pairs are used if they are equilibria of the law of the scene: relative residual and error of
    the supports are at most `tol`.

    Attributes:
        pairs: All pairs in the order of the files.
        residuals: Their relative residuals, (S,) [-].
        support_errors: Their largest error at a prescribed displacement over their largest
            displacement, (S,) [-].
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
            scene: Body, law and supports, with one Young's modulus and no other ranges.
            path: File of arrays or folder of VTK files, see `dpl.fem.mesh.nodal_fields`.
            force, displacement: Names of the nodal forces and of the displacements.
            force_unit: Unit of the forces [N].
            length_unit: Unit of displacements and points [m].
            tol: Largest relative residual of a pair that is used [-].
            val, test: Numbers of pairs to validate and to test on.
            seed: Seed of the division.
            shuffle_seed, batch_size, symmetry: See `DataModule`.

        Raises:
            ValueError: The files cannot be read or do not belong to the body, or too few pairs are
                equilibria; then the message contains the constants of the law that fit best.
        """
        self._path, self._tol = Path(path), tol
        names, units = (force, displacement), (force_unit, length_unit)
        self.pairs = read_pairs(scene, self._path, names, units)
        load, u = self.pairs.load, self.pairs.displacement
        batches = zip(u.split(BATCH), load.force.split(BATCH), strict=True)
        self.residuals = torch.cat([scene.problem.relative_residual(*pair) for pair in batches])
        wrong = torch.where(scene.problem.free, 0.0, u - scene.problem.prescribed)
        error, moved = (field.flatten(1).abs().amax(dim=1) for field in (wrong, u))
        self.support_errors = error / moved.clamp(min=1e-300)
        self._usable = ((self.residuals <= tol) & (self.support_errors <= tol)).nonzero()[:, 0]
        if (train := len(self._usable) - val - test) < 1:
            raise ValueError(self._refusal(scene.problem, float(load.young[0]), val + test))
        super().__init__(
            scene, train=_Read(train), val=val, test=test, seed=seed, shuffle_seed=shuffle_seed,
            batch_size=batch_size, symmetry=symmetry, workers=0,
        )  # fmt: skip

    def _refusal(self, body: Problem, young: float, needed: int) -> str:
        """Return why too few pairs can be used, and the constants that fit best."""
        few = self.pairs.load.force[:FEW], self.pairs.displacement[:FEW]
        ratio, poisson, residual = fit_law(body, *few)
        best = f"young = {ratio * young:.4g}"
        best += "" if poisson is None else f" and poisson = {poisson:.4g}"
        moved = int((self.support_errors > self._tol).sum())
        return (
            f"path = {self._path}: {len(self._usable)} of {len(self.residuals)} pairs are "
            f"equilibria of this law, more than {needed} are needed; the median residual is "
            f"{float(self.residuals.median()):.2g} and tol = {self._tol:g}, supports move in "
            f"{moved} pairs; {best} fit the first pairs best, to a residual of {residual:.2g}"
        )

    def describe(self) -> list[tuple[str, str]]:
        """Return the number of used pairs by split, and a line with their residuals."""
        sizes = ", ".join(f"{size:,} {split}" for split, size in self.sizes.items())
        used, total = self.residuals[self._usable], len(self.residuals)
        residuals = f"median {float(used.median()):.2g}, largest {float(used.max()):.2g}"
        return [
            ("data", f"{len(used):,} of {total:,} pairs of {self._path}: {sizes}"),
            ("", f"residuals under this law: {residuals}; others above {self._tol:g}"),
        ]

    def skipped_work(self) -> list[str]:
        """Return one line for each kind of work that is not needed."""
        return ["no load solved: all displacements are read"]

    def prepare_data(self) -> None:
        """Do nothing: the pairs have been read."""

    def samples(self, split: str) -> Sample:
        """Return a split, (B, ...) in float64."""
        generator = torch.Generator().manual_seed(self.dataset.seed)
        order = self._usable[torch.randperm(len(self._usable), generator=generator)]
        names = list(self.sizes)
        parts = dict(zip(names, order.split(list(self.sizes.values())), strict=True))
        return Sample(*(column[parts[split]] for column in self.pairs))


def read_pairs(
    scene: Scene, path: Path, names: tuple[str, str], units: tuple[float, float]
) -> Sample:
    """Return pairs of another solver, (S, N, D), see `PairData` for arguments and errors."""
    body, young = scene.problem, scene.loads.moduli
    if young[0] != young[1] or scene.loads.parameter_ranges:
        raise ValueError("pairs belong to one body; young and constants of the law must be numbers")
    with named_errors(f"path = {path}: "):
        force, displacement = read_nodal_fields(path, names, body.points_in_metres, units[1])
        if len(force) != len(displacement):
            counts = f"{len(force)} forces and {len(displacement)} displacements"
            raise ValueError(f"there are {counts}; they must be pairs")
        if not (np.isfinite(force).all() and np.isfinite(displacement).all()):
            raise ValueError("all forces and displacements must be finite")
    modulus = torch.full((len(force),), float(young[0]), dtype=torch.float64)
    load = scene.load_of(units[0] * torch.from_numpy(force), modulus)
    return Sample(load.force, torch.from_numpy(displacement) * (units[1] / body.length), modulus)


def fit_law(
    body: Problem, force: Tensor, displacement: Tensor
) -> tuple[float, float | None, float]:
    """Return the constants of a law with the smallest residuals of forces (S, N, D) and solutions.

    Young's modulus is a linear least-squares fit. If the law has a number `poisson`, it is found by
    bounded minimisation (Brent 1973).

    Returns:
        Young's modulus over that of the body [-], Poisson's ratio [-] or None for a law without it,
        and the root mean square of the relative residuals [-].
    """
    given = body.acting(force).flatten(1)
    size = given.norm(dim=1, keepdim=True)
    given = given / size

    def fit(body: Problem) -> tuple[float, float]:
        computed = body.acting(body.internal_force(displacement)).flatten(1) / size
        young = (given * computed).sum() / computed.square().sum()
        residual = (given - young * computed).square().sum(dim=1).mean().sqrt()
        return float(young), float(residual)

    def with_poisson(poisson: float) -> Problem:
        return replace(body, material=replace(cast(Any, body.material), poisson=poisson))

    if not isinstance(getattr(body.material, "poisson", None), float):
        young, residual = fit(body)
        return young, None, residual
    poisson = minimize_scalar(
        lambda x: fit(with_poisson(float(x)))[1], bounds=POISSON, method="bounded"
    ).x
    young, residual = fit(with_poisson(float(poisson)))
    return young, float(poisson), residual
