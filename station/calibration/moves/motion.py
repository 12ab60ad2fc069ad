"""A camera's displacement since its calibration: what it means, and in which words it is told.

A move alarms where no move within the tolerance explains what is seen. A flat wall says nothing of
a shift along itself: the covariance tells which directions this view of the booth cannot show, and
these are named instead of judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.warmth import where_words

Array = NDArray[np.float64]

MOVED_M = 0.005
MOVED_RAD = float(np.radians(0.3))
"""A camera that moved by either has to be named."""
QUIET_M = 0.002
QUIET_RAD = float(np.radians(0.15))
"""Moves up to these never alarm: the fit of the body corrects them, and warmth causes some."""
LEVER_M = MOVED_M / MOVED_RAD
"""Turns rotations into metres, so that both limits are one length."""
MIN_SHARE = 0.15
"""Less of the stored background than this tells nothing."""
_NOTHING_MET = 0.05
"""Less than this is no person, bag and chair that fill a view: it needs no second scan."""
_SAME_SHARE = 0.97
"""An unchanged booth shows all of the stored background, a person hides a third of it."""
_CERTAINTY = 2.0
"""A camera alarms if it is so many standard deviations from the nearest move within the tolerance
..."""
_NOT_STILL = 5.0
"""... if it is also so far from none at all: of a camera that stands still, in the three directions
in which errors may exceed the tolerance, once in 60,000 views, if errors are as stated."""
_HARDLY_SHOWN_M, _HARDLY_SHOWN_TIMES = 0.003, 2.0
"""Directions that are known worse than this may be wrong by so many times what is stated: the
little that shows them, edges mostly, errs alike in all scans."""
_AT_ONCE = 1.5
"""An alarm so many times what alarms needs no second scan."""
_AGREE = 16.8
"""Squared distance of two estimates of one move, in units of their covariances, that one pair in
100 exceeds."""
_POWER = 2.0
"""A move is surely noticed so many standard deviations beyond what alarms."""
_TOLD_SIGMA_M = 0.002
"""Components of a move that are known worse than this are not told."""
_ITERATIONS = 60
_SCALE = np.array([LEVER_M] * 3 + [1.0] * 3)
_SIDES = (
    ("up", "down"), ("to the right", "to the left"), ("clockwise", "anticlockwise"),
    ("to the right", "to the left"), ("down", "up"), ("forward", "backward"),
)  # fmt: skip
"""Directions in which a positive and a negative component of xi turn or shift a camera, as it
looks."""
_UNSEEN = (
    "tilt up or down", "turn to the left or right", "roll", "shift sideways", "shift up or down",
    "shift forward or back",
)  # fmt: skip
_ALONG = 0.7
"""Least share of a move, as its covariance weighs it, that a shift along the camera's axis explains
where depths changed. With 0.3 and 0.6 % in three rooms it is 0.83 to 0.97, 0.42 of a camera before
whose eyes a box stands; of cameras that moved it is 0.49 at most."""
_OBLIQUE = 0.85
"""A direction with a smaller largest component is named by its two largest."""


@dataclass(frozen=True, slots=True)
class CameraMove:
    """A camera's displacement from its calibration, estimated from the background."""

    camera: str
    xi: Array
    """(6,) rotation vector and translation: it stands at world_from_camera @ se3_exp(xi) now."""
    covariance: Array
    """(6, 6) of xi; directions that the scene does not show have a large variance."""
    share: float
    """Share of the stored background that is still seen, within what a small move explains."""
    sure: Array | None = None
    """(6, 6) covariance that holds whatever one thing in view may mislead; None: the same."""

    @property
    def lost(self) -> bool:
        """Too little of the stored background is met for any estimate."""
        return self.share < MIN_SHARE

    @property
    def moved(self) -> bool:
        """It has to be calibrated again before the next scan."""
        return not self.lost and self.alarm() > 1.0

    @property
    def changed(self) -> bool:
        """It shows no move, but a small one could be hidden by what has changed in its view."""
        return not (self.lost or self.moved) and self.share < _SAME_SHARE

    @property
    def certain(self) -> bool:
        """One scan is enough to say so."""
        return self.share < _NOTHING_MET or self.alarm() > _AT_ONCE

    def agrees(self, other: CameraMove) -> bool:
        """Whether both may be estimates of one move."""
        off = self.xi - other.xi
        return float(off @ np.linalg.solve(self.stated + other.stated, off)) < _AGREE

    @property
    def stated(self) -> Array:
        """(6, 6) covariance of the size that is told."""
        return self.covariance if self.sure is None else self.sure

    def alarm(self) -> float:
        """Distance from no move, and from the nearest within the tolerance, as a share of what
        alarms."""
        size = self.xi * _SCALE
        variances, directions = np.linalg.eigh(_in_metres(self.covariance))
        hardly_shown = variances > _HARDLY_SHOWN_M**2
        variances = variances * np.where(hardly_shown, _HARDLY_SHOWN_TIMES**2, 1.0)
        information = np.asarray(directions / variances @ directions.T)
        from_still = float(np.sqrt(size @ information @ size))
        return min(_beyond_tolerance(size, information) / _CERTAINTY, from_still / _NOT_STILL)

    def beyond(self) -> float:
        """Standard deviations from the nearest move within the tolerance."""
        information = np.asarray(np.linalg.inv(_in_metres(self.covariance)))
        return _beyond_tolerance(self.xi * _SCALE, information)

    def unseen(self) -> list[Array]:
        """Unit directions (6,) of shifts and of turns along which a camera may move by MOVED_M or
        MOVED_RAD unnoticed.

        Rotation vector times LEVER_M and translation, camera frame. A shift is also unseen if a
        turn within the tolerance would look like it, and the other way round.
        """
        information = np.linalg.inv(_in_metres(self.covariance))
        turns, shifts = slice(0, 3), slice(3, 6)
        found = []
        for mine, other, quiet, other_quiet in (
            (turns, shifts, QUIET_RAD * LEVER_M, QUIET_M),
            (shifts, turns, QUIET_M, QUIET_RAD * LEVER_M),
        ):
            bounded = information[other, other] + np.eye(3) / other_quiet**2
            cross = information[mine, other]
            own = information[mine, mine] - cross @ np.linalg.solve(bounded, cross.T)
            precisions, directions = np.linalg.eigh(own)
            sigmas = 1.0 / np.sqrt(np.maximum(precisions, 1e-12))
            needed = np.maximum(quiet + _CERTAINTY * sigmas, _NOT_STILL * sigmas) + _POWER * sigmas
            for direction in directions.T[needed > MOVED_M]:
                whole = np.zeros(6)
                whole[mine] = direction
                found.append(whole)
        return found

    def words(self) -> str:
        """The result for the operator, in one sentence."""
        if self.lost:
            return (
                f"camera {self.camera} no longer sees what it saw when it was calibrated "
                f"({100 * self.share:.0f} % of it): it was turned away, or something stands in its "
                "way"
            )
        if self.changed:
            return (
                f"camera {self.camera} shows no move, but {100 * (1.0 - self.share):.0f} % of what "
                "it saw when it was calibrated is covered or different"
            )
        if not self.moved:
            return f"camera {self.camera} stands where it was calibrated"
        known = self.known()
        if np.linalg.norm(known[:3]) < QUIET_RAD and np.linalg.norm(known[3:]) < QUIET_M:
            # So much never alarms: what does lies where the view shows too little to give a size.
            return (
                f"camera {self.camera} has moved since it was calibrated, in a direction that its "
                "view shows only roughly"
            )
        return f"camera {self.camera} has moved since it was calibrated: {move_words(known)}"

    def known(self) -> Array:
        """The move (6,) without the components that this view does not determine."""
        variances, directions = np.linalg.eigh(_in_metres(self.stated))
        told = np.sqrt(np.maximum(variances, 0.0)) < _TOLD_SIGMA_M
        size = np.where(told, directions.T @ (self.xi * _SCALE), 0.0)
        return np.asarray(directions @ size / _SCALE)

    def unseen_words(self) -> list[str]:
        """The directions of ``unseen`` in plain words."""
        return [_direction_words(direction) for direction in self.unseen()]


def _in_metres(covariance: Array) -> Array:
    """A covariance (6, 6) of rotations times LEVER_M and shifts, m^2."""
    return np.asarray(covariance * np.outer(_SCALE, _SCALE))


def depths_words(moves: Sequence[CameraMove]) -> str | None:
    """Words on a change of all sensors' depths, which looks like cameras that all moved forward, or
    all back; None where it is none.

    A Kinect's depths change with its temperature, by the same share everywhere.
    """
    fits = [_along_axis(move) for move in moves if move.moved]
    if len(fits) < max(len(moves), 2) or min(share for _, share in fits) < _ALONG:
        return None
    along_m = np.array([shift_m for shift_m, _ in fits])
    if np.any(np.sign(along_m) != np.sign(along_m[0])):
        return None
    return everything_words(-float(along_m[0]))


def everything_words(change: float) -> str:
    """Words on depths of all cameras that changed so much that no scan is taken."""
    return (
        f"all cameras see everything {where_words(change)} than when "
        "they were calibrated, as sensors do that are colder or warmer: let them warm up for 20 "
        "minutes, and try again; if nothing changes, run station calibrate"
    )


def _along_axis(move: CameraMove) -> tuple[float, float]:
    """The shift (m) along a camera's axis that explains most of its move, and the share of it.

    Shifts along a plain wall are hardly known, and say nothing against it.
    """
    information = np.linalg.inv(_in_metres(move.stated))
    size = move.xi * _SCALE
    told = float(size @ information @ size)
    shift_m = float(information[5] @ size / information[5, 5])
    return shift_m, shift_m**2 * float(information[5, 5]) / max(told, 1e-12)


def move_words(xi: Array) -> str:
    """A move (6,) in the camera frame: how far it shifted and turned, and where mostly.

    Of a shift and a turn, one that would be told as 0 is not told.
    """
    turn, shift = int(np.argmax(np.abs(xi[:3]))), 3 + int(np.argmax(np.abs(xi[3:])))
    millimetres = f"{1e3 * np.linalg.norm(xi[3:]):.0f}"
    degrees = f"{np.degrees(np.linalg.norm(xi[:3])):.1f}"
    if degrees == "0.0":
        return f"by about {millimetres} mm (mostly {_side(xi, shift)})"
    if millimetres == "0":
        return f"by about {degrees} degrees (mostly {_side(xi, turn)})"
    return (
        f"by about {millimetres} mm (mostly {_side(xi, shift)}) and {degrees} degrees "
        f"(mostly {_side(xi, turn)})"
    )


def _side(xi: Array, axis: int) -> str:
    return _SIDES[axis][int(xi[axis] < 0.0)]


def _direction_words(direction: Array) -> str:
    first, second = np.argsort(-np.abs(direction))[:2]
    if abs(direction[first]) > _OBLIQUE:
        return _UNSEEN[first]
    together = " and ".join(_side(np.sign(direction), axis) for axis in (first, second))
    return f"{'turn' if first < 3 else 'shift'} obliquely ({together}, or the opposite)"


def _beyond_tolerance(size: Array, information: NDArray[np.floating]) -> float:
    """Mahalanobis distance of a move (6,), rotations times LEVER_M, from the nearest one within the
    tolerance: a ball of turns and a ball of shifts.

    The nearest is (information + diag(a, b))^-1 information size; the multipliers a and b grow
    until both balls contain it.
    """
    limits = np.array([QUIET_RAD * LEVER_M, QUIET_M])
    multipliers = np.full(2, float(np.trace(information)) / 6.0)
    for _ in range(_ITERATIONS):
        bounded = information + np.diag(np.repeat(multipliers, 3))
        nearest = np.linalg.solve(bounded, information @ size)
        lengths = np.array([np.linalg.norm(nearest[:3]), np.linalg.norm(nearest[3:])])
        multipliers = multipliers * lengths / limits
    nearest *= np.repeat(np.minimum(1.0, limits / np.maximum(lengths, 1e-12)), 3)
    rest = size - nearest
    return float(np.sqrt(rest @ information @ rest))
