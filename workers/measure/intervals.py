"""95 % intervals of measurements, from a calibrated model of their errors.

An ordinary scan of a body of the model's own family has errors of a size that is known for each
row. To this the scan adds its own uncertainty:

    half width = sqrt(constant^2 + (gain sigma)^2 + (noise_gain noise)^2 + (1.96 further)^2),

where sigma is the standard deviation of the surface in excess of an ordinary scan's, rms along the
row's line (`workers.scape.surface.uncertainty`), `noise` that of the readings
(`workers.cloud.noise`), and `further` is a standard deviation that concerns the whole scan: the
calibration's own statement of its errors, and a top of the head that no camera saw.

`constant` and the row's systematic error `bias` are learned from scans of held-out bodies of the
family (conformal calibration: Vovk, Gammerman & Shafer 2005, chapter 4), `gain` from scans of
sculpted bodies by a sensor whose errors differ from those that the fit assumes, `noise_gain` from
scans by a sensor with noise that stays from frame to frame, so that an interval contains the truth
in 95 of 100 cases of each. As scanned, the bias shifts only the interval,
since a value is the length of its line. In the standard pose, which no camera saw, the bias is the
mean error of re-posing the body, and it is subtracted from the value.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from station.core.errors import FormatError
from station.core.words.tables import Pose
from workers.measure.scan_errors import NORMAL_QUANTILE, ScanErrors, line_sigma
from workers.measure.tracing import Trace

Array = NDArray[np.float64]

FORMAT = "booth-intervals"
VERSION = 2
SHIPPED = "data/intervals.json"
COVERAGE = 0.95
_MIN_CONSTANT = 0.7
"""Floor of the constant, as a share of what it is without the family's own sigmas: an ordinary scan
with none of them is no better than that."""
_MIN_SIGMA_M = 2e-4
"""Floor of the standard deviations that a gain is learned from."""
_OUTLIER = 6.0
"""Median absolute deviations beyond which an error does not count to the spread."""


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Error of one row in one pose, in metres; for volume and surface as a share of the value."""

    bias: float
    constant: float
    gain: float
    noise_gain: float

    def interval(
        self, value: float, sigma: float, noise: float = 0.0, further: float = 0.0
    ) -> tuple[float, float]:
        """95 % interval of a value whose line has the standard deviation `sigma`.

        It always contains the value and no negative length.

        Args:
            noise: standard deviation of the readings in excess of an ordinary scan's, metres.
            further: standard deviation that concerns the whole scan.
        """
        parts = (self.constant, self.gain * sigma, self.noise_gain * noise)
        half = float(np.linalg.norm((*parts, NORMAL_QUANTILE * further)))
        middle = value - self.bias
        # What is not a number stays so, unlike in the interpreter's own min and max.
        low, high = np.minimum(value, middle - half), np.maximum(value, middle + half)
        return float(np.maximum(0.0, low)), float(high)


@dataclass(frozen=True, slots=True)
class RowErrors:
    """Errors (n,) of one row on n scans of known bodies, the standard deviations (n,) of its lines
    in these scans, and those (n,) of the readings in excess of an ordinary scan's."""

    errors: Array
    sigmas: Array
    noises: Array


def learned(family: RowErrors, unlike: RowErrors, noisy: RowErrors) -> ErrorModel:
    """Error model of a row from scans of the model's own family, of bodies unlike it, and of the
    family by sensors with noise that stays.

    The bias is that of the family, shrunk by its own uncertainty (James & Stein 1961, positive
    part), so that noise of the calibration is not taken for a systematic error. The constant is the
    conformal quantile of the family's errors. The gains explain the mean square of the other
    scans' errors beyond the family's, by Student's t for their number.
    """
    bias = _shrunk_mean(family.errors)
    ordinary = np.square(family.errors - bias)
    usual = float(np.mean(ordinary))
    gain = _gain(unlike.errors - bias, usual, unlike.sigmas)
    noise_gain = _gain(noisy.errors - bias, usual, noisy.noises)
    left = np.sqrt(np.maximum(ordinary - np.square(gain * family.sigmas), 0.0))
    constant = max(
        _conformal_quantile(left), _MIN_CONSTANT * _conformal_quantile(np.sqrt(ordinary))
    )
    return ErrorModel(bias, constant, gain, noise_gain)


def _gain(errors: Array, usual: float, sigmas: Array) -> float:
    """Half width of a 95 % interval per standard deviation that explains the errors' mean square
    beyond the usual one."""
    beyond = max(float(np.mean(errors**2)) - usual, 0.0)
    strangeness = max(float(np.mean(sigmas**2)), _MIN_SIGMA_M**2)
    student = float(stdtrit(len(errors) - 1, 0.5 + 0.5 * COVERAGE))
    return student * float(np.sqrt(beyond / strangeness))


def _conformal_quantile(sizes: Array) -> float:
    """Bound that the next of n + 1 exchangeable errors keeps with the probability `COVERAGE` (Vovk,
    Gammerman & Shafer 2005, chapter 4): that of the n sizes alone holds it less often. The largest
    where n < 19, which is not enough."""
    count = len(sizes)
    return float(np.quantile(sizes, min(COVERAGE * (count + 1) / count, 1.0)))


def _shrunk_mean(errors: Array) -> float:
    middle = float(np.median(errors))
    spread = float(np.median(np.abs(errors - middle)))
    kept = np.abs(errors - middle) <= _OUTLIER * spread
    mean = float(errors[kept].mean())
    doubt = float(errors[kept].var(ddof=1)) / int(kept.sum())
    return mean * max(0.0, 1.0 - doubt / max(mean**2, 1e-30))


@lru_cache(maxsize=1)
def shipped() -> Mapping[Pose, Mapping[str, ErrorModel]]:
    """Error models that come with the package, by pose and row.

    Raises:
        FormatError: the file is damaged or of another version.
    """
    text = resources.files("workers.measure").joinpath(SHIPPED).read_text(encoding="utf-8")
    return from_document(json.loads(text))


def from_document(document: Mapping[str, Any]) -> Mapping[Pose, Mapping[str, ErrorModel]]:
    """Error models of an intervals.json document."""
    if document.get("format") != FORMAT or document.get("version") != VERSION:
        raise FormatError(
            f"{SHIPPED} is {document.get('format')!r} version {document.get('version')!r}; "
            f"this program reads {FORMAT} version {VERSION}"
        )
    return {
        pose: {name: ErrorModel(**row) for name, row in rows.items()}
        for pose, rows in document["poses"].items()
    }


def to_document(
    models: Mapping[Pose, Mapping[str, ErrorModel]], made_of: Mapping[str, Any]
) -> dict[str, Any]:
    """Document of intervals.json; `made_of` names the scans and the model it was learned from."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "made_of": dict(made_of),
        "poses": {
            pose: {
                name: {
                    "bias": round(model.bias, 6),
                    "constant": round(model.constant, 6),
                    "gain": round(model.gain, 4),
                    "noise_gain": round(model.noise_gain, 4),
                }
                for name, model in rows.items()
            }
            for pose, rows in models.items()
        },
    }


def write_shipped(
    family: Mapping[Pose, Mapping[str, RowErrors]],
    unlike: Mapping[Pose, Mapping[str, RowErrors]],
    noisy: Mapping[Pose, Mapping[str, RowErrors]],
    made_of: Mapping[str, Any],
) -> Path:
    """Learn the error models of all rows and write them as the package's data.

    Args:
        family: errors by pose and row (`sides_pooled`) on bodies of the model's own family.
        unlike: the same on bodies unlike it.
        noisy: the same on the family before sensors with noise that stays.
        made_of: splits, numbers of bodies and the model's SHA-256.
    """
    models = {
        pose: {
            name: learned(one, unlike[pose][name], noisy[pose][name]) for name, one in rows.items()
        }
        for pose, rows in family.items()
    }
    path = Path(str(resources.files("workers.measure").joinpath(SHIPPED)))
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(to_document(models, made_of), indent=1) + "\n", encoding="utf-8")
    return path


def sides_pooled(name: str) -> str:
    """Name of a row without its side: left and right share one error model."""
    return name.removesuffix("_left").removesuffix("_right")


def row_values(traces: Sequence[Trace], pose: Pose) -> list[float]:
    """Value (m) of each row, never negative; NaN where the body has no such line."""
    if pose == "as-scanned":
        return [trace.value_m for trace in traces]
    return [float(np.maximum(0.0, trace.value_m - _model_of(trace, pose).bias)) for trace in traces]


def intervals(
    traces: Sequence[Trace],
    values: Sequence[float],
    vertex_sigma_m: Array | None,
    pose: Pose,
    scan_errors: ScanErrors,
) -> list[tuple[float, float]]:
    """95 % interval of each row.

    Args:
        values: as `row_values` gives them.
        vertex_sigma_m: (P,), the fit's standard deviations; None for a mesh that counts as exact.
    """
    if vertex_sigma_m is None:
        return [(value, value) for value in values]
    found = []
    for trace, value in zip(traces, values, strict=True):
        model = _model_of(trace, pose)
        if pose == "standard":
            model = replace(model, bias=0.0)
        sigma = line_sigma(trace, vertex_sigma_m)
        further = float(np.hypot(scan_errors.of(trace.definition), scan_errors.of_skin(trace)))
        found.append(model.interval(value, sigma, scan_errors.excess_noise_m, further))
    return found


def _model_of(trace: Trace, pose: Pose) -> ErrorModel:
    name = sides_pooled(trace.definition.name)
    try:
        return shipped()[pose][name]
    except KeyError:
        raise FormatError(f"{SHIPPED} has no row {name}; learn it with: make intervals") from None


def content_interval(
    name: str,
    value: float,
    vertex_sigma_m: Array | None,
    pose: Pose,
    noise_m: float = 0.0,
    further: float = 0.0,
) -> tuple[float, float]:
    """95 % interval of a volume or a surface, whose error is a share of the value.

    Args:
        noise_m: standard deviation of the readings in excess of an ordinary scan's.
        further: standard deviation that concerns the whole scan, a share of the value.
    """
    if vertex_sigma_m is None:
        return value, value
    sigma = content_sigma(vertex_sigma_m)
    low, high = shipped()[pose][name].interval(1.0, sigma, noise_m, further)
    return value * low, value * high


def content_sigma(vertex_sigma_m: Array) -> float:
    """Standard deviation (m) of the surface, rms over all vertices (P,)."""
    return float(np.sqrt(np.mean(vertex_sigma_m**2)))
