"""Conversion of a surrogate into an ONNX graph that needs neither this package nor torch.

The graph takes forces [N] and Young's moduli [Pa], scales them, and returns displacements [m] for
any batch size. Inputs and outputs are float64, because finite-element codes use float64 and two
casts cost little. The network itself is float32.
"""

import contextlib
import importlib.util
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.training import TrainedSurrogate

PACKAGES = ("onnx", "onnxscript", "onnxruntime")
Array = NDArray[np.float64]


def missing_packages() -> list[str]:
    """Return the packages that the export needs and that are not installed."""
    return [name for name in PACKAGES if importlib.util.find_spec(name) is None]


def export_onnx(surrogate: TrainedSurrogate, path: Path) -> None:
    """Write a surrogate as an ONNX file, and weights above 2 GB as `<path>.data`.

    The inputs are those of `Scene.si_inputs`, the output is `displacement`, (B, N, D) [m]. Older
    files are replaced. The surrogate is on the CPU. A network with a fixed batch size, or control
    flow that depends on values, is a ValueError.
    """
    import onnx

    scene = surrogate.eval().scene
    inputs = scene.si_inputs(scene.loads.sample((0, 0), range(3)))
    example, batch = tuple(inputs.values()), torch.export.Dim("B", min=1)
    shapes = tuple({0: batch} for _ in example)
    # computes what a network keeps, such as blocks of K(0); gradients exclude compiled loops
    surrogate(*(column.clone().requires_grad_() for column in example))
    with _silence_exporter():
        try:
            # torch.onnx.export alone would fix the batch size without an error; torch.export raises
            program = torch.export.export(surrogate, example, dynamic_shapes=shapes, strict=False)
            exported = torch.onnx.export(
                program,
                example,
                dynamo=True,
                dynamic_shapes=shapes,
                input_names=list(inputs),
                output_names=["displacement"],
                verbose=False,
            )
            assert exported is not None
        except Exception as error:  # each layer of the exporter has exceptions of its own
            name = type(surrogate.net).__name__
            cause = next(line for line in (*str(error).splitlines(), type(error).__name__) if line)
            raise ValueError(f"{name} cannot be written as an ONNX graph: {cause}") from error
        path.parent.mkdir(parents=True, exist_ok=True)
        for old in (path, path.with_name(f"{path.name}.data")):
            old.unlink(missing_ok=True)
        exported.save(str(path))
    onnx.checker.check_model(str(path))


@contextlib.contextmanager
def _silence_exporter() -> Iterator[None]:
    """Suppress warnings and log records below ERROR."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logging.disable(before)


class OnnxSession:
    """ONNX file, evaluated by onnxruntime on one thread; `inputs` are the names of its inputs."""

    def __init__(self, path: Path) -> None:
        """Load an ONNX file."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
        self.inputs = [one.name for one in self._session.get_inputs()]

    def __call__(self, **inputs: Array | Tensor) -> Array:
        """Return displacements (B, N, D) [m] of the inputs of the graph, by name."""
        arrays = {name: np.asarray(column) for name, column in inputs.items()}
        found: Array = self._session.run(None, arrays)[0]
        return found
