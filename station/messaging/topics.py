"""Every topic that is published. Sockets, silence limits and health follow from this table.

No message is critical: scans are on disk, commands have replies, and a lost message is counted
where it matters (frames have sequence numbers).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of published message."""

    rate_hz: float
    """Rate at which its sender publishes it."""
    max_age_s: float
    """Without a new one for this long, its sender is reported as silent."""
    high_water_mark: int
    """Most messages that wait for a slow reader; more are lost."""


TOPICS = {
    "depth": Topic(30.0, 1.0, 8),
    "health": Topic(2.0, 2.0, 8),
    "sensor": Topic(2.0, 2.0, 8),
    "desired": Topic(4.0, 2.0, 2),
    "scan": Topic(10.0, 1.0, 100),
    "cloud": Topic(3.0, 2.0, 1),
}
