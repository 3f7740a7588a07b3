"""A surrogate as an ONNX graph: what an engineer calls, without this package and without torch.

Forces [N] and moduli [Pa] go in and displacements [m] come out, scaling inside, any batch. These
borders are float64, as those of the package are: the finite elements beside it work in float64, and
two casts cost nothing. What lies between is the network's float32.
"""

import contextlib
import importlib.util
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dpl.models import Latent
from dpl.training import Surrogate

NEEDED = ("onnx", "onnxscript", "onnxruntime")
TALKERS = ("torch.onnx", "torch.export", "onnxscript", "onnx_ir")  # while they write
LOCAL = "local"  # the output that says which answers are not those of the package
Array = NDArray[np.float64]


class Answer(NamedTuple):
    """What a graph answers.

    Attributes:
        displacement: (B, N, D) [m].
        local: Which loads are too local for the basis of the network, (B,): the package would
            answer these with the factor of K(0).
    """

    displacement: Array
    local: NDArray[np.bool_]


def missing() -> list[str]:
    """Return which packages that exporting needs are not installed."""
    return [name for name in NEEDED if importlib.util.find_spec(name) is None]


class Graph(nn.Module):
    """The surrogate, with all that depends on the values of a load taken out.

    `Latent` answers local loads with a sparse factor of K(0), which no graph of tensors holds: here
    they are answered within its basis like all others, and a second output says which they are.
    """

    def __init__(self, surrogate: Surrogate) -> None:
        """Take a trained surrogate on the CPU."""
        super().__init__()
        self.surrogate = surrogate.eval()
        self.basis = isinstance(surrogate.net, Latent)
        self.flags = isinstance(surrogate.net, Latent) and surrogate.net.linear_tol < torch.inf

    @property
    def inputs(self) -> list[str]:
        """Names of what goes in, in order."""
        span = self.surrogate.scene.loads.poisson_range
        return ["force", "young"] + ([] if span is None else ["poisson"])

    @property
    def outputs(self) -> list[str]:
        """Names of what comes out, in order."""
        return ["displacement", LOCAL] if self.flags else ["displacement"]

    def forward(
        self, force: Tensor, young: Tensor, poisson: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """Return displacements (B, N, D) [m], and which loads are local, (B,), where `flags`.

        Args:
            force: (B, N, D) [N]; in 2D [N/m].
            young: (B,) [Pa].
            poisson: (B,) [-]; wanted where the law has a range of Poisson's ratios.
        """
        module = self.surrogate
        load = module.scene.load_of(force, young, poisson)
        scaled, more = module.scale_inputs(load)
        if not self.basis:
            return (module.scene.length * module.unscale_outputs(module.net(scaled, **more)),)
        answer, local = module.net.within(scaled, **more)
        metres = module.scene.length * module.unscale_outputs(answer)
        loaded = (force != 0).flatten(1).any(dim=1)  # at rest the basis misses nothing
        return (metres, local & loaded) if self.flags else (metres,)


def export(graph: Graph, path: Path) -> None:
    """Write a graph as ONNX; where it has more than 2 GB, with weights in a file beside it.

    Args:
        graph: What to write.
        path: Of the file.

    Raises:
        ValueError: The network does what no graph can hold.
    """
    import onnx

    example = _example(graph)
    batch = torch.export.Dim("B", min=1)
    shapes = tuple({0: batch} for _ in example)
    with _quiet():
        try:
            # first by itself: the exporter would fix the batch where a network does, and not say
            program = torch.export.export(graph, example, dynamic_shapes=shapes, strict=False)
            exported = torch.onnx.export(
                program,
                example,
                dynamo=True,
                dynamic_shapes=shapes,
                input_names=graph.inputs,
                output_names=graph.outputs,
                verbose=False,
            )
            assert exported is not None
        except Exception as error:  # of any kind: each layer of the exporter has its own
            name = type(graph.surrogate.net).__name__
            cause = next(line for line in (*str(error).splitlines(), type(error).__name__) if line)
            raise ValueError(f"{name} cannot be written as an ONNX graph: {cause}") from error
        path.parent.mkdir(parents=True, exist_ok=True)
        for old in (path, path.with_name(f"{path.name}.data")):
            old.unlink(missing_ok=True)
        exported.save(str(path))
    onnx.checker.check_model(str(path))


def _example(graph: Graph) -> tuple[Tensor, ...]:
    """Return three loads to follow through the graph."""
    scene = graph.surrogate.scene
    load = scene.loads.sample((0, 0), range(3))
    force = load.force * (load.young * scene.force_unit)[:, None, None]
    own = () if scene.loads.poisson_range is None else (load.poisson[:, 0],)
    return (force, load.young, *own)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what the exporter says of its own to itself."""
    loggers = [logging.getLogger(name) for name in TALKERS]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


class Session:
    """A graph that was written, run by onnxruntime on one thread."""

    def __init__(self, path: Path) -> None:
        """Load the file."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
        self.inputs = [one.name for one in self._session.get_inputs()]
        self.outputs = [one.name for one in self._session.get_outputs()]

    def __call__(self, *arrays: Array) -> Answer:
        """Return the answer to force (B, N, D) [N], young (B,) [Pa] and what else there is."""
        found: list[Any] = self._session.run(None, dict(zip(self.inputs, arrays, strict=True)))
        if LOCAL not in self.outputs:
            found.append(np.zeros(len(found[0]), dtype=bool))
        return Answer(*found)


def opset(path: Path) -> int:
    """Return the version of the operators of an ONNX file."""
    import onnx

    return int(onnx.load(str(path), load_external_data=False).opset_import[0].version)
