"""Balls as cameras of the default booth detect them."""

import numpy as np

from station.calibration.detect.detections import BallDetection
from station.simulation.scene import default_rig

CAMERAS = default_rig().cameras


def ball(
    camera: str, time_s: float, center: tuple[float, float, float] = (0, 0, 1.5)
) -> BallDetection:
    """A whole ball of 0.1 m, seen with certainty."""
    return BallDetection(
        camera, time_s, np.array(center, float), 1e-6 * np.eye(3), 900, 0.1, 1e-4, np.ones((5, 4))
    )
