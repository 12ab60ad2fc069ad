"""The ball at measured heights, on a stand or hanging: asked for, looked at, and judged while it is
still there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from station.calibration.detect.detections import BallDetection
from station.calibration.detect.step_names import (
    HANGING,
    HEIGHTS_M,
    RAISED,
    RAISED_M,
    STAND,
    kind_of,
    raised_height_m,
    raised_step,
)
from station.calibration.guide.attempt import Attempt
from station.calibration.guide.operator import Guide
from station.calibration.guide.seen import Seen, listed
from station.core.errors import CalibrationError

_HOOK = (
    "For accurate heights, the ball stands on a stand, or hangs on a string from a hook above the "
    "mark and also shows what is vertical. Does it hang?"
)
_APART_M = 0.5
"""Two heights of the ball that are nearer to each other than this say little more than one."""


def see_all_heights(attempt: Attempt, *, again: bool = False, kind: str | None = None) -> None:
    """The ball at two measured heights that the operator gives; at all that are recorded.

    ``again``: instead of those at which it was seen before; ``kind``: STAND or HANGING, or None
    to ask.
    """
    if attempt.recordings is not None:
        _see_recorded(attempt, attempt.recordings, again)
        return
    session = attempt.session_to_add_to()
    seen = {
        kind: list(session.raised_as(kind).values()) if session and not again else []
        for kind in RAISED
    }
    complete = session is not None and session.raised_enough and not again
    if complete or not attempt.guide.attended:
        return
    attempt.check_station()
    attempt.guide.title("Ball at two heights")
    begun = next((kind for kind, own in seen.items() if len(own) == 1), None)
    kind = begun or kind
    if kind is None:
        kind = HANGING if attempt.guide.answers_yes(_HOOK, usual=False) else STAND
    others_m = seen[kind] if begun else []
    best_m = list(HEIGHTS_M[kind])
    if begun:
        best_m = [max(best_m, key=lambda height_m: abs(height_m - others_m[0]))]
    while best_m:
        height_m = _measured_height(attempt.guide, kind, best_m[0], others_m)
        if height_m is None:
            return
        attempt.guide.count_down()
        if words := _see_and_keep(attempt, height_m, kind, again=again and not others_m):
            attempt.guide.say(words)
            continue
        others_m.append(height_m)
        best_m.pop(0)


def _see_recorded(attempt: Attempt, recordings: Path, again: bool) -> None:
    recorded = _recorded_heights(recordings)
    if again and not recorded:
        raise CalibrationError(
            f"{recordings} holds no recording of the ball on a stand or hanging (a folder such "
            f"as {STAND}-1700 or {HANGING}-1800)"
        )
    for kind, height_m in recorded:
        see_height(attempt, height_m, kind, again=again)
        again = False


def see_height(attempt: Attempt, height_m: float, kind: str, *, again: bool = False) -> None:
    """The ball on a stand or hanging (STAND, HANGING), its underside at a measured height above
    the floor.

    ``again``: instead of all heights before.

    Raises:
        CalibrationError: it is not seen there.
    """
    if not RAISED_M[0] <= height_m <= RAISED_M[1]:
        raise CalibrationError(_out_of_sight(height_m))
    attempt.check_station()
    if kind == HANGING:
        where = f"hanging above the mark, its underside {height_m:g} m above the floor"
        instruction = "Wait until it hangs still, and step back."
    else:
        where = f"on a stand on the mark, its underside {height_m:g} m above the floor"
        instruction = "Put it up and step back."
    attempt.guide.step(f"Ball {where}", instruction, lays=True)
    if words := _see_and_keep(attempt, height_m, kind, again=again):
        raise CalibrationError(words)
    if kind == HANGING and attempt.recordings is None:
        _ask_for_the_other(attempt)


def _see_and_keep(attempt: Attempt, height_m: float, kind: str, *, again: bool) -> str | None:
    """Keep the ball at a height; words on one that is wrong, which is not kept."""
    step = raised_step(kind, height_m)
    session, balls = attempt.see_at_rest(step)
    if words := _wrong_height(session, step, balls, attempt.config.reference):
        return words
    before = {place: raised_height_m(place) or 0.0 for place in session.raised}
    session.record_resting(step, balls)
    if again and (others := [place for place in session.raised if place != step]):
        session.forget_raised(others)
    if gone_m := sorted(before[place] for place in before.keys() - set(session.raised)):
        attempt.guide.say(f"this replaces the ball that was seen at {listed(gone_m)} m")
    return None


def _ask_for_the_other(attempt: Attempt) -> None:
    """Name the height that is missing, if the ball hung at one only."""
    session = attempt.session_to_add_to()
    own_m = list(session.raised_as(HANGING).values()) if session else []
    if len(own_m) == 1:
        upper_m, lower_m = HEIGHTS_M[HANGING]
        other_m = lower_m if own_m[0] > 0.5 * (upper_m + lower_m) else upper_m
        attempt.guide.say(
            f"now about {other_m:g} m above the floor, from the same hook, and still: two "
            "heights show what is vertical"
        )


def _out_of_sight(height_m: float) -> str:
    """Words on a height at which no camera sees the ball."""
    return (
        f"a ball at {height_m:g} m cannot be used: its height is in metres, {RAISED_M[0]:g} to "
        f"{RAISED_M[1]:g}"
    )


def _measured_height(
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
            guide.say(_out_of_sight(height_m))
        else:
            break
    return height_m


def _recorded_heights(recordings: Path) -> list[tuple[str, float]]:
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


def _wrong_height(
    seen: Seen, step: str, balls: Sequence[BallDetection], reference: str
) -> str | None:
    """Words on a height that is decimetres from where the cameras, found so far, see the ball.

    It is known while the ball is still there, and not only with the solution. None where it is
    right, or too little of the waved ball was seen.
    """
    if not seen.balls:
        return None
    from station.calibration.solve.first_problem import height_words

    raised = set(seen.raised)
    laid = {place: there for place, there in seen.around.items() if place not in raised}
    return height_words(
        replace(seen.observations(), around={**laid, step: balls}),
        seen.lensed_cameras(),
        radius_m=seen.radius_m,
        reference=reference,
    )
