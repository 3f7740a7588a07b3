"""Acceptance statistics of a data set: fraction of accepted loads by amplitude."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

BINS = 10
MIN_ACCEPTANCE = 0.9  # accepted fraction of a bin below which the data set is biased
MIN_LOADS = 10  # tried loads below which a bin is not judged


class AmplitudeBin(NamedTuple):
    """Numbers of loads in a range of amplitudes ||f|| / ||Phi q_max|| [-]."""

    low: float
    high: float
    tried: int
    accepted: int

    @property
    def biased(self) -> bool:
        """True if too large a fraction of the loads was rejected."""
        return self.tried >= MIN_LOADS and self.accepted < MIN_ACCEPTANCE * self.tried


def amplitude_bins(amplitudes: Sequence[float], accepted: Sequence[bool]) -> list[AmplitudeBin]:
    """Return the bins of equal width from 0 to the largest amplitude that are not empty."""
    if not len(amplitudes):
        return []
    limits = (0.0, max(amplitudes) or 1.0)
    tried, edges = np.histogram(amplitudes, BINS, limits)
    kept, _ = np.histogram(np.asarray(amplitudes)[np.asarray(accepted)], BINS, limits)
    bins = zip(edges[:-1].tolist(), edges[1:].tolist(), tried.tolist(), kept.tolist(), strict=True)
    return [AmplitudeBin(*part) for part in bins if part[2]]


def acceptance_table(bins: Sequence[AmplitudeBin]) -> list[str]:
    """Return two lines of text: upper limits of the bins, and accepted of tried loads."""
    if not bins:
        return []
    heads = [f"{part.high:.2f}" for part in bins]
    cells = [f"{part.accepted}/{part.tried}" for part in bins]
    widths = [max(len(a), len(b)) for a, b in zip(heads, cells, strict=True)]
    return [
        f"{name:>15}  " + "  ".join(text.rjust(w) for text, w in zip(row, widths, strict=True))
        for name, row in (("amplitude up to", heads), ("accepted", cells))
    ]


def bias_warning(bins: Sequence[AmplitudeBin]) -> str:
    """Return a warning for the bin with the lowest acceptance; empty if no bin is biased."""
    biased = [part for part in bins if part.biased]
    if not biased:
        return ""
    worst = min(biased, key=lambda part: part.accepted / part.tried)
    return (
        f"the data set is biased: only {worst.accepted} of {worst.tried} loads with amplitudes "
        f"{worst.low:.2f} to {worst.high:.2f} were accepted; lower loads.deflection, or "
        "read the reasons in the summary of scripts/generate.py"
    )
