"""Bodies of requests and of answers."""

from __future__ import annotations

import unicodedata
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints

from station.archive.tables import Unit
from station.booth.session import MAX_LABEL_LENGTH
from station.core.words.tables import Pose
from station.core.words.terms import Language, Side

State = Literal[
    "countdown", "armed", "capturing", "accepted", "reconstructing", "delivered", "rescan", "failed"
]
COMPOSED = BeforeValidator(
    lambda text: unicodedata.normalize("NFC", text) if isinstance(text, str) else text
)
"""Text in which a letter and its accents are one character, as in kept labels; named last, it comes
before what text may be."""
Label = Annotated[
    str,
    StringConstraints(max_length=MAX_LABEL_LENGTH, pattern=r"^[^\x00-\x1f\x7f]*$"),
    COMPOSED,
]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Login(_Strict):
    """The password that the operator types."""

    password: str = Field(max_length=1000)


class Session(BaseModel):
    """The session, and display settings of the page."""

    logged_in: bool
    password_set: bool
    name: str
    scopes: list[str]
    language: Language
    unit: Literal["cm", "in"]
    countdown_s: int
    recordings: bool = Field(description="calibrations replay recordings")
    label_length: int = Field(description="letters that a label may have")


class Camera(BaseModel):
    """One camera."""

    name: str
    state: str = Field(description="off, opening, streaming, lost or dead")
    detail: str = Field(description="what is wrong and what to do; empty if nothing is")
    frames: int
    lost: int


class Check(BaseModel):
    """The last comparison of the empty booth with its calibration."""

    time: str
    moved: list[str] = Field(description="cameras that have moved, or no longer see what they saw")
    moves: list[str] = Field(description="words on each of them")
    changed: list[str] = Field(
        description="cameras whose view looks too different to tell small moves"
    )
    depths: str = Field(description="words on depths that changed; empty if they did not")


class Delivery(BaseModel):
    """A result that waits to be handed over."""

    target: str
    scan_id: str
    tries: int = Field(description="failures; what was tried before its time is not counted")
    next_try: str
    error: str


class BoothState(BaseModel):
    """The booth now."""

    running: bool
    fault: str = Field(description="why no station answers; empty if one does")
    problems: list[str] = Field(description="what is wrong and what to do, the worst first")
    remarks: list[str] = Field(description="what scans are corrected or refused for")
    can_scan: bool = Field(
        description="nothing is in the way of a scan, other than sensors that are stopped"
    )
    compiling: bool = Field(
        description="a scan waits until the reconstruction is compiled, once on a machine"
    )
    streaming: bool
    cameras: list[Camera]
    framesets_hz: float | None
    spool: dict[str, int] = Field(
        description="scans in each folder; failed/ has the cancelled ones, too"
    )
    failed: int = Field(description="scans in failed/ that were not cancelled")
    cancelled: int = Field(description="scans in failed/ that the operator cancelled")
    disk_free_mb: float
    disk_needed_mb: float
    calibration: str = Field(description="the calibration in use, by name or date; empty: none")
    last_check: Check | None
    waiting_deliveries: list[Delivery]


class Streaming(BaseModel):
    """Whether the sensors should be on."""

    streaming: bool


class NewScan(_Strict):
    """A scan to be taken."""

    label: Label = Field(default="", description="whose scan it is, e.g. an order's number")
    countdown_s: int = Field(default=0, ge=0, le=30, description="for the person, before it")


class Scan(BaseModel):
    """One scan, from the command to the result."""

    scan_id: str
    label: str
    booth: str
    state: State
    verdict: Literal["", "ok", "rescan", "failed"]
    may_leave: bool = Field(description="the scan is on disk: the person may leave")
    reasons: list[str] = Field(description="the verdict's reasons, then its remarks")
    created: str = Field(description="ISO 8601, UTC")
    finished: str
    seconds: dict[str, float] = Field(description="duration of each step of the reconstruction")
    framesets: int
    wanted: int
    handed_over: list[str] = Field(description="targets of [[deliver]] that have a copy")


class ScanPage(BaseModel):
    """Scans, the newest first."""

    scans: list[Scan]
    next: str = Field(description="`cursor` of the next page; empty at the end")


class Removed(BaseModel):
    """The scans that were deleted."""

    scans: list[str]
    handed_over: list[str] = Field(description="targets that have copies, which stay there")


class File(BaseModel):
    """One file of a result."""

    name: str
    bytes: int
    sha256: str
    media_type: str


class Row(BaseModel):
    """One measurement."""

    name: str
    words: str
    side: Side
    value: float | None = Field(
        description="null where the part is missing in the scan, or the body has no such line"
    )
    low: float | None = Field(description="lower end of the 95 % interval")
    high: float | None
    basis: Literal["", "seen", "partly", "inferred"] = Field(
        description="whether cameras saw what was measured"
    )
    standard: str


class SideDifference(BaseModel):
    """Left less right of one measurement."""

    name: str = Field(description="of both rows, without the side")
    words: str
    value: float
    low: float = Field(description="lower end of the 95 % interval")
    high: float
    real: bool = Field(description="the interval does not hold 0")


class Measurements(BaseModel):
    """A result's table."""

    scan_id: str
    label: str
    verdict: str
    created: str
    pose: Pose
    unit: Unit
    rows: list[Row]
    differences: list[SideDifference]


class Part(BaseModel):
    """One part of the body, and how well it was seen."""

    name: str
    coverage: float
    residual_rms_m: float | None
    doubtful: bool = Field(description="whether the verdict's reasons or remarks name it")


class Quality(BaseModel):
    """Quality of a result: verdict, reasons and coverage."""

    verdict: str
    reasons: list[str]
    parts: list[Part]


class ComparedRow(BaseModel):
    """One measurement of two scans."""

    name: str
    words: str
    side: Side
    first: float
    second: float
    difference: float
    uncertainty: float = Field(description="largest difference that both 95 % intervals explain")
    real: bool = Field(description="the difference exceeds that")


class Comparison(BaseModel):
    """Comparison of two scans; surfaces as scanned, the second rigidly aligned to the first."""

    first: Scan
    second: Scan
    pose: Pose
    unit: Unit
    rows: list[ComparedRow]
    surface_rms_m: float
    surface_p95_m: float
    surface_largest_m: float


class Calibration(BaseModel):
    """A stored calibration."""

    name: str
    created: str
    cameras: list[str]
    residual_rms_mm: float
    in_use: bool


class Unfinished(BaseModel):
    """The calibration that is being done."""

    started: str = Field(description="ISO 8601, UTC; empty if none is being done")
    done: list[str] = Field(description="steps of `POST /calibration` that are done")


class CameraShift(BaseModel):
    """Shift and rotation of a camera from one calibration to another."""

    camera: str
    shift_mm: float
    turn_deg: float


class NewStep(_Strict):
    """A step of the calibration."""

    step: Literal["all", "floor", "ball", "mark", "front", "around", "stand", "depth", "solve"] = (
        "all"
    )
    new: bool = Field(
        default=False, description="start over; the unfinished calibration is abandoned but kept"
    )


class Answer(_Strict):
    """The operator's answer to a running step."""

    answer: Literal["go", "yes", "no"]
    height_m: float | None = Field(
        default=None, ge=0.3, le=2.2, description="with yes: the height that is asked for, metres"
    )


class Task(BaseModel):
    """A calibration step or a check: its messages and the answer that it is waiting for."""

    kind: str
    step: str
    running: bool
    title: str
    instruction: str
    progress: str
    question: str
    waits_for: str
    countdown_s: int | None
    lines: list[str]
    step_lines: int = Field(description="how many of the last lines are of the current step")
    error: str
