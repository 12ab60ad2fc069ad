"""Names of a calibration's steps, and the numbers and heights that are written in them."""

from __future__ import annotations

from collections.abc import Mapping

EMPTY, BALL, MARK, FRONT, WALL, AROUND, STAND, HANGING = (
    "empty", "ball", "mark", "front", "wall", "around", "stand", "hanging",
)  # fmt: skip
"""Kinds of steps; those with several places are numbered: "around-0", "wall-1", and "stand-1700"
and "hanging-1800" by the height in millimetres."""
RAISED = (STAND, HANGING)
"""Steps in which the ball is at a measured height: on a stand, or hanging from a hook."""
HEIGHTS_M: Mapping[str, tuple[float, float]] = {STAND: (1.7, 0.9), HANGING: (1.8, 0.7)}
"""Heights of the raised ball's underside that serve best, the upper one first."""
RAISED_M = (0.3, 2.2)
"""Heights of the raised ball that cameras of a booth see."""
PLACES = (AROUND, *RAISED)
"""Steps of the resting ball that may be repeated elsewhere."""
_JOINT = "-"
_DIGITS = 4
"""Digits of the largest of these heights in millimetres; hundreds of them make no float."""


def kind_of(step: str) -> str:
    """Kind of a step by its name: without number or height."""
    return step.partition(_JOINT)[0]


def place_of(step: str) -> int:
    """Number of the place in the name of a step of several (AROUND, WALL)."""
    return int(step.partition(_JOINT)[2])


def numbered_step(kind: str, place: int) -> str:
    """Name of the step at one of several places (AROUND, WALL), from 0."""
    return f"{kind}{_JOINT}{place}"


def raised_height_m(step: str) -> float | None:
    """Stated height of the raised ball in a step's name, metres; None: it is not raised there.

    Raises:
        ValueError: its name does not end with a height in millimetres, or with one out of sight.
    """
    kind, _, millimetres = step.partition(_JOINT)
    if kind not in RAISED:
        return None
    written = millimetres.isdecimal() and len(millimetres) <= _DIGITS
    height_m = 1e-3 * int(millimetres) if written else 0.0
    if not RAISED_M[0] <= height_m <= RAISED_M[1] or step != raised_step(kind, height_m):
        low, high = (1e3 * height for height in RAISED_M)
        raise ValueError(
            f"{step} does not end with the height of the ball's underside in millimetres, "
            f"{low:.0f} to {high:.0f}, such as {kind}-1700"
        )
    return height_m


def raised_step(kind: str, height_m: float) -> str:
    """Name of the step in which the ball is at a height (STAND, HANGING)."""
    return f"{kind}{_JOINT}{round(1e3 * height_m)}"
