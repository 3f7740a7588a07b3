"""A surrogate for others: ONNX, a folder with a reference, files for ParaView."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.export.check import compare
    from dpl.export.folder import read_meta, read_reference, verify, write
    from dpl.export.onnx_graph import export, opset
    from dpl.export.paraview import results
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
