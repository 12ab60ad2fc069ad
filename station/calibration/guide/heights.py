"""Heights of the raised ball: as an operator measures them, as recordings name them, and as the
cameras see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from station.calibration.detect.detections import BallDetection
from station.calibration.detect.step_names import (
    HANGING,
    HEIGHTS_M,
    RAISED_M,
    STAND,
    kind_of,
    raised_height_m,
)
from station.calibration.guide.operator import Guide
from station.calibration.guide.seen import Seen
from station.core.errors import CalibrationError

HOOK = (
    "For accurate heights, the ball stands on a stand, or hangs on a string from a hook above the "
    "mark and also shows what is vertical. Does it hang?"
)
_APART_M = 0.5
"""Two heights of the ball that are nearer to each other than this say little more than one."""


def out_of_sight(height_m: float) -> str:
    """Words on a height at which no camera sees the ball."""
    return (
        f"a ball at {height_m:g} m cannot be used: its height is in metres, {RAISED_M[0]:g} to "
        f"{RAISED_M[1]:g}"
    )


def measured_height(
    guide: Guide, kind: str, about_m: float, others_m: Sequence[float]
) -> float | None:
    """Height (m) that the operator gives, not near one that was seen; None if left out."""
    if kind == STAND:
        where = (
            f"Now about {about_m:g} m above the floor: a wrong measurement shows."
            if others_m
            else f"Put the ball on a stand on the mark, about {about_m:g} m above the floor."
        )
    else:
        where = (
            f"Now about {about_m:g} m above the floor, from the same hook, and still."
            if others_m
            else f"Hang the ball above the mark, about {about_m:g} m above the floor, and wait "
            "until it hangs still."
        )
    while (height_m := guide.height_m(f"{where} How high is its underside?")) is not None:
        near_m = [other for other in others_m if abs(other - height_m) < _APART_M]
        if near_m:
            guide.say(
                f"{height_m:g} m is too near to {near_m[0]:g} m, at which it was seen already: "
                f"change its height by {_APART_M:g} m or more"
            )
        elif not RAISED_M[0] <= height_m <= RAISED_M[1]:
            guide.say(out_of_sight(height_m))
        else:
            break
    return height_m


def recorded_heights(recordings: Path) -> list[tuple[str, float]]:
    """Kind (STAND, HANGING) and height (m) of each recorded step of the raised ball.

    Raises:
        CalibrationError: a folder's name has no height, or the ball hangs at more than two.
    """
    found = []
    for folder in sorted(path for path in recordings.glob("*-*") if path.is_dir()):
        try:
            height_m = raised_height_m(folder.name)
        except ValueError as cause:
            raise CalibrationError(f"{folder} cannot be used: {cause}") from None
        if height_m is not None:
            found.append((kind_of(folder.name), height_m))
    hung = sum(kind == HANGING for kind, _ in found)
    if hung > len(HEIGHTS_M[HANGING]):
        raise CalibrationError(
            f"{recordings} holds {hung} heights of the hanging ball: keep two, from one hook"
        )
    return found


def wrong_height(
    seen: Seen, step: str, balls: Sequence[BallDetection], reference: str
) -> str | None:
    """Words on a height that is decimetres from where the cameras, found so far, see the ball.

    It is known while the ball is still there, and not only with the solution. None where it is
    right, or too little of the waved ball was seen.
    """
    if not seen.balls:
        return None
    from station.calibration.solve import solution

    raised = set(seen.raised)
    laid = {place: there for place, there in seen.around.items() if place not in raised}
    return solution.height_words(
        replace(seen.observations(), around={**laid, step: balls}),
        seen.lensed_cameras(),
        radius_m=seen.radius_m,
        reference=reference,
    )
