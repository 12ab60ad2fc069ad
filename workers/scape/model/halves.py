"""Work in a second thread: the order of each item's sums stays the same."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

WORTH_A_THREAD = 5000
"""Number of items from which a second thread saves time."""


def in_halves(
    work: Callable[[slice], tuple[NDArray[Any], ...]], count: int
) -> tuple[NDArray[Any], ...]:
    """Arrays that `work` gives for a range of `count` items, from one range or two."""
    if count <= WORTH_A_THREAD:
        return work(slice(0, count))
    with ThreadPoolExecutor(1) as beside:
        second = beside.submit(work, slice(count // 2, count))
        first = work(slice(0, count // 2))
        return tuple(np.concatenate(parts) for parts in zip(first, second.result(), strict=True))


def started(
    work: Callable[Arguments, Result], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> Future[Result]:
    """Result of a call in a thread of its own, which nothing waits for but who asks for it."""
    beside = ThreadPoolExecutor(1)
    found = beside.submit(work, *args, **kwargs)
    beside.shutdown(wait=False)
    return found
