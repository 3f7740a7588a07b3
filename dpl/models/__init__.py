"""Networks: modules (field, scalars) -> scaled displacement, float32.

Each is built from a scene, its inputs (`Inputs`) and options of its own. Fields have the shape
(B, N, D), scalars (B, S).
"""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.models.cnn import CNN
    from dpl.models.fcnn import FCNN
    from dpl.models.gnn import GNN
    from dpl.models.interface import ClosedFormFit, HasBases, HasCorrection, Inputs
    from dpl.models.linear_response import LinearResponse
    from dpl.models.pod import PODNet
    from dpl.models.unrolled.model import Unrolled
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
