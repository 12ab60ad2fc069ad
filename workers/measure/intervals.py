"""95 % intervals of measurements, from a calibrated model of their errors.

The error of a row has two causes: the error of the surface, whose standard deviation the fit gives
for each vertex, and landmarks that slide along the skin from fit to fit, which it does not know. So

    half width = sqrt(constant^2 + (gain sigma)^2),

where sigma is the posterior standard deviation, rms along the row's line. `constant`, `gain` and
the row's systematic error `bias` are learned from scans of held-out bodies with known dimensions
(conformal calibration: Vovk, Gammerman & Shafer 2005, chapter 4), so that an interval contains the
truth in 95 of 100 cases. As scanned, the bias shifts only the interval, since a value is the length
of its line. In the standard pose, which no camera saw, the bias is the mean error of re-posing the
body, and it is subtracted from the value.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from station.core.errors import FormatError
from workers.measure.tracing import Trace

Array = NDArray[np.float64]
Pose = Literal["as-scanned", "standard"]

FORMAT = "booth-intervals"
VERSION = 1
SHIPPED = "data/intervals.json"
COVERAGE = 0.95
_RATIOS = (0.0, 0.3, 0.6, 1.0, 1.7, 3.0)
"""Candidates for the ratio of gain times median sigma to constant."""
_OUTLIER = 6.0
"""Median absolute deviations beyond which an error does not count to the spread."""
_NORMAL_MAD = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Error of one row in one pose, in metres; for volume and surface as a share of the value."""

    bias: float
    constant: float
    gain: float

    def interval(self, value: float, sigma: float) -> tuple[float, float]:
        """95 % interval of a value whose line has the standard deviation `sigma`.

        It always contains the value and no negative length.
        """
        half = float(np.hypot(self.constant, self.gain * sigma))
        middle = value - self.bias
        return max(0.0, min(value, middle - half)), max(value, middle + half)


def line_sigma(trace: Trace, vertex_sigma_m: Array) -> float:
    """Posterior standard deviation (m) of the surface, rms along a row's line."""
    tail, head = vertex_sigma_m[trace.points.tail], vertex_sigma_m[trace.points.head]
    along = tail + trace.points.share * (head - tail)
    return float(np.sqrt(np.mean(along**2)))


def learned(errors: Array, sigmas: Array) -> ErrorModel:
    """Error model of a row from the errors (n,) of held-out scans and their line sigmas (n,).

    The bias is shrunk by its own uncertainty (James & Stein 1961, positive part), so that noise of
    the calibration is not taken for a systematic error. The ratio of gain to constant is the one of
    highest likelihood; their size is the conformal quantile.
    """
    middle = float(np.median(errors))
    spread = _NORMAL_MAD * float(np.median(np.abs(errors - middle)))
    kept = np.abs(errors - middle) <= _OUTLIER * spread / _NORMAL_MAD
    mean = float(errors[kept].mean())
    doubt = float(errors[kept].var(ddof=1)) / int(kept.sum())
    bias = mean * max(0.0, 1.0 - doubt / max(mean**2, 1e-30))
    residual = errors - bias
    typical = max(float(np.median(sigmas)), 1e-9)
    best, most = _RATIOS[0], -np.inf
    for ratio in _RATIOS:
        shape = np.hypot(1.0, ratio * sigmas / typical)[kept]
        scaled = residual[kept] / shape
        likelihood = -len(scaled) * np.log(np.sqrt(np.mean(scaled**2))) - np.log(shape).sum()
        if likelihood > most + 1e-9:
            best, most = ratio, float(likelihood)
    scaled = np.sort(np.abs(residual) / np.hypot(1.0, best * sigmas / typical))
    rank = min(len(scaled), int(np.ceil(COVERAGE * (len(scaled) + 1))))
    constant = float(scaled[rank - 1])
    return ErrorModel(bias, constant, constant * best / typical)


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
                }
                for name, model in rows.items()
            }
            for pose, rows in models.items()
        },
    }


def write_shipped(
    errors: Mapping[Pose, Mapping[str, tuple[Sequence[float], Sequence[float]]]],
    made_of: Mapping[str, Any],
) -> Path:
    """Learn the error models of all rows and write them as the package's data.

    Args:
        errors: by pose and row (`sides_pooled`), the errors of scans and their line sigmas.
        made_of: split, number of bodies and the model's SHA-256.
    """
    models = {
        pose: {name: learned(np.array(e), np.array(s)) for name, (e, s) in rows.items()}
        for pose, rows in errors.items()
    }
    path = Path(str(resources.files("workers.measure").joinpath(SHIPPED)))
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(to_document(models, made_of), indent=1) + "\n", encoding="utf-8")
    return path


def sides_pooled(name: str) -> str:
    """Name of a row without its side: left and right share one error model."""
    return name.removesuffix("_left").removesuffix("_right")


def row_values(traces: Sequence[Trace], pose: Pose) -> list[float]:
    """Value (m) of each row, never negative."""
    if pose == "as-scanned":
        return [trace.value_m for trace in traces]
    return [max(0.0, trace.value_m - _model_of(trace, pose).bias) for trace in traces]


def intervals(
    traces: Sequence[Trace], values: Sequence[float], vertex_sigma_m: Array | None, pose: Pose
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
        found.append(model.interval(value, line_sigma(trace, vertex_sigma_m)))
    return found


def _model_of(trace: Trace, pose: Pose) -> ErrorModel:
    name = sides_pooled(trace.definition.name)
    try:
        return shipped()[pose][name]
    except KeyError:
        raise FormatError(f"{SHIPPED} has no row {name}; learn it with: make intervals") from None


def content_interval(
    name: str, value: float, vertex_sigma_m: Array | None, pose: Pose
) -> tuple[float, float]:
    """95 % interval of a volume or a surface, whose error is a share of the value."""
    if vertex_sigma_m is None:
        return value, value
    low, high = shipped()[pose][name].interval(1.0, 0.0)
    return value * low, value * high
