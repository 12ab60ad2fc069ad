"""Compilation of the reconstruction is told to whoever waits for it, and nothing else is."""

from __future__ import annotations

from pathlib import Path

import numba
import pytest
from click.testing import CliRunner

from station.core.commands import COMPILING
from workers.reconstruct import job
from workers.reconstruct.compiling import compilation_told
from workers.reconstruct.fit_cli import fit


def test_compilation_is_told_once() -> None:
    told: list[str] = []
    one, other = (numba.njit(lambda value, more=more: value + more) for more in (1, 2))
    one(0)
    with compilation_told(lambda: told.append("compiling")):
        one(1)
        assert told == []
        other(1)
        one(1.0)
    other(1.0)
    assert told == ["compiling"]


@pytest.mark.parametrize("quiet", [True, False])
def test_a_first_fit_says_what_it_waits_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, quiet: bool
) -> None:
    """It said nothing for a minute."""

    def first(*_: object, **__: object) -> job.JobSummary:
        return job.JobSummary(str(numba.njit(lambda value: value)("ok")), ())

    monkeypatch.setattr(job, "reconstruct_bundle", first)
    words = [str(tmp_path), "--out", str(tmp_path / "result"), *(["--quiet"] if quiet else [])]
    done = CliRunner().invoke(fit, words, catch_exceptions=False)
    assert (COMPILING in done.output) == (not quiet)
