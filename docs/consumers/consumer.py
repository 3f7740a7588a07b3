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

inputs = {one["name"]: read(one["name"], shapes[one["name"]]) for one in meta["model"]["inputs"]}
outputs = session.run(None, inputs)  # force (B, N, D) [N], young (B,) [Pa] -> (B, N, D) [m]
names = [one["name"] for one in meta["model"]["outputs"]]
output = dict(zip(names, outputs, strict=True))
if "local" in output and output["local"].any():
    print("the basis of the network does not represent this load: do not use the displacement")

expected = read("displacement", shapes["displacement"])
error = np.linalg.norm(output["displacement"] - expected) / np.linalg.norm(expected)
largest = np.linalg.norm(output["displacement"], axis=-1).max()
print(f"largest displacement {largest:.6g} m, {error:.1e} from the reference")
sys.exit(not error <= meta["model"]["tolerance"])
