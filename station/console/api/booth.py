"""Logging in, the booth's state, sensors on and off, the check, the calibration."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool

from station.booth.session import MAX_LABEL_LENGTH
from station.calibration.drift.last_check import last_check
from station.calibration.guide.store import CalibrationStore, Entry
from station.console.api.console import (
    COOKIE,
    Booth,
    Caller,
    Console,
    IdempotencyKey,
    Manager,
    Reader,
    Scanner,
    caller_of,
    key_of,
    once,
)
from station.console.api.models import (
    Answer,
    BoothState,
    Calibration,
    CameraShift,
    Check,
    Delivery,
    Login,
    NewStep,
    Session,
    Streaming,
    Task,
    Unfinished,
)
from station.console.api.problems import ProblemError, responses
from station.console.live.control import command
from station.core.errors import BoothError, CalibrationError
from station.core.geometry import invert, twist_between
from station.core.rig import Rig
from station.messaging.messages import Request as ControlRequest

router = APIRouter()


@router.get("/session", responses=responses(), tags=["session"])
def session(request: Request, console: Booth) -> Session:
    """The session: its scopes, and whether a login is needed."""
    try:
        caller: Caller | None = caller_of(request)
    except ProblemError:
        caller = None
    return _session(console, caller)


@router.post("/session", responses=responses(429), tags=["session"])
async def log_in(body: Login, request: Request, response: Response, console: Booth) -> Session:
    """Log in; the session is a cookie."""
    address = request.client.host if request.client else "?"
    # Who has to wait is refused at once, and takes no thread from those who are served.
    _refuse_early(console, address)
    hours = console.config.console.session_hours
    response.set_cookie(
        COOKIE,
        await run_in_threadpool(_opened_session, console, address, body.password, hours),
        max_age=int(3600 * hours),
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
        path="/",
    )
    return _session(console, Caller("operator", address, ("read", "scan", "manage")))


def _opened_session(console: Console, address: str, password: str, hours: float) -> str:
    """The secret of a session of whoever gives the right password."""
    _check_password(console, address, password)
    console.audit.note("operator", address, "log in")
    return console.vault.open_session(hours)


def _check_password(console: Console, address: str, password: str) -> None:
    """End the request unless this is the operator's password, given not too often."""
    # Not waited for: guesses sent all at once must not hold the threads that serve everybody.
    if not console.checking.acquire(blocking=False):
        raise _too_many("others are logging in just now", 1.0)
    try:
        _refuse_early(console, address)
        if not console.vault.check_password(password):
            console.throttle.failed(address, time.monotonic())
            console.audit.note("?", address, "wrong password")
            raise ProblemError(401, "wrong-password", "the password is wrong")
        console.throttle.succeeded(address)
    finally:
        console.checking.release()


def _refuse_early(console: Console, address: str) -> None:
    """End the request of an address that has sent too many wrong passwords."""
    wait_s = console.throttle.wait_s(address, time.monotonic())
    if wait_s > 0:
        raise _too_many("too many wrong passwords", wait_s)


def _too_many(what: str, wait_s: float) -> ProblemError:
    retry = {"Retry-After": str(int(wait_s) + 1)}
    return ProblemError(429, "too-many-tries", f"{what}; wait {max(wait_s, 1.0):.0f} s", retry)


@router.delete("/session", responses=responses(), tags=["session"])
def log_out(request: Request, response: Response, console: Booth) -> Session:
    """Forget this session."""
    cookie = request.cookies.get(COOKIE)
    if cookie is not None:
        console.vault.close_session(cookie)
    response.delete_cookie(COOKIE, path="/", httponly=True, samesite="strict")
    return _session(console, None)


def _session(console: Console, caller: Caller | None) -> Session:
    config = console.config.console
    return Session(
        logged_in=caller is not None,
        password_set=console.vault.has_password,
        name=caller.name if caller else "",
        scopes=list(caller.scopes) if caller else [],
        language=config.language,
        unit=config.unit,
        countdown_s=config.countdown_s,
        recordings=config.recordings is not None,
        label_length=MAX_LABEL_LENGTH,
    )


@router.get("/booth", responses=responses(), tags=["booth"])
def booth(console: Booth, caller: Reader) -> BoothState:  # noqa: ARG001
    """Cameras with their remedies, framesets, spool, disk, calibration, hand-overs."""
    targets = _targets(console)
    return BoothState(
        **console.watch.booth(),
        calibration=_calibration_in_use(console),
        last_check=_last_check(console),
        waiting_deliveries=[
            Delivery(**entry.document())
            for entry in console.ledger.waiting()
            if entry.target in targets
        ],
    )


@router.post("/booth/hand-over", responses=responses(), tags=["booth"])
def hand_over(console: Booth, caller: Scanner, reader: Reader) -> list[Delivery]:  # noqa: ARG001
    """Try at once what waits to be handed over; what waits. Needs the scope read, too."""
    waiting = console.ledger.try_now(_targets(console))
    return [Delivery(**entry.document()) for entry in waiting]


def _targets(console: Console) -> set[str]:
    # Whom booth.toml no longer names is waited for by nobody.
    return {target.name for target in console.config.deliver}


@router.post("/booth/start", responses=responses(409), tags=["booth"])
def start(console: Booth, caller: Scanner) -> Streaming:  # noqa: ARG001
    """Sensors on; the cameras' states show when each sends frames."""
    command(console.config, ControlRequest("start"))
    return Streaming(streaming=True)


@router.post("/booth/stop", responses=responses(409), tags=["booth"])
def stop(console: Booth, caller: Scanner) -> Streaming:  # noqa: ARG001
    """Sensors off; accepted scans are still reconstructed."""
    command(console.config, ControlRequest("stop"))
    return Streaming(streaming=False)


@router.post("/booth/check", status_code=202, responses=responses(409), tags=["booth"])
def check(console: Booth, caller: Scanner, key: IdempotencyKey = None) -> Task:
    """Compare the empty booth with its calibration: starts the check, whose progress is at
    `/task`."""
    _begin_once(console, caller, key, "check", console.tasks.check)
    return Task(**console.tasks.state())


@router.get("/task", responses=responses(), tags=["calibration"])
def task(console: Booth, caller: Reader) -> Task:  # noqa: ARG001
    """The current calibration step or check, or the last one."""
    return Task(**console.tasks.state())


@router.delete("/task", responses=responses(), tags=["calibration"])
def stop_task(console: Booth, caller: Manager) -> Task:  # noqa: ARG001
    """Stop the current task; recorded data are kept."""
    return Task(**console.tasks.stop())


@router.post("/task/answer", responses=responses(409), tags=["calibration"])
def answer(body: Answer, console: Booth, caller: Manager) -> Task:  # noqa: ARG001
    """Answer "go", "yes" or "no" to the waiting task; a height is answered "yes" and `height_m`."""
    height = body.answer == "yes" and body.height_m is not None
    return Task(**console.tasks.answer(str(body.height_m) if height else body.answer))


@router.get("/calibration", responses=responses(409), tags=["calibration"])
def unfinished(console: Booth, caller: Reader) -> Unfinished:  # noqa: ARG001
    """Steps that are done of the calibration that is being done."""
    # A calibration's mathematics takes seconds to load, and few look at this.
    from station.console.live.guided import unfinished

    started, done = unfinished(console.config)
    return Unfinished(started=started, done=done)


@router.post("/calibration", status_code=202, responses=responses(409), tags=["calibration"])
def calibrate(body: NewStep, console: Booth, caller: Manager, key: IdempotencyKey = None) -> Task:
    """Start a step of the calibration, or all remaining steps."""

    def begin() -> None:
        console.audit.note(caller.name, caller.address, f"calibrate {body.step}")
        console.tasks.calibrate(body.step, body.new)

    _begin_once(console, caller, key, body.model_dump_json(), begin)
    return Task(**console.tasks.state())


def _begin_once(
    console: Console, caller: Caller, key: str | None, request: str, begin: Callable[[], object]
) -> None:
    """Begin a task, unless an idempotency key says that this request has begun it before."""
    mark = f"{time.time_ns()}"
    if once(console, caller, key, request, mark) != mark:
        return
    try:
        begin()
    except (BoothError, OSError):
        # Nothing was begun: the same request may be sent again when the reason is gone.
        if key is not None:
            console.vault.forget(key_of(caller.name, key))
        raise


@router.get("/calibrations", responses=responses(409), tags=["calibration"])
def calibrations(console: Booth, caller: Reader) -> list[Calibration]:  # noqa: ARG001
    """All stored calibrations, the newest first."""
    return [_calibration(entry) for entry in reversed(_store(console).entries())]


@router.post("/calibrations/{name}/use", responses=responses(404, 409), tags=["calibration"])
def use(name: str, console: Booth, caller: Manager) -> Calibration:
    """Put a stored calibration into use."""
    _known(console, name)
    console.audit.note(caller.name, caller.address, "use a calibration")
    return _calibration(_store(console).use(name, console.config.cameras))


@router.get(
    "/calibrations/{first}/comparison/{second}",
    responses=responses(404, 409),
    tags=["calibration"],
)
def compare(first: str, second: str, console: Booth, caller: Reader) -> list[CameraShift]:  # noqa: ARG001
    """Shift and rotation of each camera between two calibrations, relative to the reference
    camera."""
    before, after = _known(console, first).rig, _known(console, second).rig
    if before.reference not in after.cameras:
        raise ProblemError(
            409,
            "not-comparable",
            f"the calibrations cannot be compared: {second} has no camera {before.reference}",
        )
    shifts = []
    for name in before.cameras.keys() & after.cameras.keys():
        here, there = (
            invert(rig.cameras[before.reference].world_from_camera)
            @ rig.cameras[name].world_from_camera
            for rig in (before, after)
        )
        xi = twist_between(here, there)
        shifts.append(
            CameraShift(
                camera=name,
                shift_mm=round(1e3 * float(np.linalg.norm(xi[3:])), 2),
                turn_deg=round(float(np.degrees(np.linalg.norm(xi[:3]))), 3),
            )
        )
    return sorted(shifts, key=lambda shift: shift.camera)


def _calibration_in_use(console: Console) -> str:
    """Name of the stored calibration in use; of one made elsewhere its date; "" without any."""
    store = _store(console)
    name = store.name_in_use()
    if name or not store.in_use.exists():
        return name
    try:
        return Rig.load(store.in_use).created
    except (BoothError, OSError):
        return ""


def _last_check(console: Console) -> Check | None:
    check = last_check(console.config.console.folder)
    if check is None:
        return None
    # Earlier versions kept less, in files that may still be there.
    kept = {"moves": check["moved"], "changed": [], "depths": "", **check}
    return Check(**{name: kept[name] for name in Check.model_fields})


def _store(console: Console) -> CalibrationStore:
    return CalibrationStore.of(console.config)


def _known(console: Console, name: str) -> Entry:
    try:
        entries = {entry.name: entry for entry in _store(console).entries()}
    except CalibrationError as error:
        raise ProblemError(409, "not-possible", str(error)) from None
    if name not in entries:
        raise ProblemError(404, "no-such-calibration", f"there is no calibration {name}")
    return entries[name]


def _calibration(entry: Entry) -> Calibration:
    return Calibration(
        name=entry.name,
        created=entry.rig.created,
        cameras=list(entry.rig.cameras),
        residual_rms_mm=round(1e3 * entry.rig.residual_rms_m, 2),
        in_use=entry.in_use,
    )
