"""A trained network in use: the hybrid solver and the simulator."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.inference.answer import Answer
    from dpl.inference.grasp import GraspAnswer, Gripper
    from dpl.inference.hybrid import (
        Corrected,
        Direct,
        Hybrid,
        default_hybrid,
        prefer_prediction,
    )
    from dpl.inference.simulator import Simulator
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
