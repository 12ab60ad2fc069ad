"""Search for the pose of the hands, which are too small and thin for a descent from one guess.

A cross-entropy search (Rubinstein 1999) over the twists of hand, thumb and fingers samples them
from their prior and compares them with the points beyond the wrist; the rest of the body is fixed.
Descending from one guess alone loses every third hand.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from station.core.geometry import so3_exp
from workers.scape.evidence.correspondence import OrientedTree
from workers.scape.model.body_model import HAND, BodyModel, BodyState
from workers.scape.model.kernels import trimmed_costs
from workers.scape.model.sampled import SampledBody
from workers.scape.model.spread import farthest_first

Array = NDArray[np.float64]

_SAMPLES, _POINTS = 130, 260
"""Vertices of a hand, and points of the cloud, that are compared."""
_MIN_POINTS = 25
"""Points below which a hand stays as it is."""
_REACH_M = 0.23
"""Radius around the wrist within which points can belong to the hand: the longest hands."""
_BEHIND_WRIST_M = 0.015
"""Distance towards the elbow up to which points count."""
_FOREIGN_M = 0.025
"""Distance to another part's surface beyond which a point is not that part's."""
_CUT_M = 0.03
"""Largest distance that counts, so that stray points cost no more."""
_DIRECTION_SCALE_M = 0.02
"""Scale of normals against positions: opposite normals count as 4 cm."""
_MODEL_SHARE = 0.5
"""Weight of the distances from the hand to the cloud: a part of the hand is not seen."""
_PRIOR_M = 1e-4
"""Cost of one squared standard deviation from the prior, in metres of mean distance."""
_ROUNDS = (96, 64, 48, 32)
"""Poses that are tried in each round."""
_ELITE = 8
"""Best poses of a round, whose mean and spread the next round samples from."""
_MIN_SPREAD = 0.02
"""Added to this spread, in standard deviations, so that the search does not freeze."""
_CURL = 2.0
"""Factor of the prior's widest direction, the closing of the fingers: people make fists, the
training poses hardly do."""
_SPREAD = 1.25
"""Spread of the first round, in standard deviations of the prior."""


@dataclass(frozen=True, slots=True)
class Hand:
    """One hand of the model, prepared for the search."""

    side: str
    body: SampledBody
    parts: tuple[int, ...]
    """Indices of hand, thumb and fingers, each after its parent."""
    forearm: int
    owner: NDArray[np.int32]
    """(n,): part of each sample."""
    mean: Array
    """(9,): prior twists of the parts, radians."""
    spread: Array
    """(9, 9): square root of their covariance, widened in the direction in which fingers close."""


def hands_of(model: BodyModel) -> tuple[Hand, ...]:
    """Both hands, with evenly spread samples."""
    return tuple(_hand(model, side) for side in ("left", "right"))


def _hand(model: BodyModel, side: str) -> Hand:
    names = model.part_names
    parts = tuple(names.index(f"{part}_{side}") for part in HAND)
    mine = np.flatnonzero(np.isin(model.part_of_vertex, parts))
    order = farthest_first(model.mean[mine], _SAMPLES)
    columns = np.concatenate([np.arange(3 * (p - 1), 3 * p) for p in parts])
    values, vectors = np.linalg.eigh(model.twist_covariance[np.ix_(columns, columns)])
    values[-1] *= _CURL**2
    body = SampledBody.build(model, mine[order])
    return Hand(
        side=side,
        body=body,
        parts=parts,
        forearm=names.index(f"forearm_{side}"),
        owner=model.part_of_vertex[body.indices],
        mean=model.twist_mean[columns],
        spread=vectors * np.sqrt(np.maximum(values, 0.0)),
    )


def place_hands(
    model: BodyModel,
    hands: tuple[Hand, ...],
    cloud: OrientedTree,
    state: BodyState,
    vertices: Array,
    normals: Array,
) -> BodyState:
    """State with both hands posed to match the points beyond the wrists.

    Args:
        vertices: (P, 3), the body in that state.
        normals: (P, 3), its normals.
    """
    tree = OrientedTree.build(vertices, normals)

    def searched(hand: Hand) -> BodyState:
        points, directions = _beyond_wrist(model, hand, cloud, vertices, tree)
        if len(points) < _MIN_POINTS:
            return state
        return _searched(model, hand, state, normals, points, directions)

    rotations = state.rotations.copy()
    with ThreadPoolExecutor(max_workers=len(hands)) as pool:
        for hand, found in zip(hands, pool.map(searched, hands), strict=True):
            rotations[list(hand.parts)] = found.rotations[list(hand.parts)]
    return replace(state, rotations=rotations)


def _beyond_wrist(
    model: BodyModel, hand: Hand, cloud: OrientedTree, vertices: Array, tree: OrientedTree
) -> tuple[Array, Array]:
    """Oriented points (n, 3) that can belong to the hand: near it, and not to the thigh."""
    weights = model.vertex_weights
    ring = weights[:, hand.forearm] * weights[:, hand.parts[0]]
    wrist = ring @ vertices / ring.sum()
    elbow_side = weights[:, hand.forearm] @ vertices / weights[:, hand.forearm].sum()
    along = (wrist - elbow_side) / np.linalg.norm(wrist - elbow_side)
    offsets = cloud.points - wrist
    near = np.flatnonzero(
        (offsets @ along > -_BEHIND_WRIST_M)
        & (np.einsum("ni,ni->n", offsets, offsets) < _REACH_M**2)
    )
    near = near[:: max(1, len(near) // _POINTS)]
    points, directions = cloud.points[near], cloud.normals[near]
    vertex = tree.nearest(points, directions)
    own = np.isin(model.part_of_vertex[vertex], (*hand.parts, hand.forearm))
    away = np.linalg.norm(points - vertices[vertex], axis=1)
    kept = own | (away > _FOREIGN_M)
    return points[kept], directions[kept]


def _searched(
    model: BodyModel,
    hand: Hand,
    state: BodyState,
    normals: Array,
    points: Array,
    directions: Array,
) -> BodyState:
    tries = _Tries.build(model, hand, state, normals[hand.body.indices])
    # In these coordinates the prior is N(0, I).
    inverse = np.linalg.pinv(hand.spread, rcond=1e-3)
    found = inverse @ (tries.twists - hand.mean)
    cloud = np.concatenate([points, _DIRECTION_SCALE_M * directions], axis=1).astype(np.float32)
    rng = np.random.default_rng(0)
    center, width = np.zeros(len(found)), np.full(len(found), _SPREAD)
    best, least = found, np.inf
    for count in _ROUNDS:
        tried = center + width * rng.standard_normal((count, len(found)))
        tried[0] = best
        twists = hand.mean + tried @ hand.spread.T
        samples = tries.posed(_rotations(model, hand, state, twists), twists)
        cost = trimmed_costs(samples, cloud, _CUT_M, _CUT_M, _MODEL_SHARE)
        cost = cost + _PRIOR_M * np.sum(tried**2, axis=1)
        order = np.argsort(cost, kind="stable")
        if cost[order[0]] < least:
            best, least = tried[order[0]], float(cost[order[0]])
        elite = tried[order[:_ELITE]]
        center, width = elite.mean(axis=0), elite.std(axis=0) + _MIN_SPREAD
    rotations = _rotations(model, hand, state, (hand.mean + hand.spread @ best)[None])
    turned = state.rotations.copy()
    turned[list(hand.parts)] = rotations[0]
    return replace(state, rotations=turned)


def _rotations(model: BodyModel, hand: Hand, state: BodyState, twists: Array) -> Array:
    """(h, 3, 3, 3): absolute rotations of the hand's parts for twists (h, 9)."""
    relative = so3_exp(twists.reshape(-1, 3, 3))
    found = np.empty_like(relative)
    for index, part in enumerate(hand.parts):
        parent = int(model.part_parents[part])
        base = (
            found[:, hand.parts.index(parent)]
            if parent in hand.parts
            else state.rotations[parent][None]
        )
        found[:, index] = base @ relative[:, index]
    return found


@dataclass(frozen=True, slots=True)
class _Tries:
    """Samples of one hand as functions of its parts' twists; the rest of the body is fixed.

    Contributions B_p of the parts that stay fixed are rotated once and summed up.
    """

    state: BodyState
    twists: Array
    """(9,): present twists."""
    still: Array
    """(n, 4, 3): B_p of hand, thumb and fingers, and the sum of the others."""
    change: Array
    """(n 4 3, 9): derivative of `still` by the twists."""
    normals: Array
    """(n, 3): normals in the frames of their parts."""
    members: tuple[NDArray[np.intp], ...]
    """Indices of each part's samples."""

    @classmethod
    def build(cls, model: BodyModel, hand: Hand, state: BodyState, normals: Array) -> _Tries:
        own = list(hand.parts)
        others = np.delete(np.arange(model.part_count), own)
        still, change = (found.astype(np.float64) for found in hand.body.arms(state, own))
        turns = state.rotations[others]
        rest = np.einsum("pij,npj->ni", turns, still[:, others])
        rest_change = np.einsum("pij,npjck->nick", turns, change[:, others], optimize=True)
        members = tuple(np.flatnonzero(hand.owner == part) for part in own)
        local = np.empty_like(normals)
        for part, mine in zip(own, members, strict=True):
            local[mine] = normals[mine] @ state.rotations[part]
        still = np.concatenate([still[:, own], rest[:, None]], axis=1)
        change = np.concatenate([change[:, own], rest_change[:, None]], axis=1)
        return cls(
            state,
            model.relative_twists(state.rotations)[own].ravel(),
            still,
            change.reshape(still.size, -1),
            local,
            members,
        )

    def posed(self, rotations: Array, twists: Array) -> NDArray[np.float32]:
        """Positions and scaled normals (h, 6, n) of the samples for h poses.

        Args:
            rotations: (h, 3, 3, 3), of the three parts.
            twists: (h, 9).
        """
        count, tries = len(self.still), len(twists)
        arms = (self.change @ (twists - self.twists).T).T.reshape(tries, count, 4, 3) + self.still
        turning = np.concatenate(
            [np.swapaxes(rotations, 2, 3), np.broadcast_to(np.eye(3), (tries, 1, 3, 3))], axis=1
        )
        out = np.empty((tries, 6, count), np.float32)
        positions = arms.reshape(tries, count, 12) @ turning.reshape(tries, 12, 3)
        out[:, :3] = np.swapaxes(positions + self.state.translation, 1, 2)
        for index, mine in enumerate(self.members):
            turned = rotations[:, index] @ self.normals[mine].T
            out[:, 3:, mine] = _DIRECTION_SCALE_M * turned
        return out
