"""Threads of the libraries for linear algebra."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import lru_cache

from threadpoolctl import ThreadpoolController


def single_threaded_blas() -> AbstractContextManager[object]:
    """Limit BLAS to one thread, so that the order of its sums and therefore every bit is the same.

    The other core is used by threads that run beside it; more threads of BLAS would wait for each
    other busily.
    """
    return _libraries().limit(limits=1, user_api="blas")


@lru_cache(maxsize=1)
def _libraries() -> ThreadpoolController:
    """The libraries, which are looked for once: a search takes milliseconds."""
    return ThreadpoolController()
