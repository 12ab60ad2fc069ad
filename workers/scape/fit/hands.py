"""Hands: small, thin and quick to turn, so that descending from one guess loses every third.

A cross-entropy search (Rubinstein 1999) over the twists of hand, thumb and fingers, from their
prior, against the points beyond the wrist; everything else of the body stays where it is.
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

_SAMPLES = 130
_POINTS = 260
_LEAST_POINTS = 25
_REACH_M = 0.23
_BEHIND_WRIST_M = 0.015
_FOREIGN_M = 0.025
_CUT_M = 0.03
_DIRECTION_SCALE_M = 0.02
_MODEL_SHARE = 0.5
_PRIOR_M = 1e-4
"""Cost of one squared standard deviation off the prior, in metres of mean distance."""
_ROUNDS = (96, 64, 48, 32)
_ELITE = 8
_CURL = 2.0
"""Scale of the fingers' closing, which varies most: people make fists, training poses hardly do."""
_SPREAD = 1.25
"""Standard deviations of the prior that the first round spans."""


@dataclass(frozen=True, slots=True)
class Hand:
    """One side's hand as the search needs it."""

    side: str
    body: SampledBody
    parts: tuple[int, ...]
    """hand, thumb, fingers; every one after its parent."""
    forearm: int
    owner: NDArray[np.int32]
    """(n,): the part of each sample."""
    mean: Array
    """(9,): prior twists of the parts, radians."""
    spread: Array
    """(9, 9): a square root of their covariance, wider the way fingers close."""


def hands_of(model: BodyModel) -> tuple[Hand, ...]:
    """Both hands, their samples spread evenly."""
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
    """The state with both hands turned and closed as the points beyond the wrists say."""
    tree = OrientedTree.build(vertices, normals)

    def searched(hand: Hand) -> BodyState:
        points, directions = _beyond_wrist(model, hand, cloud, vertices, tree)
        if len(points) < _LEAST_POINTS:
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
    """Oriented points (n, 3) that can be the hand's: near it, and not the thigh's."""
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
    # Standard coordinates: the prior is N(0, I) in them.
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
        center, width = elite.mean(axis=0), elite.std(axis=0) + 0.02
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
    """The samples of one hand as functions of its parts' twists; the rest of the body is kept.

    B_p of the parts that the search does not turn enters turned, summed up as one arm.
    """

    state: BodyState
    twists: Array
    """(9,): as the body has them now."""
    still: Array
    """(n, 4, 3): B_p of hand, thumb and fingers, then the others' sum."""
    change: Array
    """(n 4 3, 9): of it, with the twists."""
    normals: Array
    """(n, 3): in the parts' own frames."""
    members: tuple[NDArray[np.intp], ...]
    """The samples of each part."""

    @classmethod
    def build(cls, model: BodyModel, hand: Hand, state: BodyState, normals: Array) -> _Tries:
        own = list(hand.parts)
        others = np.delete(np.arange(model.part_count), own)
        still, change = (found.astype(np.float64) for found in hand.body.arms(state, own))
        turns = state.rotations[others]
        rest = np.einsum("pij,npj->ni", turns, still[:, others])
        rest_change = np.einsum("pij,npjck->nick", turns, change[:, others])
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
        """(h, 6, n): the samples and their scaled normals for rotations (h, 3, 3, 3) of the parts
        and twists (h, 9)."""
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
