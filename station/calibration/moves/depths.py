"""Change of the sensors' depths since the calibration, as the background of a scan shows it.

A Kinect's depths change with its temperature, everywhere at once; by which law is not known: in
proportion to the depth's square, to the depth, or by a constant. In inverse depth w these are, to
first order, the terms of

    w_calibrated = w + a0 + a1 w + a2 w^2.

Walls and the floor, at many distances, show them. The law is the same for units of one kind, so
that what one camera's view leaves open is completed by what the others see.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.scene import StaticView, smoothed
from station.calibration.detect.warmth import BODY_M, common_change, depth_change, where_words
from station.calibration.moves.alignment import sample_sigma, tukey
from station.calibration.moves.motion import everything_words
from station.calibration.moves.reference import DriftReference
from station.core.depth.images import Image
from station.core.rig import Rig

Array = NDArray[np.float64]

_LEAST, _MOST = 2e-4, 4e-3
"""Smaller changes of what is behind people may be noise, or cameras turned by a tenth of a degree;
beyond the other one no scan is taken."""
_STILL = 1.0 / np.square([np.radians(0.02)] * 3 + [3e-4] * 3)
"""Prior precisions of a still camera's move, 1/rad^2 and 1/m^2: to a camera that was turned, a
floor seems to be nearer or farther away."""
_TERMS, _WALLS_W = 3, 0.3
"""Numbers of a law, and the inverse depth of walls (1/m), at which its terms weigh alike."""
_ALL, _UNITS = 1.0, 0.5
"""Standard deviations of a term of all units, and of one unit's from it, as shares of what the
walls show."""
_MOST_OF_WALLS = 3.0
"""Largest change of a body as a multiple of what walls show: a constant one gives 2. Cameras that
were all turned a little show more, or the opposite."""
_UNLIKE = 1.5
"""A camera whose walls differ from the others' by more than so many times the change has moved.
Units of one kind change by shares that differ by a factor of two at most."""
_FEWEST_CAMERAS = 2
"""One camera alone cannot tell whether depths changed or it was pushed back."""
_OF_UNIT = 0.3
"""By which share of the change a unit differs from all units, whose own change is not seen."""
_OF_CHANGE = 0.1
"""Error of the correction as a share of the change: its law may be another one."""
_SAME_PER_M = 0.01
"""Samples that differ by more, 1/m, are of somebody or something that was not there ..."""
_SHADOW_CELLS = 2
"""... and so may be those around."""
_READ, _READ_PX = 0.85, 15
"""Share of the readings around a sample that has to be there."""
_FEWEST, _ROUNDS = 300, 8


@dataclass(frozen=True, slots=True)
class SeenDepths:
    """Evidence of one camera's view on the law by which its depths changed."""

    at_walls: float
    """Relative change of most depths (`station.calibration.detect.warmth.depth_change`)."""
    information: Array
    """(3, 3), whatever the camera's small move."""
    vector: Array
    """(3,): information times the estimate."""


@dataclass(frozen=True, slots=True)
class ChangedDepths:
    """Change of all cameras' depths."""

    at_walls: float
    """Relative change that more than half of the cameras show at least."""
    laws: Mapping[str, Array]
    """Camera -> (a0, a1, a2)."""
    sigma_m: float
    """Standard deviation along an axis of where a camera sees a body after the correction."""

    def corrected(self, rig: Rig) -> Rig:
        """The calibration for sensors whose depths have changed so, its stated errors widened."""
        cameras = {
            name: replace(camera, depth_correction=camera.depth_correction.after(law))
            for name, camera in rig.cameras.items()
            if (law := self.laws.get(name)) is not None
        }
        predicted = rig.predicted and rig.predicted.widened(self.sigma_m)
        return replace(rig, cameras={**rig.cameras, **cameras}, predicted=predicted)

    @property
    def too_large(self) -> bool:
        """Whether the depths changed by more than can be corrected."""
        return abs(self.at_walls) > _MOST

    def words(self) -> str:
        """Words for the operator."""
        if self.too_large:
            return everything_words(self.at_walls)
        percent, farther = f"{100.0 * abs(self.at_walls):.2f}", where_words(self.at_walls)
        return (
            f"all cameras see the booth {percent} % {farther} than when they were calibrated, as "
            "sensors do that are colder or warmer: scans are corrected for it, and their stated "
            "errors are larger; let the sensors warm up for 20 minutes; if nothing changes, run "
            "station calibrate"
        )


def seen_depths(
    reference: DriftReference, empty: StaticView, mean: Image, share: Image, frames: int
) -> SeenDepths | None:
    """Evidence on the change of a camera's depths; None where too little is seen as it was.

    Robust least squares of the smooth surfaces' samples over xi and the law, with a prior that
    keeps the camera still; xi is then eliminated.

    Args:
        mean, share: see `station.calibration.detect.scene.mean_view`, of so many frames; people
            may stand in the view.
    """
    at_walls = depth_change(mean, share, empty)
    if at_walls is None:
        return None
    off = reference.image - smoothed(mean, share)[0][reference.rows, reference.columns]
    read = cv2.blur(share, (_READ_PX, _READ_PX))[reference.rows, reference.columns] > _READ
    calm = reference.usable & ~reference.outline & read
    reach = np.ones((2 * _SHADOW_CELLS + 1,) * 2, np.uint8)
    others = cv2.dilate((calm & (np.abs(off) >= _SAME_PER_M)).astype(np.uint8), reach)
    calm &= others == 0
    if calm.sum() < _FEWEST:
        return None
    sigma = sample_sigma(reference, frames, still=True)[calm]
    columns = (-reference.jacobian[calm], np.vander(reference.image[calm], _TERMS, increasing=True))
    design = np.concatenate(columns, axis=1) / sigma[:, None]
    normal, right = _robust(design, off[calm] / sigma)
    moved = np.linalg.solve(
        normal[:6, :6] + np.diag(_STILL),
        np.column_stack([normal[:6, 6:], right[:6]]),
    )
    information = normal[6:, 6:] - normal[6:, :6] @ moved[:, :_TERMS]
    return SeenDepths(at_walls, information, right[6:] - normal[6:, :6] @ moved[:, _TERMS])


def _robust(design: Array, off: Array) -> tuple[Array, Array]:
    """Normal equations of the samples that agree, after Tukey."""
    weights = np.ones(len(off))
    still = np.diag(np.concatenate([_STILL, np.zeros(_TERMS)]))
    for _ in range(_ROUNDS):
        normal, right = design.T @ (design * weights[:, None]), design.T @ (weights * off)
        rest = np.abs(off - design @ np.linalg.lstsq(normal + still, right)[0])
        size = max(1.0, 1.4826 * float(np.median(rest)))
        weights = tukey(rest / size) / size**2
    return normal, right


def changed_depths(looks: Mapping[str, SeenDepths | None]) -> ChangedDepths | None:
    """The change of all cameras' depths, from what most of them show; None where these do not agree
    on one.

    Each unit's law is that of all units (unknown) plus its own part, a random effect.

    Args:
        looks: of all of a booth's cameras.
    """
    seen = {name: one for name, one in looks.items() if one is not None}
    at_walls = common_change({name: one.at_walls for name, one in seen.items()})
    if abs(at_walls) < _LEAST:
        return None
    most = _UNLIKE * abs(at_walls)
    seen = {name: one for name, one in seen.items() if abs(one.at_walls - at_walls) < most}
    if 2 * len(seen) <= len(looks) or len(seen) < _FEWEST_CAMERAS:
        return None
    size = np.square(at_walls * _WALLS_W ** (1.0 - np.arange(_TERMS)))
    own = np.diag(1.0 / (_UNITS**2 * size))
    posterior = {name: np.linalg.inv(one.information + own) for name, one in seen.items()}
    information, vector = np.diag(1.0 / (_ALL**2 * size)), np.zeros(_TERMS)
    for name, one in seen.items():
        kept = own @ posterior[name]
        information = information + kept @ one.information
        vector = vector + kept @ one.vector
    covariance = np.linalg.inv(information)
    law = covariance @ vector
    at_body = BODY_M ** (1.0 - np.arange(_TERMS))
    change = float(at_body @ law)
    if not 0.0 < change / at_walls < _MOST_OF_WALLS:
        return None
    laws = dict.fromkeys(looks, law) | {
        name: posterior[name] @ (one.vector + own @ law) for name, one in seen.items()
    }
    variances = [
        at_body @ (posterior[name] + posterior[name] @ own @ covariance @ own @ posterior[name])
        @ at_body
        for name in seen
    ]  # fmt: skip
    variance = float(at_body @ covariance @ at_body) + (_OF_UNIT * change) ** 2
    variances += [variance] * (len(looks) - len(seen))
    sigma = np.sqrt(np.mean(variances) + (_OF_CHANGE * change) ** 2)
    return ChangedDepths(at_walls, laws, float(sigma) * BODY_M)
