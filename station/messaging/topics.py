"""Every topic that is published, and how: sockets take their queues from this table.

When a camera counts as silent is configured (`sync.silent_after_s`); when a process does is a
matter of its health file (`station.booth.health`), which is there without any message.

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
    high_water_mark: int
    """Most messages that wait for a slow reader; more are lost."""


TOPICS = {
    "depth": Topic(30.0, 8),
    "health": Topic(2.0, 8),
    "sensor": Topic(2.0, 8),
    "desired": Topic(4.0, 2),
    "scan": Topic(10.0, 100),
    "cloud": Topic(3.0, 1),
}
