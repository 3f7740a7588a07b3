"""Colours and matplotlib parameters of all figures."""

import itertools
import re
from collections.abc import Iterable

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DPI = 200  # resolution of figures [dots per inch]
METHOD_COLOURS = {  # a method has the same colour in all figures
    "Newton": "0.1",
    "linear": "0.5",
    "unrolled": COLOURS[0],
    "fcnn": COLOURS[1],
    "pod": COLOURS[2],
    "cnn": COLOURS[3],
    "gnn": COLOURS[4],
    "POD-Galerkin": COLOURS[5],
    "paper": "#7F3C8D",
}
OTHER_COLOURS = ("#A5AA99", "#80BA5A", "#E73F74", "#8C564B")  # of methods without an own colour

STYLE = {
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.axisbelow": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
}


def method_colours(names: Iterable[str]) -> dict[str, str]:
    """Return the colours of methods by name: those of `METHOD_COLOURS`, else further ones.

    Variants of a method, such as fcnn_plain and "fcnn, hybrid", have its colour.
    """
    others = itertools.cycle(OTHER_COLOURS)
    methods = {name: re.split(r"[_, ]", name, maxsplit=1)[0] for name in names}
    own = {one: METHOD_COLOURS.get(one) or next(others) for one in dict.fromkeys(methods.values())}
    return {name: own[method] for name, method in methods.items()}
