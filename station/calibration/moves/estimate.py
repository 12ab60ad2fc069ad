"""A camera's move since its calibration, whatever thing was moved in its view.

A chair that was pushed shifts its outlines, all in the same sense, as a moved camera would. But it
fills one part of the image, and a camera that moved shifts the whole. Before an alarm, the move is
therefore estimated again without each part that a piece of furniture can fill: if the rest of the
image then says that the camera stands where it did, the thing was moved.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.scene import smoothed
from station.calibration.moves.alignment import Alignment, align
from station.calibration.moves.motion import CameraMove
from station.calibration.moves.reference import BLOCK, DriftReference
from station.core.depth.images import Image

Array = NDArray[np.float64]

_THINGS_BLOCKS = ((4, 3), (6, 2))
"""Heights and widths of what one thing fills, in the reference's blocks: 320 x 240 px, 0.9 x 0.7 m
at a distance of 1.7 m; and 480 x 160 px, a chair with its legs that stands near the camera."""
_PREFERRED = 3.0
"""Twice the log of how many times likelier a camera within the tolerance has to make the rest."""
_PLACES = 2
"""A thing that was moved left one place and fills another."""
_SUSPECT = 16.8
"""Squared distance from no move, in units of the covariance, beyond which things are suspected, and
between two estimates, beyond which they contradict each other: once in 100, by chance."""


def estimate_move(reference: DriftReference, mean: Image, share: Image, frames: int) -> CameraMove:
    """The camera's move from what so many frames of one moment show in front of the stored
    background.

    Args:
        mean, share: see `station.calibration.detect.scene.mean_view`.
    """
    now = smoothed(mean, share)
    whole = align(reference, now, frames)
    if whole.move.lost:
        return whole.move
    sure = _whatever_misleads(whole, reference)
    move, rest = replace(whole.move, sure=sure), reference
    for _ in range(_PLACES):
        if _squared(move.xi, sure) < _SUSPECT and not move.moved:
            break
        parts = [
            (part, replace(found, sure=_wider(found.covariance, sure)))
            for part in _without_one_thing(rest)
            if not (found := align(part, now, frames).move).lost
        ]
        if not parts:
            break
        least = min((found for _, found in parts), key=CameraMove.alarm)
        if not least.moved and _prefers_still(least, move):
            return replace(least, share=whole.move.share)
        rest, most = max(parts, key=lambda part: _contradiction(move, part[1]))
        if _contradiction(move, most) < _SUSPECT:
            break
        move = most
    return replace(move, share=whole.move.share)


def _prefers_still(part: CameraMove, move: CameraMove) -> bool:
    """Whether what one part of the image leaves is nearer to a camera within the tolerance than to
    the move that all of it shows. Where it shows neither, the camera is believed to have moved: a
    post is fixed."""
    off = part.xi - move.xi
    return _squared(off, part.covariance) - part.beyond() ** 2 > _PREFERRED


def _without_one_thing(reference: DriftReference) -> Iterator[DriftReference]:
    for blocks in _things(reference):
        usable = reference.usable & ~np.isin(reference.block, blocks)
        yield replace(reference, usable=usable)


def _contradiction(move: CameraMove, part: CameraMove) -> float:
    """Squared distance of a part's estimate from a move, in units of the part's covariance."""
    return _squared(part.xi - move.xi, part.stated)


def _squared(xi: Array, covariance: Array) -> float:
    return float(xi @ np.linalg.solve(covariance, xi))


def _whatever_misleads(whole: Alignment, reference: DriftReference) -> Array:
    """A covariance (6, 6) that is nowhere smaller than without any one thing."""
    sure = whole.move.covariance
    for blocks in _things(reference):
        sure = _wider(sure, whole.covariance_without(blocks))
    return sure


def _wider(one: Array, other: Array) -> Array:
    """The smallest covariance that contains both, of those with the directions common to both."""
    root = np.linalg.cholesky(one)
    inverse = np.linalg.inv(root)
    ratios, directions = np.linalg.eigh(inverse @ other @ inverse.T)
    back = root @ directions
    return np.asarray((back * np.maximum(ratios, 1.0)) @ back.T)


def _things(reference: DriftReference) -> Iterator[NDArray[np.intp]]:
    """Numbers of the blocks of each part of the image that one thing can fill; parts overlap."""
    blocks = reference.block[::BLOCK, ::BLOCK]
    for shape in _THINGS_BLOCKS:
        height, width = np.minimum(shape, blocks.shape)
        for row in range(blocks.shape[0] - height + 1):
            for column in range(blocks.shape[1] - width + 1):
                yield blocks[row : row + height, column : column + width].ravel()
