"""Recordings that `make demo` leaves behind."""

from __future__ import annotations

import runpy
from pathlib import Path

DEMO = Path(__file__).parents[2] / "deploy/demo.py"


def test_the_empty_booth_of_the_demo_can_be_checked_later(tmp_path: Path) -> None:
    for step in ("empty", "ball", "wall-0"):
        (tmp_path / step / "front-upper").mkdir(parents=True)
    runpy.run_path(str(DEMO))["discard"](tmp_path)
    assert [step.name for step in tmp_path.iterdir()] == ["empty"]
    assert (tmp_path / "empty/front-upper").is_dir()
