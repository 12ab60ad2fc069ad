"""Change of the sensors' depths while a booth is being calibrated, as while they warm up.

A depth that is larger by a share makes cameras that face each other see a thinner body. No
comparison of cameras tells it from poses, so that only what the steps saw of the empty booth
shows it (`station.calibration.detect.warmth`).
"""

from __future__ import annotations

from collections.abc import Mapping

from station.calibration.detect.warmth import common_change
from station.core.errors import CalibrationError
from station.core.rig import PredictedError

Changes = Mapping[str, Mapping[str, float]]
"""Step -> camera -> relative change of its depths since the empty booth was recorded."""

_LARGEST, _REMARKED, _NOISE = 5e-4, 2e-4, 1e-4
"""Changes that are refused, and remarked upon, and up to which the comparison errs. Girths change
by 7 mm where depths change by 1e-3."""
_BODY_M = 1.7
"""Distance of a body from the cameras."""


def check_warm(changes: Changes) -> None:
    """Refuse a calibration during which the sensors' depths changed.

    Raises:
        CalibrationError: by how much, and what to do.
    """
    if abs(change := _largest(changes)) > _LARGEST:
        raise CalibrationError(
            f"all cameras see the empty booth {_percent(change)} % {_where(change)} than when it "
            "was recorded, as sensors do that are colder or warmer: let them warm up for 20 "
            "minutes; start again with station calibrate --new"
        )


def warming_words(changes: Changes) -> str:
    """Advice where girths could be better known; "" where nothing speaks against them."""
    if abs(change := _largest(changes)) <= _REMARKED:
        return ""
    return (
        "for girths, let the sensors warm up for 20 minutes before the first step: all cameras "
        f"saw the empty booth {_percent(change)} % {_where(change)} than when it was recorded"
    )


def widen_by_warming(predicted: PredictedError, changes: Changes) -> PredictedError:
    """Predicted errors widened by what the depths changed by: of the next scans' depths, nobody
    knows which of the steps they are like."""
    change = abs(_largest(changes))
    return predicted.widened(change * _BODY_M) if change > _NOISE else predicted


def _largest(changes: Changes) -> float:
    """The change between any two steps, the empty booth among them, that all cameras show: the
    later less the earlier, where the empty booth is the earliest."""
    common = [0.0, *map(common_change, changes.values())]
    low, high = min(common), max(common)
    return high - low if high >= -low else low - high


def _percent(change: float) -> str:
    return f"{100.0 * abs(change):.2f}"


def _where(change: float) -> str:
    return "farther away" if change > 0.0 else "nearer"
