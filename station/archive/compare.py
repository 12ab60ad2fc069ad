"""Two scans compared: each measurement's difference, and the distances between the surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from station.archive.surfaces import Array, aligned, distances, read_mesh
from station.archive.tables import DIGITS, PER_METRE, Unit, read_measurements
from station.core.words.tables import Pose
from station.core.words.terms import Language, plain_name, split_side


@dataclass(frozen=True, slots=True)
class SurfaceDifference:
    """Distances from the first body's surface to the second's."""

    signed_m: Array
    """(n,) at each vertex of the first mesh: positive where the second body is larger."""

    @property
    def rms_m(self) -> float:
        return float(np.sqrt(np.mean(self.signed_m**2)))

    @property
    def p95_m(self) -> float:
        return float(np.quantile(np.abs(self.signed_m), 0.95))

    @property
    def largest_m(self) -> float:
        return float(np.abs(self.signed_m).max())


def compare_rows(
    first: Path, second: Path, pose: Pose, unit: Unit, language: Language
) -> list[dict[str, Any]]:
    """Each measurement that both results have, second minus first, as both are rounded.

    A difference counts as real where it exceeds what both 95 % intervals explain together
    (the root of the sum of their half-widths' squares).

    Raises:
        FormatError: a table is missing or damaged.
    """
    ours, theirs = (
        {
            row["name"]: row
            for row in read_measurements(folder, pose)["measurements"]
            if row["value_m"] is not None
        }
        for folder in (first, second)
    )
    scale, digits = PER_METRE[unit], DIGITS[unit]
    compared = []
    for name, row in ours.items():
        if name not in theirs:
            continue
        other = theirs[name]
        difference_m = other["value_m"] - row["value_m"]
        half_m = [(r["interval95_m"][1] - r["interval95_m"][0]) / 2 for r in (row, other)]
        uncertain_m = float(np.hypot(*half_m))
        before, after = (round(scale * r["value_m"], digits) for r in (row, other))
        compared.append(
            {
                "name": name,
                "words": plain_name(name, language, with_side=False),
                "side": split_side(name)[1],
                "first": before,
                "second": after,
                "difference": round(after - before, digits),
                "uncertainty": round(scale * uncertain_m, digits),
                "real": bool(abs(difference_m) > uncertain_m),
            }
        )
    return compared


@lru_cache(maxsize=8)
def compare_surfaces(first: Path, second: Path) -> SurfaceDifference:
    """The surfaces of two results, the second rigidly aligned to the first.

    Both as scanned: limbs held in a different position show up as differences.

    Raises:
        FormatError: a mesh is missing or damaged.
    """
    here, there = read_mesh(first / "mesh.ply"), read_mesh(second / "mesh.ply")
    # The first one's vertices inside the second body are where the second is larger.
    return SurfaceDifference(-distances(here, aligned(there, here)))
