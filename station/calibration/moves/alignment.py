"""Alignment of a camera's present view of the booth with the stored one.

The image of inverse depth is aligned over the camera's six degrees of freedom: the range flow
constraint (Horn & Harris 1991, "Rigid body motion from range image sequences") where surfaces are
smooth, the shift of the outline where depth jumps. People and things that come and go are left out.
What changes the image without a move (warmth, frozen patterns, silhouettes) is estimated along with
it under priors, for the whole image and for each block of it, so that the covariance contains it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from station.calibration.moves.motion import LEVER_M, MIN_SHARE, CameraMove
from station.calibration.moves.reference import COMMON, LOCAL, DriftReference
from station.core.depth.images import Image
from station.core.geometry import invert, se3_exp, transform
from station.core.kinect_v1 import FROZEN_SHARE
from station.core.lens import project

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CORRELATION = 2.5
"""Samples after a blur of 3.4 px (the sensor's window and ours) are nearly independent; the
variances of their sums are this much larger."""
_FLOOR_PER_M = 2e-5
"""Error that averaging does not remove (quantisation), 1/m; 0.3 mm at 3.7 m."""
_COMMON_SIGMA = np.array([5e-5, 1e-4, 1.0, 1.0])
"""Standard deviations of `DriftReference.common`: warmth changes the depth of a warm sensor by
0.2 mm at 1.7 m, and a silhouette loses a pixel more on one day than on another."""
_LOCAL_SIGMA = np.array([2e-4, 0.3, 0.3, 0.5])
"""Standard deviations of `DriftReference.local`: a sensor's bias differs by about 0.6 mm at 1.7 m
where another part of the image sees a surface, and outlines by thirds of a pixel."""
_SYSTEMATIC_M, _RELATIVE = 3e-4, 0.05
"""Errors of a move that no sample shows: of the lens and the bias over the whole image, and as a
share of the move, for the bias stays in the image while the booth moves through it."""
_FREEDOM = 4.0
"""Degrees of freedom of the local disturbances, after Student's t: something in a block may have
been moved."""
_COARSE_SIGMA_M, _FINE_SIGMA_M = 0.02, 0.03
"""Prior standard deviations, for directions that the scene does not determine; the first keeps the
move smaller than what outlines can follow."""
_CHANGED_PER_M, _CHANGED_PX = 0.03, 6.0
"""A larger difference, or a shift beyond so many pixels, is not a moved camera but a person."""
_SHADOW_CELLS = 2
"""The outline of a person, and of the shadow that the projector casts behind, in samples."""
_RIGID_STEPS, _CONVEX_STEPS, _STEPS = 4, 7, 12
"""Steps before local disturbances are let in, before robust weights become redescending, and in
all."""
_NONE = np.full(LOCAL, 1e16)
"""Prior precisions that keep local disturbances out."""
_HUBER, _TUKEY = 1.345, 4.685
_SCALE = np.array([LEVER_M] * 3 + [1.0] * 3)


@dataclass(frozen=True, slots=True)
class Alignment:
    """A camera's move, and which parts of the image say so."""

    move: CameraMove
    blocks: NDArray[np.intp]
    """(n,) numbers of the reference's blocks."""
    information: Array
    """(n, 6 + COMMON, 6 + COMMON) of each block."""
    rest: Array
    """(6 + COMMON, 6 + COMMON), of the priors."""

    def covariance_without(self, blocks: NDArray[np.intp]) -> Array:
        """The move's covariance (6, 6), had these blocks not been seen."""
        kept = self.information[~np.isin(self.blocks, blocks)].sum(axis=0)
        return np.asarray(np.linalg.inv(kept + self.rest)[:6, :6]) + _unseen_errors(0.0)


def align(reference: DriftReference, now: tuple[Image, Image], frames: int) -> Alignment:
    """Align the smoothed images of some frames (see `smoothed`) with the stored background.

    Robust Gauss-Newton over xi, first over surfaces, then with outlines, which see
    only a few pixels far.
    """
    name, xi = reference.camera.name, np.zeros(6)
    for samples, sigma_m in (
        (reference.usable & ~reference.outline, _COARSE_SIGMA_M),
        (reference.usable, _FINE_SIGMA_M),
    ):
        same = samples & ~_changed(reference, now, xi)
        met = float(same.sum() / max(1, samples.sum()))
        if met < MIN_SHARE:
            nothing = np.zeros((0, 6 + COMMON, 6 + COMMON))
            lost = CameraMove(name, np.zeros(6), np.eye(6), met)
            return Alignment(lost, np.zeros(0, np.intp), nothing, np.eye(6 + COMMON))
        chosen = _Samples.of(reference, same, frames)
        xi, information, rest = _align(chosen, now, xi, sigma_m)
    covariance = np.linalg.inv(information.sum(axis=0) + rest)[:6, :6]
    size = np.linalg.norm(CameraMove(name, xi, covariance, met).known() * _SCALE)
    move = CameraMove(name, xi, covariance + _unseen_errors(float(size)), met)
    return Alignment(move, chosen.blocks, information, rest)


def sample_sigma(reference: DriftReference, frames: int, *, still: bool) -> Array:
    """Standard deviations (r, c) of the samples' differences in so many frames, 1/m."""
    # The frozen share does not average out, and only a camera that moves sees it change.
    share = 0.0 if still else 2.0 * FROZEN_SHARE
    share += (1.0 - FROZEN_SHARE) * (1.0 / frames + 1.0 / reference.frames)
    variance = reference.noise**2 * share + _FLOOR_PER_M**2
    return np.asarray(np.sqrt(_CORRELATION * variance))


def tukey(off: Array) -> Array:
    """Tukey's weights of deviations in standard deviations."""
    return np.asarray(np.square(np.maximum(0.0, 1.0 - np.square(off / _TUKEY))))


def _unseen_errors(size: float) -> Array:
    """Covariance (6, 6) of errors that no sample shows, of a move of a size (turns times lever)."""
    return np.diag((_SYSTEMATIC_M**2 + (_RELATIVE * size) ** 2) / np.square(_SCALE))


@dataclass(frozen=True, slots=True)
class _Samples:
    """Some samples of a reference, (n,) in the order of their blocks."""

    reference: DriftReference
    at: NDArray[np.intp]
    """Flat indices into the reference's grid."""
    starts: NDArray[np.intp]
    """Index of each block's first sample."""
    blocks: NDArray[np.intp]
    """Number of each block."""
    sigma: Array
    design: Array
    """(n, 6 + COMMON + LOCAL): changes in units of sigma."""

    @classmethod
    def of(cls, reference: DriftReference, same: Mask, frames: int) -> _Samples:
        at = np.flatnonzero(same)
        block = reference.block.ravel()[at]
        at, block = at[np.argsort(block, kind="stable")], np.sort(block)
        sigma = sample_sigma(reference, frames, still=False).ravel()[at]
        columns = (reference.jacobian, reference.common, reference.local)
        design = np.concatenate([c.reshape(-1, c.shape[-1])[at] for c in columns], axis=1)
        starts = np.flatnonzero(np.diff(block, prepend=-1))
        return cls(reference, at, starts, block[starts], sigma, design / sigma[:, None])

    def off(self, now: tuple[Image, Image], xi: Array) -> tuple[Array, Mask]:
        """Differences in units of sigma, and which samples are inside the image."""
        off, inside = _off(self.reference, now, xi)
        return off.ravel()[self.at] / self.sigma, inside.ravel()[self.at]


def _align(
    samples: _Samples, now: tuple[Image, Image], xi: Array, prior_sigma_m: float
) -> tuple[Array, Array, Array]:
    """Robust Gauss-Newton: the move (6,), the blocks' information and the priors' (see
    Alignment)."""
    prior = np.concatenate([np.square(_SCALE / prior_sigma_m), 1.0 / _COMMON_SIGMA**2])
    explained, wider = np.zeros(len(samples.at)), np.ones(len(samples.starts))
    for step in range(_STEPS):
        off, inside = samples.off(now, xi)
        rest = np.abs(off - explained)
        size = max(1.0, 1.4826 * float(np.median(rest[inside])))
        weights = _weights(rest / size, convex=step < _CONVEX_STEPS) * inside / size**2
        local = np.outer(1.0 / wider, 1.0 / _LOCAL_SIGMA**2 if step >= _RIGID_STEPS else _NONE)
        change, information, explained, own = _solved(samples, weights, off, xi, prior, local)
        square = np.square(own / _LOCAL_SIGMA).sum(axis=1)
        wider = np.maximum(1.0, (_FREEDOM + square) / (_FREEDOM + LOCAL))
        xi = xi + change
    return xi, information, np.diag(prior)


def _solved(
    samples: _Samples, weights: Array, off: Array, xi: Array, prior: Array, local: Array
) -> tuple[Array, Array, Array, Array]:
    """One step: change of xi (6,), information (blocks, 6 + COMMON, ...), what of off (n,) the
    disturbances explain, and the local ones (blocks, LOCAL), which are eliminated block by block.

    Args:
        local: (blocks, LOCAL), prior precisions of the local disturbances.
    """
    border = 6 + COMMON
    design, edges = samples.design, [*samples.starts, len(off)]
    weighted = design * weights[:, None]
    count, size = len(local), design.shape[1]
    normal, right = np.empty((count, size, size)), np.empty((count, size, 1))
    for block, (start, end) in enumerate(pairwise(edges)):
        normal[block] = design[start:end].T @ weighted[start:end]
        right[block, :, 0] = weighted[start:end].T @ off[start:end]
    inner = normal[:, border:, border:] + local[:, None] * np.eye(LOCAL)
    solved = np.linalg.solve(
        inner, np.concatenate([normal[:, border:, :border], right[:, border:]], axis=2)
    )
    left = np.concatenate([normal[:, :border, :border], right[:, :border]], axis=2)
    left -= normal[:, :border, border:] @ solved
    information, gradient = left[:, :, :border], left[:, :, border].sum(axis=0)
    gradient[:6] -= prior[:6] * xi
    change: Array = np.asarray(
        np.linalg.solve(information.sum(axis=0) + np.diag(prior), gradient), np.float64
    )
    owns = solved[:, :, border] - solved[:, :, :border] @ change
    of_samples = np.repeat(owns, np.diff(edges), axis=0)
    explained = design[:, 6:border] @ change[6:]
    explained += np.einsum("ni,ni->n", design[:, border:], of_samples)
    return change[:6], information, explained, owns


def _weights(off: Array, convex: bool) -> Array:
    """Weights of deviations (in standard deviations): Huber's first, then Tukey's.

    Some directions are determined by few samples (up and down, by the floor). At the start these
    samples may look like outliers, and Tukey's weights would discard them.
    """
    if convex:
        return np.asarray(_HUBER / np.maximum(off, _HUBER))
    return tukey(off)


def _changed(reference: DriftReference, now: tuple[Image, Image], xi: Array) -> Mask:
    """(r, c): where something stands that did not, or stands no longer, with its shadow."""
    gate = _CHANGED_PER_M + _CHANGED_PX * reference.steepness
    off, inside = _off(reference, now, xi)
    changed = (np.abs(off) > gate) & reference.usable & inside
    reach = np.ones((2 * _SHADOW_CELLS + 1,) * 2, np.uint8)
    return cv2.dilate(changed.astype(np.uint8), reach).astype(bool)


def _off(reference: DriftReference, now: tuple[Image, Image], xi: Array) -> tuple[Array, Mask]:
    """Differences (r, c) of the images from those expected after a displacement xi.

    The stored samples are looked for where they are now (Baker & Matthews 2004, "Lucas-Kanade 20
    years on": inverse compositional), so their sensitivities hold for any xi. Also tells which of
    them are inside the images.
    """
    points = reference.points
    there = transform(invert(se3_exp(xi)), points)
    x, y = np.moveaxis(project(reference.camera, there).astype(np.float32), -1, 0)
    surface, with_gaps = (cv2.remap(image, x, y, cv2.INTER_LINEAR) for image in now)
    seen = np.where(reference.outline, with_gaps, surface)
    nearer = reference.visible * (1.0 / there[..., 2] - 1.0 / points[..., 2])
    height, width = now[0].shape
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return seen - (reference.image + nearer), inside
