"""Change of a sensor's depths since the empty booth was recorded, from what stands still in it.

A Kinect's depths change with its temperature by nearly the same share everywhere. A camera that
stands still sees the same surfaces in the same pixels, with the same bias and the same frozen
noise, so that their readings show a change of a few hundredths of a per cent.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.scene import StaticView
from station.core.depth.images import Image

BODY_M = 1.7
"""Distance of a body from the cameras."""
_SAME_PER_M = 0.01
"""Readings that differ by more, 1/m, are of somebody or something that was not there."""
_ALWAYS = 0.9
"""Share of the frames in which a pixel has to be read, both times."""
_BLOCK_PX = 40
_LEAST_SHARE = 0.5
"""Share of a block's pixels that have to show what the empty booth shows."""
_FEWEST_BLOCKS = 12
_LARGEST_ERROR = 1e-4
"""Standard error beyond which what is seen does not stand still, such as curtains."""


def depth_change(mean: Image, share: Image, empty: StaticView) -> float | None:
    """Relative change of the depths since the empty booth was recorded: 1e-3 if all surfaces seem
    to be 0.1 % farther away; None where too little of it is seen, or does not stand still.

    The median over blocks of the image, in each the mean over pixels: their median would stay at a
    step of the disparity.

    Args:
        mean, share: see `station.calibration.detect.scene.mean_view`, of a camera that has not
            moved; people may stand in its view.
    """
    before = empty.inverse_depth / np.maximum(empty.share, _ALWAYS)
    fallen = before - mean / np.maximum(share, _ALWAYS)
    both = (share > _ALWAYS) & (empty.share > _ALWAYS) & (before > 0)
    same = both & (np.abs(fallen) < _SAME_PER_M)
    pixels, changed, level = (_in_blocks(image) for image in (same, same * fallen, same * before))
    known = pixels > _LEAST_SHARE * _BLOCK_PX**2
    if known.sum() < _FEWEST_BLOCKS:
        return None
    shares = changed[known] / level[known]
    low, middle, high = np.quantile(shares, (0.25, 0.5, 0.75))
    # Standard error of a median; the quartiles of a normal distribution are 1.349 sigma apart.
    error = 1.2533 * (high - low) / 1.349 / np.sqrt(len(shares))
    return float(middle) if error <= _LARGEST_ERROR else None


def common_change(changes: Mapping[str, float]) -> float:
    """The change that more than half of the cameras (name -> change) show at least; 0 where they do
    not agree."""
    ordered = sorted(changes.values())
    if not ordered:
        return 0.0
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return 0.0 if low < 0.0 < high else min(low, high, key=abs)


def where_words(change: float) -> str:
    """Words on where things seem to be whose depths changed so."""
    return "farther away" if change > 0.0 else "nearer"


def _in_blocks(image: NDArray[np.generic]) -> NDArray[np.float64]:
    """Sums over the blocks that lie in an image (h, w) as a whole."""
    rows, columns = (size // _BLOCK_PX for size in image.shape)
    whole = image[: rows * _BLOCK_PX, : columns * _BLOCK_PX].astype(np.float64)
    return np.asarray(whole.reshape(rows, _BLOCK_PX, columns, _BLOCK_PX).sum(axis=(1, 3)))
