"""Output of `station scan`."""

import json
from pathlib import Path
from typing import Any

import pytest

from station.booth.operator_cli import show_result
from station.core.errors import FormatError


def _row(name: str, value_m: float | None, half_m: float = 0.008, basis: str = "seen") -> Any:
    ends = [None, None] if value_m is None else [value_m - half_m, value_m + half_m]
    return {"name": name, "value_m": value_m, "interval95_m": ends, "basis": basis}


def test_a_result_is_printed_with_plain_names_and_both_sides_on_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        _row("waist_girth", 0.842),
        _row("neck_shoulder_to_waist_front_left", 0.441, basis="partly"),
        _row("neck_shoulder_to_waist_front_right", None),
        _row("hand_length_right", 0.19),
        _row("calf_girth_left", 0.36, basis="inferred"),
        _row("calf_girth_right", 0.37),
    ]
    document = {"format": "booth-measurements", "version": 1, "measurements": rows}
    (tmp_path / "measurements.json").write_text(json.dumps(document))
    show_result(tmp_path)
    lines = capsys.readouterr().out.splitlines()[1:]
    heading, waist, _, sides, neck, hand, calf, _, partly, inferred = lines
    assert heading.split() == ["cm", "95", "%", "interval"]
    assert waist.split() == ["Waist", "girth", "84.2", "83.4", "to", "85.0"]
    assert sides.split() == ["left", "right"]
    assert neck.endswith("44.1   43.3 to  44.9 *         -  not measured")
    assert "36.0   35.2 to  36.8 **" in calf
    for row, value in ((hand, "19.0"), (calf, "37.0")):
        assert row.index(value) + len(value) == sides.index("right") + len("right")
    assert "not measured" not in hand
    assert partly == "  * the cameras saw only a part of this line"
    assert inferred.startswith("  ** ")


def test_a_result_whose_table_is_damaged_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "measurements.json").write_text("{")
    with pytest.raises(FormatError, match="damaged"):
        show_result(tmp_path)
