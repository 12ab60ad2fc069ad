"""Threads that are kept for halves of work."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from workers.scape.model.halves import WORTH_A_THREAD, in_halves

_FORKED = """
import os, sys
from workers.scape.model.halves import started
assert started(int, "1").result() == 1
child = os.fork()
if child == 0:
    os._exit(started(int, "7").result(20.0))
_, status = os.waitpid(child, 0)
sys.exit(os.waitstatus_to_exitcode(status))
"""


@pytest.mark.parametrize("failing", [0, 1])
def test_a_half_that_fails_is_told(failing: int) -> None:
    def work(part: slice) -> tuple[np.ndarray]:
        if (part.start > 0) == bool(failing):
            raise ValueError("half")
        return (np.zeros(1),)

    with pytest.raises(ValueError, match="half"):
        in_halves(work, WORTH_A_THREAD + 1)


def test_a_forked_process_has_threads_of_its_own() -> None:
    """It waited for those of its parent for ever."""
    done = subprocess.run([sys.executable, "-c", _FORKED], check=False, timeout=120.0)
    assert done.returncode == 7
