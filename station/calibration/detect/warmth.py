"""Change of a sensor's depths since the empty booth was recorded, from what stands still in it.

A Kinect's depths change with its temperature by nearly the same share everywhere. A camera that
stands still sees the same surfaces in the same pixels, with the same bias and the same frozen
noise, so that their readings show a change of a few hundredths of a per cent.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.scene import StaticView, raw_inverse_depth

_SAME_PER_M = 0.01
"""Readings that differ by more, 1/m, are of somebody or something that was not there."""
_ALWAYS = 0.9
"""Share of the frames in which a pixel has to be read, both times."""
_BLOCK_PX = 40
_LEAST_SHARE = 0.5
"""Share of a block's pixels that have to show what the empty booth shows."""
_FEWEST_BLOCKS = 12


def depth_change(
    frames: Iterable[NDArray[np.uint16]], scale_m: float, empty: StaticView
) -> float | None:
    """Relative change of the depths since the empty booth was recorded: 1e-3 if all surfaces seem
    to be 0.1 % farther away; None where too little of it is seen.

    The median over blocks of the image, in each the mean over pixels: their median would stay at a
    step of the disparity.

    Args:
        frames: (h, w) each, of a camera that has not moved; people may stand in its view.
    """
    total, read = np.zeros(empty.share.shape, np.float32), np.zeros(empty.share.shape, np.float32)
    count = 0
    for frame in frames:
        inverse = raw_inverse_depth(frame, scale_m)
        total += inverse
        read += inverse > 0
        count += 1
    both = (read > _ALWAYS * max(count, 1)) & (empty.share > _ALWAYS)
    before = empty.inverse_depth / np.maximum(empty.share, _ALWAYS)
    less = before - total / np.maximum(read, 1.0)
    same = both & (np.abs(less) < _SAME_PER_M)
    pixels, changed, level = (_in_blocks(image) for image in (same, same * less, same * before))
    known = pixels > _LEAST_SHARE * _BLOCK_PX**2
    if known.sum() < _FEWEST_BLOCKS:
        return None
    return float(np.median(changed[known] / level[known]))


def common_change(changes: Mapping[str, float]) -> float:
    """The change that cameras (name -> change) have in common, whatever one of them shows; 0 where
    none shows any."""
    return float(np.median([*changes.values()])) if changes else 0.0


def _in_blocks(image: NDArray[np.generic]) -> NDArray[np.float64]:
    """Sums over the blocks that lie in an image (h, w) as a whole."""
    rows, columns = (size // _BLOCK_PX for size in image.shape)
    whole = image[: rows * _BLOCK_PX, : columns * _BLOCK_PX].astype(np.float64)
    return np.asarray(whole.reshape(rows, _BLOCK_PX, columns, _BLOCK_PX).sum(axis=(1, 3)))
