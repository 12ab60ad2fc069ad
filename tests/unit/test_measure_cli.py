"""`reconstruct measure`: meshes and results, printed as a table, CSV or JSON."""

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from station.core.errors import FormatError, InputError
from workers.export.meshes import obj_mesh, ply_mesh
from workers.export.origin import Origin
from workers.export.result import measurements_document
from workers.measure.body import measure_body, measure_standing
from workers.reconstruct.measure_cli import measure
from workers.scape.model.body_model import BodyModel
from workers.scape.verdict.verdict import Verdict

VERDICT = Verdict("rescan", ("the left arm is hidden",), (), ("hand_left", "forearm_left"))


def _run(*words: str) -> str:
    done = CliRunner().invoke(measure, list(words), catch_exceptions=False)
    assert done.exit_code == 0
    return done.output


def test_meshes_are_measured_without_a_fit(model: BodyModel, tmp_path: Path) -> None:
    (tmp_path / "mesh.ply").write_bytes(ply_mesh(model.mean, model.faces))
    (tmp_path / "mesh.obj").write_bytes(obj_mesh(model.mean, model))
    values = {row.name: row.value_m for row in measure_body(model, model.mean).rows}
    for name in ("mesh.ply", "mesh.obj"):
        document = json.loads(_run(str(tmp_path / name), "--json"))
        for row in document["measurements"]:
            assert row["value_m"] == pytest.approx(values[row["name"]], abs=1e-3), row["name"]
            assert row["interval95_m"] == [row["value_m"]] * 2
    table = _run(str(tmp_path / "mesh.ply"))
    # As pictures, the page and the printed sheet name them.
    assert "\nWaist girth " in table
    assert "\nInside leg " in table
    assert "\nVolume " in table
    # Intervals were announced, and none followed.
    assert "Values:\n" in table
    assert "interval" not in table


def test_a_results_tables_are_printed_with_their_intervals(
    model: BodyModel, tmp_path: Path
) -> None:
    sigma = np.full(model.vertex_count, 1e-3)
    state = model.neutral_state()
    for name, body in (
        ("measurements.json", measure_body(model, model.mean, sigma)),
        ("measurements-standard.json", measure_standing(model, model.mean, state, sigma)),
    ):
        document = measurements_document(Origin("s1", label="=Order 7"), body, VERDICT)
        (tmp_path / name).write_text(json.dumps(document))
    rows = list(csv.DictReader(io.StringIO(_run(str(tmp_path), "--csv", "--pose", "standard"))))
    assert [(row["name"], row["value"]) for row in rows[:4]] == [
        ("verdict", "rescan"), ("reason", "the left arm is hidden"), ("scan_id", "s1"),
        ("label", "'=Order 7"),
    ]  # fmt: skip
    numbers = [row for row in rows if row["unit"]]
    assert {row["unit"] for row in numbers} == {"m", "m3", "m2"}
    blank = {row["name"] for row in numbers if not row["value"]}
    assert {"hand_length_left", "wrist_girth_left", "sleeve_length_left"} <= blank
    assert not {"hand_length_right", "waist_girth", "height", "volume"} & blank
    assert all(
        float(row["low"]) < float(row["value"]) < float(row["high"])
        for row in numbers
        if row["value"]
    )
    assert json.loads(_run(str(tmp_path), "--json", "--pose", "standard"))["pose"] == "standard"
    table = _run(str(tmp_path)).splitlines()
    assert table[:2] == ["verdict: rescan", "reason: the left arm is hidden"]
    assert any(line.startswith("Hand length, left ") and "not measured" in line for line in table)
    both = CliRunner().invoke(measure, [str(tmp_path), "--json", "--csv"])
    assert both.exit_code == 2
    assert "not both" in both.output


def test_what_cannot_be_measured_is_refused_with_a_remedy(model: BodyModel, tmp_path: Path) -> None:
    (tmp_path / "cut.ply").write_bytes(ply_mesh(model.mean, model.faces[:-5]))
    (tmp_path / "text.obj").write_text("v one two three\n")
    whole = obj_mesh(model.mean, model).decode().splitlines()
    first = next(i for i, line in enumerate(whole) if line.startswith("v "))
    (tmp_path / "short.obj").write_text("\n".join(whole[:first] + whole[first + 1 :]))
    (tmp_path / "long.obj").write_text("\n".join([*whole, "v 0 0 1"]))
    for name, vertices in (
        ("millimetres.obj", 1e3 * model.mean),
        ("lying.obj", model.mean[:, [0, 2, 1]]),
        ("floating.obj", model.mean + np.array([0.0, 0.0, 0.5])),
    ):
        (tmp_path / name).write_bytes(obj_mesh(vertices, model))
    for source, words in (
        ("millimetres.obj", "metres were expected"),
        ("lying.obj", "another axis up"),
        ("floating.obj", "soles at 0.5"),
        ("cut.ply", "fit it first"),
        ("short.obj", "fit it first"),
        ("long.obj", "fit it first"),
        ("text.obj", "no usable mesh"),
        ("missing.ply", "not a file"),
        (".", "has no measurements.json"),
    ):
        with pytest.raises(InputError, match=words):
            CliRunner().invoke(measure, [str(tmp_path / source)], catch_exceptions=False)


@pytest.mark.parametrize(
    ("key", "content"),
    [
        ("measurements", None),
        ("measurements", [{"name": "height", "value_m": "tall", "interval95_m": [1.0, 2.0]}]),
        ("measurements", [{"name": "height", "value_m": 1.7, "interval95_m": None}]),
        ("differences", [{"name": "arm", "value_m": None, "interval95_m": None}]),
        ("volume_m3", {"value": float("nan"), "interval95": [0.0, 1.0]}),
        ("verdict", "ok"),
        ("verdict", {"status": "ok", "notes": "hair"}),
        ("label", 5),
    ],
)
def test_a_result_that_was_changed_is_refused_by_its_place(
    model: BodyModel, tmp_path: Path, key: str, content: object
) -> None:
    document = measurements_document(Origin("s1"), measure_body(model, model.mean), VERDICT)
    (tmp_path / "measurements.json").write_text(json.dumps({**document, key: content}))
    with pytest.raises(FormatError, match=f"measurements.json: {key}"):
        CliRunner().invoke(measure, [str(tmp_path)], catch_exceptions=False)
