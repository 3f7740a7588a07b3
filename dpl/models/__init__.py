"""Networks: modules from scaled forces (B, N, D) to scaled displacements (B, N, D), float32.

Each is built from a scene and options of its own.
"""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.models.cnn import CNN
    from dpl.models.fcnn import FCNN
    from dpl.models.gnn import GNN
    from dpl.models.linear_base import LinearBase
    from dpl.models.pod import PODNet
    from dpl.models.protocols import (
        ClosedFormFit,
        Correctable,
        HasBase,
        HasCorrection,
        TrainsInCoordinates,
    )
    from dpl.models.unrolled.model import Unrolled
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
