"""Threads of the BLAS libraries."""

from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def blas() -> ThreadpoolController:
    """The BLAS libraries of this process; to find them takes milliseconds, to limit them none."""
    return ThreadpoolController().select(user_api="blas")
