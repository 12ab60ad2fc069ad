"""Scan that a result belongs to: its label, time and booth, as stated in every file of the
result."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from station.core.bundle import Bundle


@dataclass(frozen=True, slots=True)
class Origin:
    """Label, time and booth of a scan; empty where they are not known, as for a point cloud
    file."""

    scan_id: str
    label: str = ""
    """Text that the operator gave the scan, such as an order's number."""
    created: str = ""
    """UTC, ISO 8601: when the frames were taken."""
    booth: str = ""
    """Name of the booth."""
    calibration: str = ""
    """UTC, ISO 8601: when the calibration in use was made."""

    @classmethod
    def of_bundle(cls, bundle: Bundle) -> Origin:
        """Origin of a scan bundle."""
        return cls(bundle.scan_id, bundle.label, bundle.created, bundle.booth, bundle.rig.created)

    def to_json(self) -> dict[str, str]:
        """Fields as they stand in result.json and in both tables."""
        return asdict(self)

    def comments(self) -> list[str]:
        """One line of ASCII per known field, for the headers of PLY and OBJ files.

        A label is a customer's text: it is quoted as in JSON, so that it can neither end the line
        nor hold a control character.
        """
        return [f"{name} {json.dumps(value)}" for name, value in self.to_json().items() if value]
