"""One scan as recorded in its folder: label, time, outcome."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from station.core.files import MAX_JSON_BYTES, read_bounded_json
from station.core.scans import CANCELLED, REASON, ScanId
from station.core.spool import Spool

ScanState = Literal["accepted", "reconstructing", "delivered", "rescan", "failed"]
PLACES: dict[str, ScanState] = {
    "queue": "accepted",
    "work": "reconstructing",
    "failed": "failed",
    "outbox": "delivered",
}
"""Folder of the spool -> state; a result in the outbox may also ask for another scan. In the order
in which a scan passes them: if a scan is in two, the later one counts."""
_UNREADABLE = "its files cannot be read"
_DAMAGED = "its result.json is missing or damaged; scan again"


@dataclass(frozen=True, slots=True)
class ScanRecord:
    """A scan on disk."""

    scan_id: str
    state: ScanState
    label: str
    booth: str
    created: str
    """UTC, ISO 8601: when its frames were taken."""
    finished: str
    """UTC, ISO 8601: when it was delivered or given up; empty before."""
    reasons: tuple[str, ...] = ()
    """Causes to scan again, or of its failure, and the verdict's remarks."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Duration of each step of the reconstruction."""

    @property
    def cancelled(self) -> bool:
        """Whether it failed because the operator cancelled it."""
        return self.state == "failed" and self.reasons == (CANCELLED,)

    @property
    def unreadable(self) -> bool:
        """Whether the disk refused to read what is told of it."""
        return any(reason.startswith(_UNREADABLE) for reason in self.reasons)

    @property
    def verdict(self) -> str:
        """ "ok", "rescan", "failed", or "" while it is not known."""
        return {"delivered": "ok", "rescan": "rescan", "failed": "failed"}.get(self.state, "")


def read_record(spool: Spool, place: str, scan_id: str) -> ScanRecord | None:
    """A scan in a folder of the spool; None when it has just left that folder."""
    folder = spool.path(place, scan_id)
    try:
        changed = _moment(folder.stat().st_mtime)
    except OSError:
        return None
    try:
        return _told(spool, place, scan_id, changed)
    except OSError as error:
        return _unread(spool, place, scan_id, changed, error)


def _told(spool: Spool, place: str, scan_id: str, changed: str) -> ScanRecord:
    """A scan as its documents tell it.

    Raises:
        OSError: the disk refuses to read one.
    """
    folder = spool.path(place, scan_id)
    if place == "outbox":
        result = _read(folder / "result.json")
        # Results of earlier versions have no label; their bundle has, while it is kept.
        bundle = {} if "label" in result else _read(spool.path("done", scan_id) / "bundle.json")
        origin = {**bundle, **result}
        known = result.get("status") in ("ok", "rescan")
        state: ScanState = "delivered" if result.get("status") == "ok" else "rescan"
        words = _reasons(result.get("reasons")) + _reasons(result.get("notes"))
        reasons = words if known else (_DAMAGED,)
        if not known and "label" not in origin and (note := spool.notes.read(ScanId(scan_id))):
            origin["label"] = note.label
        seconds = _seconds(result.get("seconds"))
    else:
        origin, state, seconds = _read(folder / "bundle.json"), PLACES[place], {}
        reason = _read(folder / REASON).get("reason")
        reasons = (_text(reason),) if state == "failed" and reason else ()
    return ScanRecord(
        scan_id=scan_id,
        state=state,
        label=_text(origin.get("label", "")),
        booth=_text(origin.get("booth", "")),
        created=_text(origin.get("created", "")) or moment_of(scan_id) or changed,
        finished=changed if place in ("outbox", "failed") else "",
        reasons=reasons,
        seconds=seconds,
    )


def _unread(spool: Spool, place: str, scan_id: str, changed: str, error: OSError) -> ScanRecord:
    """A scan whose documents the disk refuses to read, with what its note tells.

    A result is usable only if the note says so.
    """
    note = None
    with suppress(OSError):
        note = spool.notes.read(ScanId(scan_id))
    state = PLACES[place]
    if place == "outbox" and (note is None or note.verdict != "ok"):
        state = "rescan"
    return ScanRecord(
        scan_id=scan_id,
        state=state,
        label=note.label if note is not None else "",
        booth="",
        created=moment_of(scan_id) or changed,
        finished=changed if place in ("outbox", "failed") else "",
        reasons=(f"{_UNREADABLE} ({error.strerror}); check the spool's disk",),
    )


def read_noted(spool: Spool, scan_id: ScanId) -> ScanRecord | None:
    """A scan that has ended and of which the spool has nothing but the note.

    It was refused or interrupted before it had a bundle, or its result was taken away.
    """
    note = spool.notes.read(scan_id)
    if note is None or note.stage not in ("failed", "delivered"):
        return None
    try:
        changed = _moment(spool.notes.path(scan_id).stat().st_mtime)
    except OSError:
        return None
    state: ScanState = "failed" if note.stage == "failed" else "delivered"
    if note.verdict == "rescan":
        state = "rescan"
    return ScanRecord(
        scan_id=scan_id,
        state=state,
        label=note.label,
        booth="",
        created=moment_of(scan_id) or changed,
        finished=changed,
        reasons=(note.reason,) if note.reason else (),
    )


def moment_of(scan_id: str) -> str:
    """The time in a scan id (20261121T100000Z-7f3a), ISO 8601; empty if it holds none."""
    try:
        moment = datetime.strptime(scan_id.split("-")[0], "%Y%m%dT%H%M%SZ")
    except ValueError:
        return ""
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def _moment(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _text(value: object) -> str:
    """Text that any file can hold: JSON may escape half of a UTF-16 pair."""
    return str(value).encode("utf-8", "replace").decode()


def _reasons(found: object) -> tuple[str, ...]:
    return tuple(map(_text, found)) if isinstance(found, list) else ()


def _seconds(found: object) -> dict[str, float]:
    steps = found.items() if isinstance(found, dict) else ()
    return {_text(name): value for name, value in steps if isinstance(value, float)}


def _read(path: Path) -> dict[str, Any]:
    """A JSON document of a scan; empty if there is none, or it is damaged: of one damaged scan the
    others are listed.

    Raises:
        OSError: the disk refuses to read it.
    """
    try:
        document = read_bounded_json(path, MAX_JSON_BYTES)
    except (FileNotFoundError, ValueError):
        return {}
    return document if isinstance(document, dict) else {}
