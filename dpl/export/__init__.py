"""A trained surrogate handed on: a graph for ONNX, its weights, its description, its results."""
