"""A result's measurements as tables: rows for programs, CSV for spreadsheets."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any, Literal

from station.archive.records import ScanRecord
from station.core.errors import DiskReadError, FormatError
from station.core.files import MAX_JSON_BYTES, OF_THE_DISK, read_bounded_json
from station.core.words.tables import FILES, Pose, rounded_differences
from station.core.words.terms import Language, plain_name, split_side, verdict_words

Unit = Literal["cm", "in", "m"]
PER_METRE: dict[Unit, float] = {"m": 1.0, "cm": 100.0, "in": 1 / 0.0254}
DIGITS: dict[Unit, int] = {"m": 4, "cm": 1, "in": 2}
"""Decimals of each unit; finer than any interval."""
_HEADS = {
    "en": ("order", "date", "verdict", "pose", "measurement", "side", "value", "low", "high",
           "unit", "basis", "standard"),
    "zh": ("订单", "日期", "结论", "姿势", "尺寸", "左右", "数值", "下限", "上限",
           "单位", "依据", "标准"),
}  # fmt: skip
_WORDS = {
    "en": {"as-scanned": "as scanned", "standard": "standard", "left": "left", "right": "right"},
    "zh": {"as-scanned": "扫描姿势", "standard": "标准姿势", "left": "左", "right": "右",
           "seen": "可见", "partly": "部分可见", "inferred": "推算"},
}  # fmt: skip
_MARKS: dict[str, tuple[str, dict[Language, str]]] = {
    "partly": ("*", {"en": "the cameras saw only a part of this line",
                     "zh": "相机只看到这条线的一部分"}),
    "inferred": ("**", {"en": "the cameras saw hardly any of this line; it is inferred",
                        "zh": "相机几乎没有看到这条线，为推算值"}),
}  # fmt: skip
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def read_of_result(path: Path) -> Any:
    """A JSON document in a result's folder.

    Raises:
        DiskReadError: the disk refuses to read it.
        OSError: it is not there.
        ValueError: it is no JSON.
    """
    try:
        return read_bounded_json(path, MAX_JSON_BYTES)
    except OSError as error:
        if error.errno not in OF_THE_DISK:
            raise
        words = f"{path.name} of {path.parent.name} cannot be read ({error.strerror})"
        raise DiskReadError(f"{words}; check the spool's disk") from None


def read_measurements(folder: Path, pose: Pose) -> dict[str, Any]:
    """A result's table as it lies in its folder.

    Raises:
        FormatError: it is missing, damaged or of another version.
        DiskReadError: the disk refuses to read it.
    """
    path = folder / FILES[pose]
    try:
        document = read_of_result(path)
    except OSError:
        raise FormatError(f"{folder.name} has no {path.name}; {_remedy(folder)}") from None
    except ValueError as cause:
        words = f"{path.name} of {folder.name} is damaged ({cause}); {_remedy(folder)}"
        raise FormatError(words) from None
    known = isinstance(document, dict) and document.get("format") == "booth-measurements"
    if not known or document.get("version") != 1:
        raise FormatError(
            f"{path.name} of {folder.name} is not booth-measurements version 1; {_remedy(folder)}"
        )
    return dict(document)


def _remedy(folder: Path) -> str:
    """Remedy for a result whose table cannot be read: its bundle is kept for some days."""
    kept = folder.parent.parent / "done" / folder.name
    if not (kept / "bundle.json").exists():
        return "scan again"
    return f"scan again, or in the spool's folder: reconstruct fit done/{folder.name} --out FOLDER"


def rows(document: dict[str, Any], unit: Unit, language: Language) -> list[dict[str, Any]]:
    """Each row with its plain name, side, value and 95 % interval in a unit."""
    return [_row(entry, unit, language) for entry in document["measurements"]]


def _row(entry: dict[str, Any], unit: Unit, language: Language) -> dict[str, Any]:
    name = str(entry["name"])
    # A part that is missing in the scan, or a line that the body lacks, has no value.
    known = entry["value_m"] is not None
    lengths_m = (entry["value_m"], *entry["interval95_m"]) if known else ()
    scaled = [round(PER_METRE[unit] * length, DIGITS[unit]) for length in lengths_m]
    value, low, high = scaled if known else (None, None, None)
    return {
        "name": name,
        "words": plain_name(name, language, with_side=False),
        "side": split_side(name)[1],
        "value": value,
        "low": low,
        "high": high,
        "basis": entry.get("basis") or "",
        "standard": str(entry.get("standard", "")),
    }


def printed_table(document: dict[str, Any]) -> list[str]:
    """Lines of a result's table for a terminal: centimetres, both sides beside each other."""
    listed = rows(document, "cm", "en")
    width = max((len(row["words"]) for row in listed), default=0)
    single = [row for row in listed if not row["side"]]
    lines = [f"{'':<{width}}  {'cm':>7}  95 % interval"]
    lines += [f"{row['words']:<{width}}  {_printed(row)}".rstrip() for row in single]
    heading = {"left": f"{'left':>7}", "right": f"{'right':>7}"}
    sides: dict[str, dict[str, str]] = {"": heading}
    for row in listed:
        if row["side"]:
            sides.setdefault(row["words"], {})[row["side"]] = _printed(row)
    column = max(len(of.get("left", "")) for of in sides.values())
    both = [
        f"{words:<{width}}  {of.get('left', ''):<{column}}  {of.get('right', '')}".rstrip()
        for words, of in sides.items()
    ]
    if len(both) > 1:
        lines += ["", *both]
    notes = notes_on_marks(listed, "en")
    return [*lines, "", *notes] if notes else lines


def mark_of(row: dict[str, Any]) -> str:
    """Mark of a row of whose line the cameras did not see all; empty for others."""
    return _MARKS[row["basis"]][0] if row["basis"] in _MARKS else ""


def notes_on_marks(listed: list[dict[str, Any]], language: Language) -> list[str]:
    """Meanings of the marks of these rows, one sentence each."""
    used = {row["basis"] for row in listed}
    return [f"{mark} {words[language]}" for basis, (mark, words) in _MARKS.items() if basis in used]


def _printed(row: dict[str, Any]) -> str:
    """A value with its interval; a mark where the cameras did not see all of the line."""
    if row["value"] is None:
        return f"{'-':>7}  not measured"
    return f"{row['value']:7.1f}  {row['low']:5.1f} to {row['high']:5.1f} {mark_of(row):<2}"


def side_differences(
    document: dict[str, Any], unit: Unit, language: Language
) -> list[dict[str, Any]]:
    """Left less right of each measurement with two sides, with its 95 % interval in a unit.

    `real` says that the interval does not hold 0. Results of earlier versions have none.
    """
    per_metre, digits = PER_METRE[unit], DIGITS[unit]
    found = []
    values = rounded_differences(document, per_metre, digits)
    for entry, value in zip(document.get("differences") or (), values, strict=True):
        low_m, high_m = entry["interval95_m"]
        found.append(
            {
                "name": str(entry["name"]),
                "words": plain_name(f"{entry['name']}_left", language, with_side=False),
                "value": value,
                "low": round(per_metre * low_m, digits),
                "high": round(per_metre * high_m, digits),
                "real": low_m > 0.0 or high_m < 0.0,
            }
        )
    return found


def csv_table(scan: ScanRecord, document: dict[str, Any], unit: Unit, language: Language) -> str:
    """A line for each measurement, each with the order, the date, the verdict and the pose.

    Begins with a byte order mark: without one, spreadsheets misread UTF-8.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\r\n")
    writer.writerow(_HEADS[language])
    words = _WORDS[language]
    verdict, pose = verdict_words(scan.verdict, language), words[document["pose"]]
    for row in rows(document, unit, language):
        side, basis = words.get(row["side"], ""), words.get(row["basis"], row["basis"])
        texts = (scan.label or scan.scan_id, scan.created, verdict, pose, row["words"], side)
        numbers = ("" if row[key] is None else row[key] for key in ("value", "low", "high"))
        writer.writerow([*map(_harmless, texts), *numbers, unit, basis, row["standard"]])
    return "\ufeff" + stream.getvalue()


def _harmless(text: str) -> str:
    """A label is arbitrary text: a spreadsheet must not interpret it as a formula, and many readers
    of CSV end at a zero or take a line break for the end of a row."""
    line = "".join(c if c.isprintable() else " " for c in text)
    return f"'{line}" if text.startswith(_FORMULA) else line
