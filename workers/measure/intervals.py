"""How far a value may be off: 95 % intervals from a calibrated model of the error.

A row errs because the surface is off, which the fit's posterior knows for each vertex, and because
landmarks slide along the skin from fit to fit, which it does not know. So

    half width = sqrt(constant^2 + (gain sigma)^2),

sigma being the posterior standard deviation, rms along the row's line. `constant`, `gain` and the
row's systematic error `bias` are learned from scans of held-out bodies of which the truth is known
(conformal calibration: Vovk, Gammerman & Shafer 2005, chapter 4), so that an interval holds the
truth 95 times of 100. As scanned the bias shifts the interval alone: a value is the length of its
line. In the standard pose, which no camera saw, the bias is what carrying a body there adds on the
average, and it is taken off the value.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
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
"""Candidates of gain x median sigma : constant."""
_OUTLIER = 6.0
"""Median absolute deviations beyond which an error says nothing about the ordinary spread."""


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Of one row in one pose; metres, or shares of the value for volume and surface."""

    bias: float
    constant: float
    gain: float

    def interval(self, value: float, sigma: float) -> tuple[float, float]:
        """The 95 % interval of a value whose line has this posterior deviation.

        It always holds the value itself, and no length below 0.
        """
        half = float(np.hypot(self.constant, self.gain * sigma))
        middle = value - self.bias
        return max(0.0, min(value, middle - half)), max(value, middle + half)


def line_sigma(trace: Trace, vertex_sigma_m: Array) -> float:
    """Posterior deviation (m) of the surface, rms along a row's line."""
    tail, head = vertex_sigma_m[trace.points.tail], vertex_sigma_m[trace.points.head]
    along = tail + trace.points.share * (head - tail)
    return float(np.sqrt(np.mean(along**2)))


def learned(errors: Array, sigmas: Array) -> ErrorModel:
    """The error model of a row from the errors (n,) of held-out scans and their line sigmas (n,).

    The bias is shrunk by its own uncertainty (James & Stein 1961, positive part), so that noise of
    the calibration does not pass for a systematic error. The ratio of gain to constant is the
    likeliest one; their size is the conformal quantile.
    """
    middle = float(np.median(errors))
    spread = 1.4826 * float(np.median(np.abs(errors - middle)))
    kept = np.abs(errors - middle) <= _OUTLIER * spread / 1.4826
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
    """The calibration that comes with the package: pose -> row -> error model.

    Raises:
        FormatError: the file is damaged or of another version.
    """
    text = resources.files("workers.measure").joinpath(SHIPPED).read_text(encoding="utf-8")
    return from_document(json.loads(text))


def from_document(document: Mapping[str, Any]) -> Mapping[Pose, Mapping[str, ErrorModel]]:
    """Read intervals.json."""
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
    """intervals.json."""
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


def sides_pooled(name: str) -> str:
    """Left and right err alike: rows that differ only in the side share one error model."""
    return name.removesuffix("_left").removesuffix("_right")


def row_values(traces: Sequence[Trace], pose: Pose) -> list[float]:
    """The value (m) of each row, never below 0."""
    if pose == "as-scanned":
        return [trace.value_m for trace in traces]
    return [max(0.0, trace.value_m - _model_of(trace, pose).bias) for trace in traces]


def intervals(
    traces: Sequence[Trace], values: Sequence[float], vertex_sigma_m: Array | None, pose: Pose
) -> list[tuple[float, float]]:
    """The 95 % interval of each row, about the value that `row_values` gives it; without a
    posterior the mesh itself is the truth."""
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
    return shipped()[pose][sides_pooled(trace.definition.name)]


def content_interval(
    name: str, value: float, vertex_sigma_m: Array | None, pose: Pose
) -> tuple[float, float]:
    """The 95 % interval of a volume or a surface, whose error is a share of it."""
    if vertex_sigma_m is None:
        return value, value
    low, high = shipped()[pose][name].interval(1.0, 0.0)
    return value * low, value * high
