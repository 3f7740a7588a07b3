"""How many inputs each property was tried on, discarded ones left out."""

import functools
from collections import Counter

from hypothesis import settings

TRIED: Counter[str] = Counter()


def counted(test):
    """Count the calls of a test that end without an exception; to stand below `given`."""

    @functools.wraps(test)
    def wrapped(*args, **kwargs):
        result = test(*args, **kwargs)
        TRIED[test.__name__] += 1
        return result

    return wrapped


def at_most(part):
    """Return the settings of a test that is dear: `part` as many inputs as the others."""
    return settings(max_examples=max(1, round(settings.default.max_examples * part)))
