"""Export of a surrogate: ONNX model with a reference solution, files for ParaView and for C++."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.export.comparison import compare_outputs
    from dpl.export.folder import write_folder
    from dpl.export.onnx_graph import OnnxSession, export_onnx
    from dpl.export.paraview import write_results
    from dpl.export.runtime import write_runtime
    from dpl.export.shared import write_pairs, write_published
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
