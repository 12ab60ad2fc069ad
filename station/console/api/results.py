"""Results: files, tables, exports, comparisons. Every access is in the audit log."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Header, Query, Response
from fastapi import Path as PathParameter
from fastapi.responses import FileResponse

from station.archive.bundle_zip import MEDIA_TYPES, result_zip
from station.archive.compare import compare_rows, compare_surfaces
from station.archive.records import ScanRecord
from station.archive.sheet import sheet_pdf
from station.archive.smis import smis
from station.archive.tables import (
    Unit,
    csv_table,
    read_measurements,
    read_of_result,
    rows,
    side_differences,
)
from station.console.api.console import Booth, Caller, Console, Reader, ScanId
from station.console.api.models import Comparison, File, Measurements, Part, Quality
from station.console.api.problems import ProblemError, responses
from station.console.api.scans import of_record
from station.core.errors import FormatError
from station.core.words.tables import Pose
from station.core.words.terms import Language, part_in_words

router = APIRouter(prefix="/scans/{scan_id}", tags=["results"])
FileName = Annotated[str, PathParameter(pattern=r"^[a-z0-9][a-z0-9.-]{0,60}$")]
PoseQuery = Annotated[Pose, Query(description="as the person stood, or in the standard pose")]
UnitQuery = Annotated[Unit, Query()]
LanguageQuery = Annotated[Language, Query()]


@dataclass(frozen=True, slots=True)
class _Opened:
    """A delivered scan, its folder and its `result.json`, without which no number has a verdict."""

    record: ScanRecord
    folder: Path
    result: dict[str, Any]


def _open(console: Console, caller: Caller, scan_id: str, what: str) -> _Opened:
    record, folder = console.result(scan_id)
    console.audit.note(caller.name, caller.address, f"read {what}", scan_id)
    return _Opened(record, folder, _result(folder))


@router.get("/files", responses=responses(404, 409))
def files(scan_id: ScanId, console: Booth, caller: Reader) -> list[File]:
    """The result's files."""
    opened = _open(console, caller, scan_id, "list of files")
    hashes = opened.result.get("files", {})
    return [
        File(
            name=path.name,
            bytes=path.stat().st_size,
            sha256=str(hashes.get(path.name, "")),
            media_type=MEDIA_TYPES.get(path.suffix, "application/octet-stream"),
        )
        for path in sorted(opened.folder.iterdir())
        if path.is_file()
    ]


_ANY_FILE: dict[str, Any] = {
    media: {"schema": {"type": "string", "format": "binary"}}
    for media in sorted({*MEDIA_TYPES.values(), "application/octet-stream"})
}


@router.get(
    "/files/{name}",
    response_class=FileResponse,
    responses={
        **responses(400, 404, 409, 416),
        200: {"description": "The file", "content": _ANY_FILE},
        206: {"description": "A range of it", "content": _ANY_FILE},
        304: {"description": "The file that If-None-Match names"},
    },
)
def file(
    scan_id: ScanId,
    name: FileName,
    console: Booth,
    caller: Reader,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """One file; ranges and entity tags are understood."""
    opened = _open(console, caller, scan_id, name)
    path = opened.folder / name
    if path.is_symlink() or not path.is_file() or path.parent != opened.folder:
        raise ProblemError(404, "no-such-file", f"scan {scan_id} has no file {name}")
    digest = opened.result.get("files", {}).get(name) or f"{path.stat().st_mtime_ns:x}"
    tag = f'"{digest}"'
    known = {part.strip().removeprefix("W/") for part in (if_none_match or "").split(",")}
    if known & {tag, "*"}:
        return Response(status_code=304, headers={"etag": tag})
    media = MEDIA_TYPES.get(path.suffix, "application/octet-stream")
    return FileResponse(path, media_type=media, headers={"etag": tag, "cache-control": "no-cache"})


@router.get("/quality", responses=responses(404, 409))
def quality(scan_id: ScanId, console: Booth, caller: Reader) -> Quality:
    """Coverage of each part of the body, and whether the verdict doubts it."""
    opened = _open(console, caller, scan_id, "quality")
    parts = opened.result.get("quality", {}).get("parts", {})
    reasons = " ".join(opened.record.reasons)
    return Quality(
        verdict=opened.record.verdict,
        reasons=list(opened.record.reasons),
        parts=[
            Part(
                name=name,
                coverage=part["coverage"],
                residual_rms_m=part["residual_rms_m"],
                doubtful=re.search(rf"\b{part_in_words(name)}\b", reasons) is not None,
            )
            for name, part in parts.items()
        ],
    )


@dataclass(frozen=True, slots=True)
class _Table:
    """A scan's table of measurements as a request selects it."""

    record: ScanRecord
    document: dict[str, Any]
    pose: Pose
    unit: Unit
    language: Language


def _selected(
    scan_id: ScanId,
    console: Booth,
    caller: Reader,
    pose: PoseQuery = "as-scanned",
    unit: UnitQuery = "cm",
    language: LanguageQuery = "en",
) -> _Table:
    opened = _open(console, caller, scan_id, "measurements")
    document = read_measurements(opened.folder, pose)
    return _Table(opened.record, document, pose, unit, language)


Selected = Annotated[_Table, Depends(_selected)]


@router.get("/measurements", responses=responses(404, 409))
def measurements(table: Selected) -> Measurements:
    """The table, each row with its 95 % interval."""
    return Measurements(
        scan_id=table.record.scan_id,
        label=table.record.label,
        verdict=table.record.verdict,
        created=table.record.created,
        pose=table.pose,
        unit=table.unit,
        rows=rows(table.document, table.unit, table.language),  # type: ignore[arg-type]
        differences=side_differences(  # type: ignore[arg-type]
            table.document, table.unit, table.language
        ),
    )


def _document(media: str, what: str) -> dict[int | str, dict[str, Any]]:
    content = {media: {"schema": {"type": "string", "format": "binary"}}}
    return {**responses(404, 409), 200: {"description": what, "content": content}}


def _attached(content: bytes, media: str, name: str) -> Response:
    disposition = f'attachment; filename="{name}"'
    return Response(content, media_type=media, headers={"content-disposition": disposition})


@router.get(
    "/measurements.csv", response_class=Response, responses=_document("text/csv", "The table")
)
def measurements_csv(table: Selected) -> Response:
    """The table for a spreadsheet, in words: its verdict is "usable" or "scan again"."""
    text = csv_table(table.record, table.document, table.unit, table.language)
    name = f"{table.record.scan_id}-{table.pose}-{table.unit}.csv"
    return _attached(text.encode(), "text/csv", name)


@router.get(
    "/individual.smis",
    response_class=Response,
    responses=_document("application/xml", "SeamlyMe's individual measurements"),
)
def individual_smis(
    scan_id: ScanId, console: Booth, caller: Reader, pose: PoseQuery = "as-scanned"
) -> Response:
    """The table for SeamlyMe and Seamly2D."""
    opened = _open(console, caller, scan_id, "measurements")
    content = smis(opened.record, read_measurements(opened.folder, pose))
    return _attached(content, "application/xml", f"{scan_id}.smis")


@router.get(
    "/sheet.pdf",
    response_class=Response,
    responses=_document("application/pdf", "One A4 page"),
)
def sheet(
    scan_id: ScanId,
    console: Booth,
    caller: Reader,
    pose: PoseQuery = "as-scanned",
    unit: UnitQuery = "cm",
    language: LanguageQuery = "en",
) -> Response:
    """A printable sheet: every line drawn on the body, and the table."""
    opened = _open(console, caller, scan_id, "sheet")
    content = sheet_pdf(opened.record, opened.folder, pose, unit, language)
    name = f'inline; filename="{scan_id}.pdf"'
    return Response(content, media_type="application/pdf", headers={"content-disposition": name})


@router.get(
    "/result.zip", response_class=Response, responses=_document("application/zip", "All files")
)
def all_files(
    scan_id: ScanId,
    console: Booth,
    caller: Reader,
    unit: UnitQuery = "cm",
    language: LanguageQuery = "en",
) -> Response:
    """All files, with the tables as CSV, the sheet and the .smis beside them."""
    opened = _open(console, caller, scan_id, "all files")
    content = result_zip(opened.record, opened.folder, unit, language)
    return _attached(content, "application/zip", f"{scan_id}.zip")


@router.get("/comparison/{other}", responses=responses(404, 409))
def comparison(
    scan_id: ScanId,
    other: ScanId,
    console: Booth,
    caller: Reader,
    pose: PoseQuery = "as-scanned",
    unit: UnitQuery = "cm",
    language: LanguageQuery = "en",
) -> Comparison:
    """Difference of the other scan from this one: each measurement, and the surfaces."""
    first = _open(console, caller, scan_id, "comparison")
    second = _open(console, caller, other, "comparison")
    surfaces = compare_surfaces(first.folder, second.folder)
    return Comparison(
        first=of_record(console, first.record),
        second=of_record(console, second.record),
        pose=pose,
        unit=unit,
        rows=compare_rows(first.folder, second.folder, pose, unit, language),  # type: ignore[arg-type]
        surface_rms_m=surfaces.rms_m,
        surface_p95_m=surfaces.p95_m,
        surface_largest_m=surfaces.largest_m,
    )


@router.get(
    "/comparison/{other}/distances",
    response_class=Response,
    responses=_document(
        "application/octet-stream",
        "float32, little endian, metres: one for each vertex of this scan's mesh.ply, positive "
        "where the other body is larger",
    ),
)
def comparison_distances(
    scan_id: ScanId, other: ScanId, console: Booth, caller: Reader
) -> Response:
    """The distance map of the two surfaces."""
    first = _open(console, caller, scan_id, "comparison")
    second = _open(console, caller, other, "comparison")
    signed = compare_surfaces(first.folder, second.folder).signed_m
    return Response(signed.astype(np.dtype("<f4")).tobytes(), media_type="application/octet-stream")


def _result(folder: Path) -> dict[str, Any]:
    """The document with a result's verdict.

    Raises:
        FormatError: it is missing, damaged or without a verdict.
        DiskReadError: the disk refuses to read it.
        FileNotFoundError: the result was taken away at this moment.
    """
    document = None
    try:
        document = read_of_result(folder / "result.json")
    except OSError:
        folder.stat()  # or the result was taken away, which damages nothing
    except ValueError:
        pass
    if not isinstance(document, dict) or document.get("status") not in ("ok", "rescan"):
        raise FormatError(f"the result of {folder.name} is damaged; scan again")
    return document
