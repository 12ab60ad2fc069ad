"""`reconstruct measure`: table of a result, or of a mesh in the template's topology."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

import click
from pydantic import BaseModel, FiniteFloat, ValidationError

from station.core.commands import at_most_one
from station.core.errors import FormatError, InputError
from station.core.files import read_json
from station.core.words.tables import FILES, Pose, rounded_differences
from station.core.words.terms import plain_name

_DIGITS = 5
"""Decimals in tables: hundredths of a millimetre, far below any interval."""
_BLANK = "not measured"
_NAME_WIDTH = 34


@click.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="print JSON")
@click.option("--csv", "as_csv", is_flag=True, help="print CSV")
@click.option(
    "--pose",
    type=click.Choice(list(FILES)),
    default="as-scanned",
    show_default=True,
    help="as the person stood, or in the standard standing pose",
)
@click.option(
    "--up",
    type=click.Choice(["z", "y", "x", "-z", "-y", "-x"]),
    default="z",
    help="a mesh's upward axis",
)
def measure(source: Path, as_json: bool, as_csv: bool, pose: Pose, up: str) -> None:
    """Print the measurements of a result folder, or measure a mesh in the template's topology.

    A mesh (metres, soles on the floor) needs no fit; it counts as exact, so its intervals have no
    width.

    CSV: lines of the verdict and of the scan first, with text in the column "value"; then the rows,
    left minus right, volume and surface. Blank values are rows that could not be measured.

    \b
    Examples:
      reconstruct measure spool/outbox/20261121T100000Z-7f3a
      reconstruct measure result --pose standard --csv > standard.csv
      reconstruct measure mesh.ply --json
    """
    at_most_one(json=as_json, csv=as_csv)
    document = _of_result(source, pose) if source.is_dir() else _of_mesh(source, pose, up)
    if as_json:
        click.echo(json.dumps(document))
    elif as_csv:
        _write_csv(document)
    else:
        _print_table(document)


def _of_result(folder: Path, pose: Pose) -> dict[str, Any]:
    name = FILES[pose]
    path = folder / name
    if not path.exists() and not path.is_symlink():
        mesh = folder / "mesh.ply"
        if (folder / "bundle.json").exists():
            remedy = f"it is a scan bundle: reconstruct fit {folder} --out result"
        elif mesh.exists():
            remedy = f"measure its mesh: reconstruct measure {mesh} --pose {pose}"
        else:
            remedy = "give the folder of a result"
        raise InputError(f"{folder} has no {name}; {remedy}")
    document = read_json(path, format="booth-measurements", versions=[1])
    try:
        _Document.model_validate_json(json.dumps(document), strict=True)
    except ValidationError as cause:
        place = map(str, cause.errors()[0]["loc"])
        wrong = ".".join(part for part in place if not part.startswith("_")) or "its text"
        raise FormatError(
            f"{path}: {wrong} is missing or not as written by this program; fit the scan again"
        ) from None
    return document


class _Difference(BaseModel):
    name: str
    value_m: FiniteFloat
    interval95_m: tuple[FiniteFloat, FiniteFloat]


class _Measured(_Difference):
    basis: str | None = None
    standard: str | None = None


class _Blank(BaseModel):
    name: str
    value_m: None
    standard: str | None = None


class _Content(BaseModel):
    value: FiniteFloat
    interval95: tuple[FiniteFloat, FiniteFloat]


class _Verdict(BaseModel):
    status: str
    reasons: list[str] = []
    notes: list[str] = []


class _Document(BaseModel):
    """The parts of a result that a table shows."""

    scan_id: str | None = None
    label: str | None = None
    created: str | None = None
    booth: str | None = None
    calibration: str | None = None
    pose: str | None = None
    verdict: _Verdict | None = None
    measurements: list[_Measured | _Blank]
    differences: list[_Difference] | None = None
    volume_m3: _Content | None = None
    surface_m2: _Content | None = None


def _of_mesh(path: Path, pose: Pose, up: str) -> dict[str, Any]:
    from workers.cloud.cloud_file import read_template_mesh
    from workers.export.origin import Origin
    from workers.export.result import measurements_document
    from workers.measure.body import measure_body, measure_standing
    from workers.scape.model.body_model import load_model

    model = load_model()
    vertices = read_template_mesh(path, model.faces, up)
    if pose == "as-scanned":
        return measurements_document(Origin(path.stem), measure_body(model, vertices))
    state = model.project(vertices)
    return measurements_document(Origin(path.stem), measure_standing(model, vertices, state))


def _contents(document: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    return [
        (name, unit, document[f"{name}_{unit}"])
        for name, unit in (("volume", "m3"), ("surface", "m2"))
        if document.get(f"{name}_{unit}")
    ]


def _heading(document: dict[str, Any]) -> list[tuple[str, str]]:
    """Lines before any number: the verdict with its reasons and remarks, then the scan."""
    verdict = document.get("verdict") or {}
    lines = [("verdict", verdict["status"])] if verdict else []
    lines += [("reason", reason) for reason in verdict.get("reasons", ())]
    lines += [("remark", note) for note in verdict.get("notes", ())]
    keys = ("scan_id", "label", "created", "booth", "calibration", "pose")
    return lines + [(key, document[key]) for key in keys if document.get(key)]


def _write_csv(document: dict[str, Any]) -> None:
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(["name", "value", "low", "high", "unit", "basis", "standard"])
    for name, text in _heading(document):
        writer.writerow([name, _plain(text), "", "", "", "", ""])
    for row in document["measurements"]:
        numbers: tuple[float | str, ...] = ("", "", "")
        if row["value_m"] is not None:
            numbers = tuple(round(x, _DIGITS) for x in (row["value_m"], *row["interval95_m"]))
        writer.writerow(
            [row["name"], *numbers, "m", row.get("basis") or "", row.get("standard") or ""]
        )
    for row, value in _differences(document, 1.0, _DIGITS):
        numbers = (value, *(round(x, _DIGITS) for x in row["interval95_m"]))
        writer.writerow([f"{row['name']}_left_minus_right", *numbers, "m", "", ""])
    for name, unit, content in _contents(document):
        numbers = tuple(round(x, _DIGITS) for x in (content["value"], *content["interval95"]))
        writer.writerow([name, *numbers, unit, "", ""])


def _plain(text: str) -> str:
    """Text on one line that no spreadsheet takes for a formula."""
    line = "".join(c if c.isprintable() else " " for c in text)
    return f"'{line}" if line.startswith(("=", "+", "-", "@")) else line


def _print_table(document: dict[str, Any]) -> None:
    from workers.measure.definitions import DEFINITIONS

    words = {definition.name: definition.words for definition in DEFINITIONS}
    for name, text in _heading(document):
        click.echo(f"{name.replace('_', ' ')}: {_plain(text)}")
    exact = not any(
        row["value_m"] is not None and row["interval95_m"][0] < row["interval95_m"][1]
        for row in document["measurements"]
    )
    click.echo("Values:" if exact else "Values with 95 % intervals:")
    unseen = False
    for row in document["measurements"]:
        tail = f"{words.get(row['name'], '')}{_in_brackets(row.get('standard'))}"
        if row["value_m"] is None:
            click.echo(f"{_named(row['name'])}{_BLANK:>14}{'':<26}{tail}")
            continue
        low, high = row["interval95_m"]
        span = f"{100 * low:6.1f} to {100 * high:5.1f}" if high > low else ""
        basis = row.get("basis") or ""
        basis = "" if basis == "seen" else basis
        unseen = unseen or bool(basis)
        click.echo(
            f"{_named(row['name'])}{100 * row['value_m']:7.1f} cm  {span:<16} {basis:<9}{tail}"
        )
    if unseen:
        click.echo("partly, inferred: the cameras saw a part of this line, or hardly any of it")
    _print_differences(document)
    for name, unit, content in _contents(document):
        low, high = content["interval95"]
        span = f"{low:6.4f} to {high:6.4f}" if high > low else ""
        click.echo(f"{_named(name)}{content['value']:7.4f} {unit}  {span}")


def _differences(
    document: dict[str, Any], per_metre: float, digits: int
) -> list[tuple[dict[str, Any], float]]:
    """Differences between the sides, with their rounded values."""
    values = rounded_differences(document, per_metre, digits)
    return list(zip(document.get("differences") or (), values, strict=True))


def _print_differences(document: dict[str, Any]) -> None:
    """Differences between the sides whose interval does not contain 0."""
    certain = [
        (row, value)
        for row, value in _differences(document, 100.0, 1)
        if (ends := row["interval95_m"])[0] < ends[1] and (ends[0] > 0.0 or ends[1] < 0.0)
    ]
    if certain:
        click.echo("Differences between left and right:")
    for row, value in certain:
        side = "left" if row["value_m"] > 0.0 else "right"
        ends = sorted(map(abs, row["interval95_m"]))
        click.echo(
            f"{_named(row['name'])}{abs(value):7.1f} cm  {100 * ends[0]:6.1f} to "
            f"{100 * ends[1]:5.1f}    larger on the {side}"
        )


def _named(name: str) -> str:
    """A row's name as pictures and sheets have it, as wide as the column of names."""
    return f"{plain_name(name):<{_NAME_WIDTH}}"


def _in_brackets(standard: str | None) -> str:
    return f" ({standard})" if standard else ""
