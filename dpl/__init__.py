"""From a mesh, a hyperelastic law and a range of loads to a real-time simulator with a proof.

Axis letters used in every docstring:

    B samples   N nodes   D space dimension   E cells   A nodes per cell
    Q quadrature points per cell   M modes   n free degrees of freedom

Inside the package everything is dimensionless: lengths / L, forces / (E L^2) (E L in 2D, per unit
thickness), Young's modulus 1. SI units live at the border, in `dpl.scene.Scene`.
"""

from typing import TYPE_CHECKING

from dpl.version import __version__

if TYPE_CHECKING:
    from pathlib import Path

    from dpl.inference.simulator import Simulator

__all__ = ["__version__", "load"]


def load(folder: "str | Path", *, trust: bool = False, corrected: bool = False) -> "Simulator":
    """Return the simulator of a training run.

    Args:
        folder: The run's, as `runs/...`.
        trust: Whether its configuration may name objects outside this package, such as your own
            law: they are imported and called.
        corrected: Put equilibrium in the network's modes between it and Newton; for `pod` and
            `latent`, and it needs the run's data set.

    Raises:
        ValueError: There is no finished run, its checkpoint is of another scene, it names what is
            not trusted, or its network has no modes.
    """
    from dpl.config.run_folder import load_data, load_run
    from dpl.inference.simulator import Simulator

    config, surrogate = load_run(folder, trust=trust)
    if not corrected:
        return Simulator(surrogate)
    return Simulator.corrected(
        surrogate, load_data(config, surrogate.scene).snapshots().displacement
    )
