"""Work in a second thread: the order of each item's sums stays the same.

Threads are kept, since to start one takes as long as a small half.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

WORTH_A_THREAD = 5000
"""Number of items from which a second thread saves time."""
_MOST_THREADS = 32
"""Far more than calls that wait for each other, so that none waits for a thread."""


def in_halves(
    work: Callable[[slice], tuple[NDArray[Any], ...]], count: int
) -> tuple[NDArray[Any], ...]:
    """Arrays that `work` gives for a range of `count` items, from one range or two."""
    if count <= WORTH_A_THREAD:
        return work(slice(0, count))
    second = started(work, slice(count // 2, count))
    first = work(slice(0, count // 2))
    return tuple(np.concatenate(parts) for parts in zip(first, second.result(), strict=True))


def started(
    work: Callable[Arguments, Result], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> Future[Result]:
    """Result of a call in another thread, which nothing waits for but who asks for it."""
    return _threads().submit(work, *args, **kwargs)


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_MOST_THREADS)


# A forked process has none of them, and would wait for ever.
os.register_at_fork(after_in_child=_threads.cache_clear)
