"""Conversion of a surrogate into an ONNX graph that needs neither this package nor torch.

The graph takes forces [N] and Young's moduli [Pa], scales them, and returns displacements [m] and
the numbers of `dpl.export.quantities` for any batch size. Inputs and outputs are float64, because
finite-element codes use float64 and two casts cost little; networks and large matrices are float32.
With `dtype=float32` everything is.
"""

import contextlib
import importlib.util
import logging
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.export.quantities import Quantities
from dpl.training import TrainedSurrogate

PACKAGES = ("onnx", "onnxscript", "onnxruntime")
Array = NDArray[np.float64]


def missing_packages() -> list[str]:
    """Return the packages that the export needs and that are not installed."""
    return [name for name in PACKAGES if importlib.util.find_spec(name) is None]


def export_onnx(
    surrogate: TrainedSurrogate,
    path: Path,
    *,
    numbers: Sequence[str] = (),
    dtype: Literal["float64", "float32"] = "float64",
) -> None:
    """Write a surrogate as an ONNX file, and weights above 2 GB as `<path>.data`.

    The inputs are those of `Scene.si_inputs`, the outputs `displacement`, (B, N, D) [m], and
    `numbers`, (B,) each, see `Quantities`. Older files are replaced. The surrogate is on the CPU. A
    network with a fixed batch size, or control flow that depends on values, is a ValueError.
    """
    import onnx

    scene = surrogate.eval().scene
    inputs = scene.si_inputs(scene.loads.sample((0, 0), range(3)))
    example, batch = tuple(inputs.values()), torch.export.Dim("B", min=1)
    shapes = tuple({0: batch} for _ in example)
    # computes what a network keeps, such as blocks of K(0); gradients exclude compiled loops
    module = Quantities(surrogate, numbers)
    module(*(column.clone().requires_grad_() for column in example))
    with _silence_exporter():
        try:
            # torch.onnx.export alone would fix the batch size without an error; torch.export raises
            program = torch.export.export(module, example, dynamic_shapes=shapes, strict=False)
            exported = torch.onnx.export(
                program,
                example,
                dynamo=True,
                dynamic_shapes=shapes,
                input_names=list(inputs),
                output_names=["displacement", *numbers],
                verbose=False,
            )
            assert exported is not None
        except Exception as error:  # each layer of the exporter has exceptions of its own
            name = type(surrogate.net).__name__
            cause = next(line for line in (*str(error).splitlines(), type(error).__name__) if line)
            raise ValueError(f"{name} cannot be written as an ONNX graph: {cause}") from error
        if dtype == "float32":
            to_float32(exported.model)
        path.parent.mkdir(parents=True, exist_ok=True)
        for old in (path, path.with_name(f"{path.name}.data")):
            old.unlink(missing_ok=True)
        exported.save(str(path))
    onnx.checker.check_model(str(path))


def to_float32(model: Any) -> None:
    """Replace float64 by float32 in an `onnx_ir.Model`: values, constants and casts."""
    import onnx_ir as ir

    double, single = ir.DataType.DOUBLE, ir.DataType.FLOAT

    def rounded(tensor: Any) -> Any:
        return ir.tensor(tensor.numpy().astype(np.float32), name=tensor.name)

    for graph in model.graphs():
        outputs = [value for node in graph for value in node.outputs]
        for value in [*graph.inputs, *graph.initializers.values(), *outputs]:
            if value.dtype == double:
                if value.const_value is not None:
                    value.const_value = rounded(value.const_value)
                value.dtype = single
        for node in graph:
            for name, attribute in node.attributes.items():
                if isinstance(attribute.value, ir.TensorProtocol):
                    if attribute.value.dtype == double:
                        node.attributes[name] = ir.AttrTensor(name, rounded(attribute.value))
                elif name in ("to", "dtype") and attribute.value == double:
                    node.attributes[name] = ir.AttrInt64(name, int(single))


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
    """ONNX file, evaluated by onnxruntime on one thread.

    Attributes:
        inputs, outputs: Names of its inputs and outputs.
    """

    def __init__(self, path: Path) -> None:
        """Load an ONNX file."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
        own = self._session.get_inputs()
        self.inputs = [one.name for one in own]
        self.outputs = [one.name for one in self._session.get_outputs()]
        self._dtype = np.float64 if own[0].type == "tensor(double)" else np.float32

    def __call__(self, **inputs: Array | Tensor) -> dict[str, Array]:
        """Return the outputs of the graph by name, float64, of its inputs."""
        arrays = {name: np.asarray(column, self._dtype) for name, column in inputs.items()}
        found = self._session.run(None, arrays)
        pairs = zip(self.outputs, found, strict=True)
        return {name: np.asarray(one, np.float64) for name, one in pairs}
