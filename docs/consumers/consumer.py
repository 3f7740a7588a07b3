"""Evaluate an export with NumPy and onnxruntime: python consumer.py runs/mine/export."""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime


def read(name: str, shape: list[int]) -> np.ndarray:
    """Return an array of the reference load."""
    return np.fromfile(folder / "reference" / f"{name}.f64", "<f8").reshape(shape)


folder = Path(sys.argv[1])
meta = json.loads((folder / "meta.json").read_text())
shapes = meta["reference"]["shapes"]
session = onnxruntime.InferenceSession(str(folder / "model.onnx"))

inputs = {
    one["name"]: read(one["name"], shapes[one["name"]]).astype(one["type"])
    for one in meta["model"]["inputs"]
}
found, *numbers = session.run(None, inputs)  # force (B, N, D) [N], young (B,) [Pa] -> (B, N, D) [m]

expected = read("displacement", shapes["displacement"])
error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
largest = np.linalg.norm(found, axis=-1).max()
print(f"largest displacement {largest:.6g} m, {error:.1e} from the reference")
for one, values in zip(meta["model"]["outputs"][1:], numbers, strict=True):
    print(f"{one['name']} {values[0]:.3g}")
sys.exit(not error <= meta["model"]["tolerance"])
