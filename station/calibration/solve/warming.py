"""Change of the sensors' depths while a booth is being calibrated, as while they warm up.

Where depths grow by a share, cameras that face each other see a thinner body. No comparison of
cameras tells that from other poses, so that only what the steps saw of the empty booth shows it
(`station.calibration.detect.warmth`).
"""

from __future__ import annotations

from collections.abc import Mapping

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


def check_warm(changes: Changes) -> None:
    """Refuse a calibration during which the sensors' depths changed.

    Raises:
        CalibrationError: by how much, and what to do.
    """
    if abs(change := _largest(changes)) > _MOST:
        raise _too_much(change)


def widen_by_warming(
    predicted: PredictedError, changes: Changes, girth_limit_m: float
) -> PredictedError:
    """Predicted errors widened by what the depths changed by: nobody knows which step's the depths
    of later scans are like.

    Raises:
        CalibrationError: girths may now err by more than the limit (95 %).
    """
    if abs(change := _largest(changes)) <= _NOISE:
        return predicted
    widened = predicted.widened(abs(change) * BODY_M)
    if SIGMAS_95 * widened.girth_sigma_m > girth_limit_m:
        raise _too_much(change)
    return widened


def warming_words(changes: Changes) -> str:
    """Advice where girths could be better known; "" where nothing speaks against them."""
    if abs(change := _largest(changes)) <= _REMARKED:
        return ""
    return (
        "for girths, let the sensors warm up for 20 minutes before the first step: all cameras "
        f"saw the booth {_percent(change)} % {where_words(change)} in one step than in an earlier "
        "one"
    )


def _largest(changes: Changes) -> float:
    """The largest change from one step to a later one that most of the cameras show; the empty
    booth is the first step."""
    cameras = {name for seen in changes.values() for name in seen}
    common = [0.0, *(common_change(s) for s in changes.values() if 2 * len(s) > len(cameras))]
    low, high = int(np.argmin(common)), int(np.argmax(common))
    return common[max(low, high)] - common[min(low, high)]


def _too_much(change: float) -> CalibrationError:
    return CalibrationError(
        f"all cameras saw the booth {_percent(change)} % {where_words(change)} in one step than in "
        "an earlier one, as sensors do that are colder or warmer: let them warm up for 20 minutes; "
        "start again with station calibrate --new"
    )


def _percent(change: float) -> str:
    return f"{100.0 * abs(change):.2f}"
