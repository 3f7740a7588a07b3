"""The three kinds of predictors: functions of loads that return displacements over L.

A predictor is the only border between float64 mechanics and a float32 network.
"""

from collections.abc import Callable
from typing import Any, ClassVar, Self, cast

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from dpl.data.samples import Samples
from dpl.fem import Load, SubspaceNewton
from dpl.fem.symmetry import NO_SYMMETRIES, SymmetryGroup
from dpl.models.interface import HasBases, HasCorrection, StoredBuffers
from dpl.models.linear_base import FieldWhitening, sampled_solutions
from dpl.models.linear_response import LinearResponse
from dpl.scene import Sample, Scene

CHUNK = 256  # loads whose linear solutions are computed at a time
MAX_SNAPSHOTS = 4096  # samples and images from which a network computes its bases
SCALES = ("force_scale", "displacement_scale")


class Predictor(StoredBuffers):
    """A function of loads that returns displacements over L, (B, N, D) [-], float64.

    Subclasses define `forward(load)`. `problem` is that of the scene on the device of the network.
    """

    meaning: ClassVar[str]  # formula, for a program that reads an exported surrogate
    saves: ClassVar[tuple[str, ...]] = ()  # work that the predictor saves, one line each
    is_closed_form: ClassVar[bool] = False  # `dpl.training.fit` fits it, no gradient descent
    reads_young = False  # Young's modulus is an input of the network
    force_scale: Tensor  # root mean square of forces, () [-]
    displacement_scale: Tensor  # root mean square of displacements, () [-]

    def __init__(self, net: nn.Module, scene: Scene, *scales: Tensor) -> None:
        """Store network, scene and `SCALES`; they are 1 by default."""
        super().__init__()
        self.net, self.scene, self.problem = net, scene, scene.problem
        for name, scale in zip(SCALES, scales or torch.ones(2).double(), strict=True):
            self.register_buffer(name, scale.clone())

    def predict_batch(self, batch: Any) -> tuple[Tensor, Sample]:
        """Return the displacements of a batch of `dataset`, and its samples."""
        return self(batch.load), batch

    def dataset(self, samples: Sample, group: SymmetryGroup = NO_SYMMETRIES) -> Dataset:
        """Return the training set: samples (S, N, D) and their images under a group."""
        return Samples(samples, group)

    def examples(self, samples: Sample) -> tuple[Tensor, Tensor]:
        """Return fields and wanted outputs of the network, (S, N, D) each, float64."""
        raise NotImplementedError

    @property
    def lacks_bases(self) -> bool:
        """True for a network that `HasBases` before they are computed."""
        return hasattr(self.net, "fit_bases") and not cast(HasBases, self.net).is_fitted

    def fit_bases(self, samples: Sample, group: SymmetryGroup = NO_SYMMETRIES) -> None:
        """Let the network compute its bases from samples (S, N, D) and their images."""
        members = range(max(1, len(group)))
        stride = -(-len(samples.force) * len(members) // MAX_SNAPSHOTS)
        few = Sample(*(column[::stride].to(self.force_scale.device) for column in samples))
        which = [torch.full((len(few.force),), k) for k in members]
        fields = (torch.cat([group.images(part, k) for k in which]) for part in self.examples(few))
        cast(HasBases, self.net).fit_bases(*fields)

    def scalars(self, load: Load, *computed: Tensor) -> Tensor:
        """Return `computed` (B,) and the ranges of the body, (B, S), in the network's dtype."""
        ranges, parameters = self.scene.loads.parameter_ranges, self.parameters_of(load)
        pairs = zip(ranges.values(), parameters.unbind(-1), strict=True)
        columns = [*computed, *(ends.normalise(column) for ends, column in pairs)]
        if not columns:
            return load.force.new_zeros(load.force.shape[0], 0, dtype=self.dtype)
        return torch.stack([column.to(self.dtype) for column in columns], dim=1)

    def parameters_of(self, load: Load) -> Tensor:
        """Return the values of the ranges of the body, (B, P); raise ValueError if some lack."""
        names = list(self.scene.loads.parameter_ranges)
        if (found := load.parameters.shape[-1]) != len(names):
            raise ValueError(f"Load.parameters has {found} columns; the body has ranges of {names}")
        return load.parameters

    @property
    def dtype(self) -> torch.dtype:
        """Type of the weights."""
        return next((weights.dtype for weights in self.net.parameters()), torch.float32)

    def correction(self) -> SubspaceNewton | None:
        """Return Newton's method in the modes of a network that `HasCorrection`, else None."""
        net = cast(HasCorrection, self.net)
        return net.correction() if hasattr(net, "correction") else None

    def check_buffers(self) -> None:
        """Raise ValueError if a scale is not positive."""
        for name in SCALES:
            if not (value := getattr(self, name)) > 0:
                raise ValueError(f"{name} = {float(value)} must be above 0")

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the module and its problem; all ways to move a module end here."""
        super()._apply(fn, recurse)
        device, own = self.force_scale.device, self.scene.problem
        if self.problem.points.device != device:
            self.problem = own if own.points.device == device else own.to(device)
        return self


class Scaled(Predictor):
    """A network from scaled forces to scaled displacements.

    The displacement is s N(f / r, scalars) with the scales r and s of forces and displacements.
    """

    meaning = (
        "input = force / (young force_unit scales.force); network; displacement = length "
        "scales.displacement output, the prescribed displacement at fixed degrees of freedom"
    )

    def __init__(self, net: nn.Module, scene: Scene, *, young: bool = False) -> None:
        """Compute the scales.

        Args:
            net: The network, built with `Inputs.from_scene(scene, young=young)`.
            scene: The scene.
            young: Give Young's modulus to the network, as the paper does: fields are forces over
                the largest modulus, and E, or log E for moduli with a logarithmic distribution,
                mapped to [-1, 1], is a scalar. It adds no information, since u/L depends on
                f/(E L^2) alone.
        """
        super().__init__(net, scene, *scales(scene, *sampled_solutions(scene)))
        self.reads_young, self._moduli = young, scene.loads.moduli

    def forward(self, load: Load) -> Tensor:
        """Return displacements over L, (B, N, D) [-], in the precision of the forces."""
        field, moduli = self._field(load.force), list[Tensor]()
        if self.reads_young:
            field = (load.young / self._moduli[1])[:, None, None] * field
            moduli = [self._moduli.normalise(load.young)]
        output = self.net(field.to(self.dtype), self.scalars(load, *moduli))
        displacement = output.to(load.force.dtype) * self.displacement_scale
        prescribed = self.problem.prescribed.to(displacement.dtype)
        return torch.where(self.problem.free, displacement, prescribed)

    def _field(self, force: Tensor) -> Tensor:
        """Return scaled forces (B, N, D) with the values of training on fixed dofs."""
        force, constant = self.problem.acting(force), self.scene.loads.constant_force
        if constant is not None:
            force = force + torch.where(self.problem.free, 0.0, constant.to(force.device))
        return force / self.force_scale

    def examples(self, samples: Sample) -> tuple[Tensor, Tensor]:
        """Return scaled forces and scaled displacements."""
        output = samples.displacement / self.displacement_scale
        return self._field(samples.force), torch.where(self.problem.free, output, 0.0)


class OnLinearSolution(Predictor):
    """A network whose gated output is added to the linear solution.

    With the linear solution v of a load, the displacement scale s, the amplitude a = rms(v) / s and
    a whitening W of linear solutions (`FieldWhitening`), the network N predicts

        u = v + s a^2 / (1 + a) N(W v / rms(v), a).

    The nonlinear part of a hyperelastic displacement is O(|f|^2) at small loads and grows at most
    as fast as v at large ones; the gate a^2 / (1 + a) does both. The outputs that are wanted are
    therefore of order one for all loads, and the prediction of a small load is the linear
    solution. v determines the load, so that it replaces the force as the input of the network.
    """

    meaning = (
        "v = linear solution over length, a = rms(v) / scales.displacement; input = whitened "
        "v/rms(v) and a; network; displacement = length (v + scales.displacement a^2 / (1 + a) "
        "output)"
    )
    saves = ("no learning of linear elasticity: the network adds to K(0)^-1 f",)

    def __init__(self, net: nn.Module, scene: Scene) -> None:
        """Compute scales and whitening; `net` is built with `Inputs.from_scene(scene, "linear")`.

        Raises:
            ValueError: K(0) changes too much with the parameters.
        """
        force, linear = sampled_solutions(scene)
        super().__init__(net, scene, *scales(scene, force, linear))
        self.base = LinearResponse(scene)
        self.whiten = FieldWhitening(self.normalise(linear)[0], scene.problem.free)

    def forward(self, load: Load, linear: Tensor | None = None) -> Tensor:
        """Return displacements over L, (B, N, D), of loads; `linear`: the solutions if known."""
        linear = self.base.solutions(load) if linear is None else linear.to(load.force.dtype)
        field, amplitude = self.normalise(linear)
        scalars = self.scalars(load, 2 * amplitude / (1 + amplitude) - 1)
        output = self.net(self.whiten(field.to(self.dtype)), scalars).to(linear.dtype)
        nonlinear = self._gate(amplitude) * output
        return linear + torch.where(self.problem.free, nonlinear, 0.0)

    def normalise(self, linear: Tensor) -> tuple[Tensor, Tensor]:
        """Return v / rms(v), (B, N, D), and amplitudes a, (B,), of linear solutions (B, N, D)."""
        free = self.scene.problem.free.to(linear.device)  # no index: a GPU waits for its size
        square = torch.where(free, linear, 0.0).square().sum(dim=(1, 2)) / free.sum()
        size = torch.where(square > 0, square, 1.0).sqrt()  # the root has no gradient at zero
        amplitude = torch.where(square > 0, size, 0.0) / self.displacement_scale
        return linear / size[:, None, None], amplitude

    def _gate(self, amplitude: Tensor) -> Tensor:
        """Return s a^2 / (1 + a), (B, 1, 1)."""
        gate = amplitude * (amplitude / (1 + amplitude))
        return (self.displacement_scale * gate)[:, None, None]

    def predict_batch(self, batch: tuple[Tensor, Sample] | Sample) -> tuple[Tensor, Sample]:
        """Return the displacements of a batch; batches of a stream have no linear solutions."""
        linear, sample = (None, batch) if isinstance(batch, Sample) else batch
        return self(sample.load, linear), sample

    def dataset(self, samples: Sample, group: SymmetryGroup = NO_SYMMETRIES) -> Dataset:
        """Return samples with their linear solutions, which are computed once."""
        return LinearSamples(samples, self.base, group)

    def examples(self, samples: Sample) -> tuple[Tensor, Tensor]:
        """Return whitened linear solutions and scaled nonlinear displacements."""
        linear = linear_solutions(samples.load, self.base).double()
        field, amplitude = self.normalise(linear)
        missed = torch.where(self.problem.free, samples.displacement - linear, 0.0)
        gate = self._gate(amplitude)
        return self.whiten(field), missed / torch.where(gate > 0, gate, 1.0)


class Fitted(Predictor):
    """A model that `ClosedFormFit` describes, without trained weights."""

    meaning = "input = force / (young force_unit); model; displacement = length output"
    is_closed_form = True

    def forward(self, load: Load) -> Tensor:
        """Return displacements over L, (B, N, D) [-], float64."""
        return cast(Tensor, self.net(load.force, self.parameters_of(load)))


class LinearSamples(Samples):
    """Samples in memory with their linear solutions, and images of both under symmetries."""

    def __init__(self, samples: Sample, base: LinearResponse, group: SymmetryGroup) -> None:
        """Compute the linear solutions of the samples, (S, N, D) [-], float32."""
        super().__init__(samples, group)
        self.linear = linear_solutions(samples.load, base)

    def __getitems__(self, indices: list[int]) -> tuple[Tensor, Sample]:  # type: ignore[override]
        """Return the linear solutions and the samples of a batch."""
        count = len(self.linear)
        linear = self.linear[[i % count for i in indices]]
        if self.group:
            linear = self.group.images(linear, torch.tensor([i // count for i in indices]))
        return linear, super().__getitems__(indices)


def linear_solutions(load: Load, base: LinearResponse) -> Tensor:
    """Return the linear solutions of many loads, (S, N, D) [-], float32, solved in chunks."""
    parts = zip(*(column.split(CHUNK) for column in load), strict=True)
    return torch.cat([base.solutions(Load(*part)).float() for part in parts])


def scales(scene: Scene, force: Tensor, displacement: Tensor) -> tuple[Tensor, Tensor]:
    """Return the root mean squares of forces and displacements (S, N, D), () [-] each.

    They are those of loadable degrees of freedom (forces) and of free ones (displacements).
    """
    force = force[:, scene.loads.loadable_dofs]
    displacement = displacement[:, scene.problem.free]
    return force.square().mean().sqrt(), displacement.square().mean().sqrt()
