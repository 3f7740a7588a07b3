"""Errors and run times of solvers."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.evaluation.comparison import compare
    from dpl.evaluation.report import evaluate
    from dpl.evaluation.tables import PREDICTION
    from dpl.evaluation.timing import Latency, latencies, latency
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
