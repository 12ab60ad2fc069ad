"""Output of `station scan`."""

import json
from pathlib import Path

import pytest

from station.booth.operator_cli import show_result


def test_a_blank_row_is_printed_as_not_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The table of a scan with a missing part ended in a traceback."""
    names = "waist_girth", "neck_shoulder_to_waist_front_right"
    values = (0.842, [0.834, 0.850]), (None, None)
    rows = [
        {"name": name, "value_m": value, "interval95_m": interval}
        for name, (value, interval) in zip(names, values, strict=True)
    ]
    (tmp_path / "measurements.json").write_text(json.dumps({"measurements": rows}))
    show_result(str(tmp_path))
    lines = capsys.readouterr().out.splitlines()
    waist, shoulder = (line for line in lines if line.startswith("  ne") or "waist_girth" in line)
    assert waist.endswith("84.2 cm    83.4 to  85.0")
    assert shoulder.endswith("not measured")
    assert waist.index("84.2") > len("  neck_shoulder_to_waist_front_right")
