"""Change of the sensors' depths while a booth is being calibrated, as while they warm up.

Where depths grow by a share, cameras that face each other see a thinner body. No comparison of
cameras tells that from other poses, so that only what the steps saw of the empty booth shows it
(`station.calibration.detect.warmth`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from station.calibration.detect.warmth import BODY_M, common_change, where_words
from station.calibration.solve.refusals import SIGMAS_95
from station.core.errors import CalibrationError
from station.core.rig import PredictedError

Changes = Mapping[str, Mapping[str, float]]
"""Step -> camera -> relative change of its depths since the empty booth was recorded; the steps in
the order in which they were done."""

_MOST, _REMARKED, _NOISE = 5e-4, 2e-4, 1e-4
"""Changes by which girths are wrong that are stated to a few millimetres (7 mm for 0.1 %), that are
remarked upon, and up to which the comparison errs."""
_MOST_ALONE, _NOISE_ALONE = 7.5e-4, 2e-4
"""The same of one camera alone, against the others: girths were 3.4 mm wrong for 0.1 %; its noise
is up to 0.008 % either way."""
_SHARE_ALONE = 0.5
"""Share of a common change's effect on girths that the same change of one camera has."""


def check_warm(changes: Changes) -> None:
    """Refuse a calibration during which the sensors' depths changed, or those of one of them.

    Raises:
        CalibrationError: by how much, and what to do.
    """
    if abs(change := _largest(changes)) > _MOST:
        raise _too_much(change)
    name, change = _alone(changes)
    if abs(change) > _MOST_ALONE:
        raise _too_much_alone(name, change)


def widen_by_warming(
    predicted: PredictedError, changes: Changes, girth_limit_m: float
) -> PredictedError:
    """Predicted errors widened by what the depths changed by: nobody knows which step's the depths
    of later scans are like.

    Raises:
        CalibrationError: girths may now err by more than the limit (95 %).
    """
    if abs(change := _largest(changes)) > _NOISE:
        predicted = predicted.widened(abs(change) * BODY_M)
        if SIGMAS_95 * predicted.girth_sigma_m > girth_limit_m:
            raise _too_much(change)
    name, change = _alone(changes)
    if abs(change) > _NOISE_ALONE:
        predicted = predicted.widened(_SHARE_ALONE * abs(change) * BODY_M)
        if SIGMAS_95 * predicted.girth_sigma_m > girth_limit_m:
            raise _too_much_alone(name, change)
    return predicted


def warming_words(changes: Changes) -> str:
    """Advice where girths could be better known; "" where nothing speaks against them."""
    if abs(change := _largest(changes)) > _REMARKED:
        return (
            "for girths, let the sensors warm up for 20 minutes before the first step: all cameras "
            f"saw the booth {_percent(change)} % {where_words(change)} in one step than in an "
            "earlier one"
        )
    name, change = _alone(changes)
    if abs(change) > _NOISE_ALONE:
        return (
            f"for girths, fasten camera {name} and let all sensors warm up before the first step: "
            f"compared with most of the others, it saw the booth {_percent(change)} % "
            f"{where_words(change)} in one step than in an earlier one"
        )
    return ""


def _largest(changes: Changes) -> float:
    """The largest change from one step to a later one that most of the cameras show."""
    return _span([common_change(seen) for seen in _compared(changes)])


def _alone(changes: Changes) -> tuple[str, float]:
    """The camera whose depths changed most from one step to a later one, against what most of the
    cameras show, and by how much."""
    found: dict[str, list[float]] = {}
    for seen in _compared(changes):
        for name, change in seen.items():
            found.setdefault(name, []).append(change - common_change(seen))
    spans = {name: _span(own) for name, own in found.items()}
    name = max(spans, key=lambda one: abs(spans[one]), default="")
    return name, spans.get(name, 0.0)


def _compared(changes: Changes) -> list[Mapping[str, float]]:
    """Changes of the cameras in each step in which more than half of them show one."""
    cameras = {name for seen in changes.values() for name in seen}
    return [seen for seen in changes.values() if 2 * len(seen) > len(cameras)]


def _span(changed: Sequence[float]) -> float:
    """The largest change from one step to a later one; the empty booth is the first step."""
    every = [0.0, *changed]
    low, high = int(np.argmin(every)), int(np.argmax(every))
    return every[max(low, high)] - every[min(low, high)]


def _too_much(change: float) -> CalibrationError:
    return CalibrationError(
        f"all cameras saw the booth {_percent(change)} % {where_words(change)} in one step than in "
        "an earlier one, as sensors do that are colder or warmer: let them warm up for 20 minutes; "
        "start again with station calibrate --new"
    )


def _too_much_alone(name: str, change: float) -> CalibrationError:
    return CalibrationError(
        f"camera {name}, compared with most of the others, saw the booth {_percent(change)} % "
        f"{where_words(change)} in one step than in an earlier one: it was moved, or it warms up "
        "or cools down; fasten it, and let all sensors warm up for 20 minutes; start again with "
        "station calibrate --new"
    )


def _percent(change: float) -> str:
    return f"{100.0 * abs(change):.2f}"
