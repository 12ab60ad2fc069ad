"""Errors that one scan adds to those of ordinary scans, and what they do to rows and contents."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.measure.kinds import Definition, Top
from workers.measure.tracing import Trace
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

NORMAL_QUANTILE = 1.96
"""Half width of a 95 % interval over the standard deviation of a normal distribution."""
_GIRTHS = ("girth", "large girth")


@dataclass(frozen=True, slots=True)
class Contents:
    """Standard deviations of a body's contents, as shares of them."""

    volume: float
    surface: float


@dataclass(frozen=True, slots=True)
class ScanErrors:
    """Standard deviations that concern a whole scan, metres."""

    height_sigma_m: float = 0.0
    """Heights and lengths, by the calibration's own statement."""
    girth_sigma_m: float = 0.0
    """Girths, by the same."""
    crown_sigma_m: float = 0.0
    """Top of the head."""
    excess_noise_m: float = 0.0
    """The readings' noise, beyond that of ordinary scans. Each row has its own learned gain."""
    skin_sigma_m: Array | None = None
    """(P,): the surface beside patches of the scan that it does not explain, and of a head that
    hair hides. No learned gain applies to it; None for none."""
    cover_sigma_m: Array | None = None
    """(P,): thickness of what covers the skin all around, hair or cloth; None for nothing."""

    def of_contents(self, volume_m3: float, vertex_areas_m2: Array, height_m: float) -> Contents:
        """Standard deviations of volume and surface, as shares of them.

        A girth is off by 2 pi times what the skin is moved by, and a skin that moves by d changes
        the volume V by S d; a cylinder's surface S by S^2 d / 2 V. Heights stretch both.
        """
        moved_m = self.girth_sigma_m / (2.0 * np.pi)
        stretched = self.height_sigma_m / height_m
        thicker = float(vertex_areas_m2.sum()) * moved_m / volume_m3
        covered = 0.0
        if self.cover_sigma_m is not None:
            covered = float(vertex_areas_m2 @ self.cover_sigma_m) / volume_m3
        return Contents(
            float(np.linalg.norm((thicker, stretched, covered))),
            float(np.linalg.norm((0.5 * thicker, stretched, 0.5 * covered))),
        )

    def of(self, definition: Definition) -> float:
        """Standard deviation of a row."""
        if definition.quantity in _GIRTHS:
            return self.girth_sigma_m
        if isinstance(definition.kind, Top):
            return float(np.hypot(self.height_sigma_m, self.crown_sigma_m))
        return self.height_sigma_m

    def of_skin(self, trace: Trace) -> float:
        """Standard deviation of a row by the skin on its line.

        Around a girth a cover of the thickness d adds 2 pi d, to a length at most 2 d, to the
        stature d.
        """
        skin = 0.0 if self.skin_sigma_m is None else line_sigma(trace, self.skin_sigma_m)
        if self.cover_sigma_m is None:
            return skin
        definition = trace.definition
        times = 2.0 * np.pi if definition.quantity in _GIRTHS else 2.0
        if isinstance(definition.kind, Top):
            times = 1.0
        return float(np.hypot(skin, times * line_sigma(trace, self.cover_sigma_m)))


def line_sigma(trace: Trace, vertex_sigma_m: Array) -> float:
    """Standard deviation (m) of the surface, rms along a row's line."""
    tail, head = vertex_sigma_m[trace.points.tail], vertex_sigma_m[trace.points.head]
    along = tail + trace.points.share * (head - tail)
    return float(np.sqrt(np.mean(along**2)))


def cover_sigma_m(model: BodyModel, covers: Iterable[tuple[Sequence[str], float]]) -> Array | None:
    """Standard deviations (P,) of the skin under covers; None where there is none.

    Args:
        covers: parts that are covered, each time with the thickness at most (95 %), metres.
    """
    thickness_m = np.zeros(model.vertex_count)
    for parts, at_most_m in covers:
        thickness_m = np.maximum(thickness_m, np.where(model.of_parts(parts), at_most_m, 0.0))
    return thickness_m / NORMAL_QUANTILE if thickness_m.any() else None
