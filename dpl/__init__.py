"""Neural surrogates of hyperelastic finite-element models, corrected by Newton iterations.

Axis letters used in every docstring:

    B samples   N nodes   D space dimension   E cells   A nodes per cell
    Q quadrature points per cell   M modes   n free degrees of freedom

Inside the package everything is dimensionless: lengths / L, forces / (E L^2) (E L in 2D, per unit
thickness), Young's modulus 1. SI units are used at the border, in `dpl.Scene`.
"""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names
from dpl.version import __version__

if TYPE_CHECKING:
    from dpl.config.run_folder import load
    from dpl.config.validation import ConfigError
    from dpl.data.datamodule import DataModule
    from dpl.data.dataset import DataSet
    from dpl.evaluation.report import evaluate
    from dpl.inference.answer import Answer
    from dpl.inference.hybrid import Direct, Hybrid
    from dpl.inference.simulator import Simulator
    from dpl.models.cnn import CNN
    from dpl.models.fcnn import FCNN
    from dpl.models.gnn import GNN
    from dpl.models.pod import PODNet
    from dpl.scene import Sample, Scene
    from dpl.system.files import DataSetError
    from dpl.training.losses import Loss
    from dpl.training.surrogate import Surrogate
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
    __all__ += ["__version__"]
