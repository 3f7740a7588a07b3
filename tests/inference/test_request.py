"""Order of the solutions of a call."""

import math
from types import SimpleNamespace

import pytest
import torch

from dpl.inference.request import Candidate, Request


def candidate(residual, error, volume_ratio=0.5, *, converged=False):
    """Return a solution of which only the numbers of the order are known."""
    numbers = {"residual": residual, "volume_ratio": volume_ratio, "converged": converged}
    state = SimpleNamespace(**{name: torch.tensor([one]) for name, one in numbers.items()})
    return Candidate("prediction", state, error)


@pytest.mark.parametrize(
    ("options", "better"),
    [
        ((None, None, None), candidate(0.9, 0.1)),
        ((None, None, 1e-3), candidate(0.9, 0.1)),
        ((1e-6, None, 1e-3), candidate(0.9, 0.1)),
        ((1e-6, None, None), candidate(0.1, 0.9)),
        ((None, 10.0, None), candidate(0.1, 0.9)),
        ((1e-6, 10.0, None), candidate(0.1, 0.9)),
    ],
)
def test_an_inverted_solution_is_behind_every_valid_one(options, better):
    """Among valid ones the estimated error or the residual decides; NaN is last.

    Options are tol, budget_ms and error.
    """
    wanted = [
        candidate(0.9, 0.9, converged=True),
        better,
        candidate(0.5, 0.5),
        candidate(math.nan, None),
        candidate(1e-9, 1e-9, volume_ratio=-0.1),
        candidate(2e-9, 2e-9, volume_ratio=math.nan),
        candidate(math.nan, None, volume_ratio=0.0),
    ]
    request = Request.checked(*options, warm=False)
    ranks = [request.rank(one) for one in wanted]
    assert ranks == sorted(ranks)
    assert len(set(ranks)) == len(ranks)
