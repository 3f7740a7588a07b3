"""Matplotlib figures and their style."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.visualization.figures import draw_body, plot_errors, plot_misfits
    from dpl.visualization.shapes import plot_deformed
    from dpl.visualization.style import COLOURS, DPI, STYLE
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
