"""Common parts of all tables of measurements: a file for each pose, rounded differences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

Pose = Literal["as-scanned", "standard"]
FILES: dict[Pose, str] = {
    "as-scanned": "measurements.json",
    "standard": "measurements-standard.json",
}
"""The file of a result with the measurements in each pose."""


def rounded_differences(document: Mapping[str, Any], per_metre: float, digits: int) -> list[float]:
    """Left less right of each entry of a table's differences, in their order.

    A difference is that of both rounded values, beside which it stands; where one of them is
    missing, it is that of the entry.

    Args:
        document: a table of format "booth-measurements".
        per_metre: units in a metre.
        digits: decimals of values in this unit.
    """
    values_m = {row["name"]: row["value_m"] for row in document["measurements"]}
    found = []
    for entry in document.get("differences") or ():
        left_m, right_m = (values_m.get(f"{entry['name']}_{side}") for side in ("left", "right"))
        value = per_metre * entry["value_m"]
        if left_m is not None and right_m is not None:
            value = round(per_metre * left_m, digits) - round(per_metre * right_m, digits)
        found.append(round(value, digits))
    return found
