"""Every topic that is published: who sends it, how often, how much may wait, what a loss means."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of published message."""

    message: str
    rate_hz: float
    max_age_s: float
    """Older ones say that the sender is gone."""
    high_water_mark: int
    lossy: bool
    """A loss is counted and harmless."""


TOPICS = {
    "depth": Topic("FrameHeader", 30.0, 1.0, 8, lossy=True),
    "health": Topic("CameraHealth", 2.0, 2.0, 8, lossy=True),
    "sensor": Topic("SensorInfo", 2.0, 2.0, 8, lossy=True),
    "desired": Topic("DesiredState", 4.0, 2.0, 2, lossy=True),
    "scan": Topic("ScanEvent", 10.0, 1.0, 100, lossy=True),
    "cloud": Topic("points", 3.0, 2.0, 1, lossy=True),
}
"""Nothing here is relied upon: scans are on disk, commands have replies."""
