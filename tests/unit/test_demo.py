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


def test_a_demo_goes_on_after_an_interrupted_one(tmp_path: Path) -> None:
    """Its recordings, and no others, give way: record-virtual overwrites nothing."""
    clear = runpy.run_path(str(DEMO))["clear"]
    config = tmp_path / "booth.toml"
    (tmp_path / "front-upper").mkdir()
    (tmp_path / "spool").mkdir()
    config.write_text("# My booth.")
    clear(tmp_path)
    assert len(list(tmp_path.iterdir())) == 3
    config.write_text("# A virtual booth: four replayed Kinects.\n")
    clear(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["spool"]
