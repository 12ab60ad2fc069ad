"""A camera's depth error as the calibration solves for it: linear in inverse depth.

1/z_true = w + p0 + p1 w + p2 (w - w0)^2 + p3 x + p4 y, with w = 1/z_measured and x, y from -1 to 1
over the image. Its first term is a shift of the disparity (the sensor's reference plane), the
second a wrong baseline or focal length, p3 and p4 a projector that is turned against its camera.

Shift and gradient are collineations: they take planes to planes and, in all cameras together, a
whole booth to one that looks as consistent. What tells them apart are the ball's known radius and
that the scale is the factory's to within its tolerance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from station.core.rig import CameraCalibration, DepthCorrection

Array = NDArray[np.float64]

PARAMETERS = 5
MIDDLE = 0.6
"""w0, 1/m: the middle of a booth's depths."""
TOLERANCE = np.array([5e-3, 3e-4, 1.5e-3, 2e-3, 2e-3])
"""Standard deviations among sensors as they leave the factory."""


def image_place(camera: CameraCalibration, pixels: Array) -> Array:
    """(..., 2): x, y from -1 to 1 over the image of pixels (..., 2)."""
    return np.asarray(2.0 * pixels / (camera.width - 1, camera.height - 1) - 1.0)


def design(inverse: Array, place: Array) -> Array:
    """(..., 5): change of inverse depths (...) by the parameters, at places (..., 2) in the image.

    To be taken at expected inverse depths: noise that is in both sides of an equation biases it.
    """
    return np.stack(
        [
            np.ones_like(inverse),
            inverse,
            (inverse - MIDDLE) ** 2,
            place[..., 0],
            place[..., 1],
        ],
        axis=-1,
    )


def correction_of(parameters: Array) -> DepthCorrection:
    """The correction as the calibration file has it."""
    p0, p1, p2, gx, gy = (float(value) for value in parameters)
    return DepthCorrection((p0 + p2 * MIDDLE**2, 1.0 + p1 - 2.0 * p2 * MIDDLE, p2), (gx, gy))
