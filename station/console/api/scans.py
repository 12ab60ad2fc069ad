"""Scans: taking, listing, following, cancelling, deleting."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Query

from station.archive.records import ScanRecord, ScanState, read_noted
from station.booth.deletion import (
    NoScanError,
    forget_labels,
    labelled,
    purge_scans,
    refuse_counting,
)
from station.booth.retention import Deleted
from station.booth.session import MAX_LABEL_LENGTH
from station.console.api.console import (
    Booth,
    Caller,
    Console,
    IdempotencyKey,
    Manager,
    Reader,
    ScanId,
    Scanner,
    key_of,
    once,
)
from station.console.api.models import COMPOSED, NewScan, Removed, Scan, ScanPage
from station.console.api.problems import ProblemError, responses
from station.console.live.control import NotRunningError, command
from station.core.scans import boot_id, new_scan_id, plain_label, scan_id_of
from station.messaging.asking import RefusedError
from station.messaging.messages import Request

router = APIRouter(prefix="/scans", tags=["scans"])
_ON_DISK = ("accepted", "reconstructing", "delivered", "rescan")
_TAKEN_UP_S = 60.0
"""A scan that nobody knows of so long after it was asked for was deleted, or refused."""


@router.get("", responses=responses())
def list_scans(
    console: Booth,
    caller: Reader,  # noqa: ARG001
    text: Annotated[
        str, Query(max_length=MAX_LABEL_LENGTH, description="what label or id contains"), COMPOSED
    ] = "",
    label: Annotated[
        str | None, Query(max_length=MAX_LABEL_LENGTH, description="the whole label"), COMPOSED
    ] = None,
    since: Annotated[str, Query(max_length=40, description="ISO 8601, UTC")] = "",
    until: Annotated[str, Query(max_length=40, description="ISO 8601, UTC, excluded")] = "",
    state: Annotated[list[ScanState], Query(max_length=5)] = [],  # noqa: B006  # FastAPI copies it
    cursor: Annotated[str, Query(max_length=200, description="`next` of the page before")] = "",
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
) -> ScanPage:
    """Search by label, id, time and state; the newest first."""
    created, _, scan_id = cursor.partition(" ")
    found = console.index.find(
        text,
        label=label,
        since=since,
        until=until,
        states=state,
        before=(created, scan_id) if cursor else None,
        limit=limit,
    )
    following = f"{found[-1].created} {found[-1].scan_id}" if len(found) == limit else ""
    return ScanPage(scans=[of_record(console, record) for record in found], next=following)


@router.post("", status_code=202, responses=responses(404, 409))
def take(body: NewScan, console: Booth, caller: Scanner, key: IdempotencyKey = None) -> Scan:
    """Take a scan. With an Idempotency-Key the same request never scans twice: it tells the scan's
    state, also to a token without the scope read."""
    fresh = new_scan_id()
    mark = f"{fresh} {boot_id()} {time.monotonic():.3f}"
    first = once(console, caller, key, body.model_dump_json(), mark)
    scan_id = first.partition(" ")[0]
    if scan_id != fresh:
        # Repeated request: a finished scan is not taken again even if the station has forgotten it.
        try:
            return _state(console, scan_id)
        except ProblemError:
            # Not taken up yet: the same id is one scan, however often the station is told.
            if _age_s(first) > _TAKEN_UP_S:
                # Deleted since: it is not begun again.
                raise
    console.audit.note(caller.name, caller.address, "scan", scan_id)
    try:
        return _of_session(console.countdown.begin(scan_id, body.label, body.countdown_s))
    except (RefusedError, OSError):
        # Nothing was begun: the same request may be sent again when the reason is gone.
        if key is not None:
            console.vault.forget(key_of(caller.name, key))
        raise


@router.get("/{scan_id}", responses=responses(404))
def state(scan_id: ScanId, console: Booth, caller: Reader) -> Scan:  # noqa: ARG001
    """A scan's state, from the countdown to the result, with its timings."""
    return _state(console, scan_id)


def _age_s(mark: str) -> float:
    """Seconds since a scan was first asked for; infinite if that was before this boot."""
    _, _, made = mark.partition(" ")
    boot, _, made_s = made.partition(" ")
    return time.monotonic() - float(made_s) if boot == boot_id() else math.inf


def _state(console: Console, scan_id: str) -> Scan:
    # First what is on disk: a station whose answer came too late for the countdown took the scan.
    record = console.index.get(scan_id)
    if record is not None:
        return of_record(console, record)
    waiting = console.countdown.status(scan_id)
    if waiting is not None:
        return _of_session(waiting)
    try:
        found = _of_session(command(console.config, Request("scan-status", scan_id)))
    except RefusedError as error:
        raise ProblemError(404, "no-such-scan", str(error)) from None
    except NotRunningError:
        scan = scan_id_of(scan_id)
        noted = read_noted(console.spool, scan)
        if noted is None:
            if console.spool.notes.read(scan) is not None:
                raise  # it is not over: the station is restarting
            raise ProblemError(404, "no-such-scan", f"there is no scan {scan_id}") from None
        return of_record(console, noted)
    if found.state not in _ON_DISK:
        return found
    # On disk by now, taken away, or deleted: the disk takes precedence over the station's memory.
    return of_record(console, _taken_away(console, scan_id) or console.record(scan_id))


def _taken_away(console: Console, scan_id: str) -> ScanRecord | None:
    """A scan whose result is no longer in the outbox."""
    scan = scan_id_of(scan_id)
    return None if console.spool.where(scan) is not None else read_noted(console.spool, scan)


@router.post("/{scan_id}/cancel", responses=responses(404, 409))
def cancel(scan_id: ScanId, console: Booth, caller: Scanner) -> Scan:
    """Cancel a scan that is being taken or is waiting to be reconstructed."""
    _state(console, scan_id)
    console.audit.note(caller.name, caller.address, "cancel", scan_id)
    console.countdown.cancel(scan_id)
    return _state(console, scan_id)


@router.delete("/{scan_id}", responses=responses(404, 409))
def delete(scan_id: ScanId, console: Booth, caller: Manager) -> Removed:
    """Delete a scan, its bundle and its results permanently."""
    refuse_counting(console.countdown.counting(), scan_id=scan_id)
    return _delete(console, caller, [scan_id])


@router.delete("", responses=responses(404, 409))
def delete_label(
    label: Annotated[
        str,
        Query(min_length=1, max_length=MAX_LABEL_LENGTH, description="the whole label"),
        COMPOSED,
    ],
    console: Booth,
    caller: Manager,
) -> Removed:
    """Delete all scans with exactly this label, which is not blank."""
    refuse_counting(console.countdown.counting(), label=label)
    # As lists show it, a blank one is that of every scan without a label.
    found = labelled(console.spool, label) if plain_label(label) else []
    if not found:
        raise ProblemError(404, "no-such-scan", "there is no scan with this label")
    return _delete(console, caller, found)


def _delete(console: Console, caller: Caller, scan_ids: Sequence[str]) -> Removed:
    deleted = Deleted()
    try:
        purge_scans(console.spool, scan_ids, deleted)
    except NoScanError as error:
        raise ProblemError(404, "no-such-scan", str(error)) from None
    except OSError as error:
        words = f"{error}; {deleted.copies_words()}" if deleted.receivers else str(error)
        raise ProblemError(503, "disk", words) from None
    finally:
        for scan_id in scan_ids:
            if any(path.name.split(".")[0] == scan_id for path in deleted.paths):
                console.audit.note(caller.name, caller.address, "delete", scan_id)
        forget_labels(console.index)
    return Removed(scans=list(scan_ids), handed_over=sorted(deleted.receivers))


def of_record(console: Console, record: ScanRecord) -> Scan:
    """A scan on disk."""
    return Scan(
        scan_id=record.scan_id,
        label=record.label,
        booth=record.booth,
        state=record.state,
        verdict=record.verdict,  # type: ignore[arg-type]  # one of the four
        may_leave=record.state in _ON_DISK,
        reasons=list(record.reasons),
        created=record.created,
        finished=record.finished,
        seconds=dict(record.seconds),
        framesets=0,
        wanted=0,
        handed_over=console.ledger.receivers(record.scan_id),
    )


def _of_session(session: dict[str, Any]) -> Scan:
    """A scan known to the station, or in its countdown."""
    state = session["state"]
    return Scan(
        scan_id=session["scan_id"],
        label=session["label"],
        booth="",
        state=state,
        verdict="failed" if state == "failed" else "",
        may_leave=state in _ON_DISK,
        reasons=[session["reason"]] if session["reason"] else [],
        created="",
        finished="",
        seconds={},
        framesets=session["framesets"],
        wanted=session["wanted"],
        handed_over=[],
    )
