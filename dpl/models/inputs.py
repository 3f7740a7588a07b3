"""The interface of networks: a nodal field and a few numbers, all of order one."""

from typing import Literal, NamedTuple, Self

from torch import Tensor

from dpl.scene import Scene

Base = Literal["linear"]


class Inputs(NamedTuple):
    """Sizes of the inputs (field, scalars) of a network.

    Without a base the field is a nodal force over its usual size. With `base = "linear"` it is a
    whitened linear solution, see `OnLinearSolution`. The scalars are, in this order: Young's
    modulus if `young`, the amplitude of the linear solution with a base, and a column for each
    range of the body (`LoadFamily.parameter_ranges`).

    Attributes:
        dofs: Degrees of freedom at which the field is not zero, (N, D).
        scalars: Number of scalars.
        is_displacement: The field is a displacement, whose mean over a region has its size. The
            resultant of a region of nodal forces is their sum.
    """

    dofs: Tensor
    scalars: int
    is_displacement: bool

    @classmethod
    def from_scene(cls, scene: Scene, base: Base | None = None, *, young: bool = False) -> Self:
        """Return the inputs of the networks of a scene.

        Args:
            scene: The scene.
            base: "linear" for a network that adds to the linear solution; None for one that
                predicts the displacement from the force.
            young: Young's modulus is an input.

        Raises:
            ValueError: There is no such base, or it excludes `young`.
        """
        if base not in (None, "linear"):
            raise ValueError(f"base = {base} must be linear or null")
        if young and base is not None:
            raise ValueError(f"young = true requires base = null, not {base}")
        count = young + (base is not None) + len(scene.loads.parameter_ranges)
        dofs = scene.loads.loadable_dofs if base is None else scene.problem.free
        return cls(dofs, count, base is not None)
