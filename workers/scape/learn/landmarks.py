"""Named points on the template that measuring starts from, found once by their geometry.

Rules act on the symmetric mean body in the neutral pose (z up, facing -y, left is +x). What is
found is a vertex; every fit carries it along. Shares of the stature are those of large surveys
(ANSUR II, men and women averaged) and serve where skin alone does not show where a bone ends.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pool = NDArray[np.intp]

_ACROMION_HALF_BREADTH = 0.115
"""Half the biacromial breadth, as a share of the stature."""
_WAIST_HEIGHT = 0.628
"""Midway from the lowest rib to the top of the hip bone, as a share of the stature."""
_NECK_HALF_BREADTH = (0.030, 0.040)
"""Half the breadth of the neck's foot, as a share of the stature: biacromial breadth less both
shoulders, which slope by 20 degrees, leaves 0.067 m in men and 0.055 m in women."""
_MALLEOLUS_HEIGHT = 0.040
"""Outer ankle bone above the floor, as a share of the stature."""
_FRONT = (0.0, -1.0, 0.0)
_BACK = (0.0, 1.0, 0.0)
_UP = (0.0, 0.0, 1.0)
_DOWN = (0.0, 0.0, -1.0)
_LEFT = (1.0, 0.0, 0.0)


class _Template:
    def __init__(self, vertices: Array, parts: list[str], owner: NDArray[np.intp]) -> None:
        self.v = vertices
        self.stature = float(np.ptp(vertices[:, 2]))
        self._parts = parts
        self._owner = owner

    def of(self, *names: str) -> Pool:
        """The vertices of some parts."""
        wanted = [self._parts.index(name) for name in names]
        return np.flatnonzero(np.isin(self._owner, wanted))

    def middle(self, pool: Pool) -> Pool:
        """Those of a pool that lie in the plane of symmetry."""
        return pool[np.abs(self.v[pool, 0]) < 1e-3]

    def extreme(self, pool: Pool, direction: tuple[float, float, float] | Array) -> int:
        """The vertex of a pool that lies farthest along a direction."""
        return int(pool[np.argmax(self.v[pool] @ np.asarray(direction))])

    def nearest(self, pool: Pool, point: Array | tuple[float, float, float]) -> int:
        """The vertex of a pool that lies nearest to a point."""
        return int(pool[np.argmin(np.linalg.norm(self.v[pool] - point, axis=1))])

    def level(self, pool: Pool, z: float, width: float) -> Pool:
        """Those of a pool within a horizontal slab."""
        return pool[np.abs(self.v[pool, 2] - z) < width]

    def border(self, first: str, second: str) -> Array:
        """The middle of the seam between two parts."""
        a, b = self.v[self.of(first)], self.v[self.of(second)]
        away = np.linalg.norm(a[:, None] - b[None], axis=2)
        ends = (a[np.argsort(away.min(axis=1))[:20]], b[np.argsort(away.min(axis=0))[:20]])
        return np.asarray(np.concatenate(ends).mean(axis=0))


def find_landmarks(vertices: Array, parts: list[str], owner: NDArray[np.intp]) -> dict[str, int]:
    """Landmark -> vertex of a symmetric template (P, 3) whose vertices belong to parts (P,)."""
    t = _Template(vertices, parts, owner)
    found = _head_and_neck(t)
    found |= _trunk(t)
    left = _shoulder(t) | _arm(t) | _leg(t) | _flank(t, found)
    every = np.arange(len(vertices))
    for name, vertex in left.items():
        found[f"{name}_left"] = vertex
        found[f"{name}_right"] = t.nearest(every, vertices[vertex] * (-1.0, 1.0, 1.0))
    return found


def _head_and_neck(t: _Template) -> dict[str, int]:
    v = t.v
    head, neck = t.of("head"), t.of("neck")
    head_middle, neck_middle = t.middle(head), t.middle(t.of("neck", "chest", "head"))
    crown = t.extreme(head, _UP)
    brow_z = v[crown, 2] - 0.06 * t.stature
    axis_y = float(np.median(v[neck, 1]))
    back = t.middle(neck)[v[t.middle(neck), 1] > axis_y]
    cervicale = t.extreme(back, _DOWN)
    chin = t.extreme(t.level(head_middle, v[head, 2].min() + 0.05, 0.06), (0.0, -0.8, -0.6))
    # The pit of the neck: where the breast's slope turns up into the throat.
    throat = neck_middle[
        (v[neck_middle, 1] < axis_y)
        & (v[neck_middle, 2] < v[chin, 2] - 0.02)
        & (v[neck_middle, 2] > v[cervicale, 2] - 0.12)
    ]
    deepest = v[throat, 1].max()
    pit = t.extreme(throat[v[throat, 1] > deepest - 0.003], _DOWN)
    # Below the larynx, where the neck is narrowest; square to it: it leans forwards by 19 degrees.
    neck_front = t.nearest(throat, (0.0, v[pit, 1], 0.32 * v[pit, 2] + 0.68 * v[chin, 2]))
    across = v[cervicale, 1] - v[neck_front, 1]
    neck_back = t.nearest(
        back, (0.0, v[cervicale, 1], v[neck_front, 2] + np.tan(np.radians(19.0)) * across)
    )
    return {
        "crown": crown,
        "glabella": t.extreme(t.level(head_middle, brow_z, 0.012), _FRONT),
        "occiput": t.extreme(t.level(head_middle, brow_z, 0.02), _BACK),
        "chin": chin,
        "cervicale": cervicale,
        "suprasternale": pit,
        "neck_front": neck_front,
        "neck_back": neck_back,
    }


def _trunk(t: _Template) -> dict[str, int]:
    v = t.v
    middle = t.middle(t.of("pelvis", "abdomen", "chest"))
    crotch = t.extreme(middle, _DOWN)
    depth = float(np.median(v[middle, 1]))
    front, back = middle[v[middle, 1] < depth], middle[v[middle, 1] > depth]
    waist_z = _WAIST_HEIGHT * t.stature
    return {
        "crotch": crotch,
        "waist_front": t.nearest(front, (0.0, v[front, 1].min(), waist_z)),
        "waist_back": t.nearest(back, (0.0, v[back, 1].max(), waist_z)),
    }


def _flank(t: _Template, found: dict[str, int]) -> dict[str, int]:
    v = t.v
    left = np.flatnonzero(v[:, 0] > 0.02)
    trunk = np.intersect1d(t.of("pelvis", "abdomen", "chest"), left)
    hips = np.intersect1d(t.of("pelvis", "thigh_left"), left)
    crotch_z, waist_z = v[found["crotch"], 2], v[found["waist_front"], 2]
    torso = v[found["cervicale"], 2] - crotch_z
    buttock = t.extreme(t.level(hips, crotch_z + 0.12 * torso, 0.08 * torso), _BACK)
    chest = np.intersect1d(t.of("chest", "abdomen"), left)
    bust_band = t.level(chest, crotch_z + 0.655 * torso, 0.06)
    bust = t.extreme(bust_band, _FRONT)
    return {
        "waist_side": t.extreme(t.level(trunk, waist_z, 0.012), _LEFT),
        "buttock": buttock,
        "hip_side": t.extreme(t.level(hips, v[buttock, 2], 0.012), _LEFT),
        "bust": bust,
        "underbust": _fold_below(t, chest, v[bust], waist_z),
    }


def _fold_below(t: _Template, chest: Pool, bust: Array, waist_z: float) -> int:
    """The fold under a breast: what lies farthest behind the straight line to the belly."""
    v = t.v
    column = chest[
        (np.abs(v[chest, 0] - bust[0]) < 0.015)
        & (v[chest, 2] < bust[2])
        & (v[chest, 2] > waist_z)
        & (v[chest, 1] < bust[1] + 0.05)
    ]
    belly = v[t.nearest(column, (bust[0], bust[1], waist_z))]
    share = (bust[2] - v[column, 2]) / (bust[2] - belly[2])
    behind = v[column, 1] - (bust[1] + share * (belly[1] - bust[1]))
    return int(column[np.argmax(behind)])


def _shoulder(t: _Template) -> dict[str, int]:
    v = t.v
    upper = t.of("upper_arm_left")
    roof = t.of("upper_arm_left", "shoulder_left", "chest", "neck")
    roof = roof[v[roof, 0] > 0.03]
    out = _ACROMION_HALF_BREADTH * t.stature
    acromion = t.extreme(roof[np.abs(v[roof, 0] - out) < 0.006], _UP)
    side_neck = _foot_of_neck(t, roof, acromion)
    armpit = t.extreme(upper, (-1.0, 0.0, -0.6))
    around = np.concatenate([upper, t.of("chest"), t.of("shoulder_left")])
    fold = around[
        (np.abs(v[around, 0] - v[armpit, 0]) < 0.012)
        & (np.abs(v[around, 2] - v[armpit, 2] - 0.025) < 0.012)
    ]
    return {
        "side_neck": side_neck,
        "acromion": acromion,
        "armpit": armpit,
        "armpit_front": t.extreme(fold, _FRONT),
        "armpit_back": t.extreme(fold, _BACK),
    }


def _foot_of_neck(t: _Template, roof: Pool, acromion: int) -> int:
    """Side of the neck's foot: the corner where the shoulder's ridge turns up into the neck."""
    v = t.v
    # In front of the trapezius' bulk: no farther back than the middle of the neck.
    forward = v[roof, 1] < np.median(v[t.of("neck"), 1]) + 0.015
    near, far = np.multiply(_NECK_HALF_BREADTH, t.stature)
    above = roof[forward & (v[roof, 2] > v[acromion, 2]) & (v[roof, 0] < v[acromion, 0])]
    beside = np.abs(v[above, 0][:, None] - v[above, 0][None]) < 0.006
    ridge = above[v[above, 2] >= np.where(beside, v[above, 2][None], -np.inf).max(axis=1)]
    shoulder = v[acromion] - v[t.nearest(ridge, v[acromion] * (0.5, 1.0, 1.0))]
    shoulder /= np.linalg.norm(shoulder[[0, 2]])
    at_neck = ridge[(v[ridge, 0] > near) & (v[ridge, 0] < far)]
    # A template broader or coarser than people has no ridge there: its corner alone decides.
    return t.extreme(at_neck if len(at_neck) else ridge, -(shoulder * (1.0, 0.0, 1.0) + _UP))


def _arm(t: _Template) -> dict[str, int]:
    v = t.v
    fore, hand = t.of("forearm_left"), t.of("hand_left")
    joint = t.border("upper_arm_left", "forearm_left")
    wrist = t.border("forearm_left", "hand_left")
    along = wrist - joint
    along /= np.linalg.norm(along)
    near_elbow = t.of("upper_arm_left", "forearm_left")
    near_elbow = near_elbow[np.linalg.norm(v[near_elbow] - joint, axis=1) < 0.08]
    # The little finger's side: away from the thumb, square to the forearm.
    ulnar = v[hand].mean(axis=0) - v[t.of("thumb_left")].mean(axis=0)
    ulnar -= along * (ulnar @ along)
    # The head of the ulna stands out a little before the narrowest place.
    ring = np.concatenate([fore, hand])
    ring = ring[np.abs((v[ring] - wrist) @ along + 0.008) < 0.008]
    tip = t.extreme(t.of("fingers_left"), t.border("hand_left", "fingers_left") - wrist)
    knuckle, finger_joint = _back_of_finger(t, tip)
    # The tip of the bent elbow: away from shoulder and wrist alike.
    shoulder = t.border("shoulder_left", "upper_arm_left") - joint
    outwards = -(shoulder / np.linalg.norm(shoulder) + along)
    return {
        "elbow": t.extreme(near_elbow, outwards),
        "wrist": t.extreme(ring, ulnar),
        "knuckle": knuckle,
        "finger_joint": finger_joint,
        "fingertip": tip,
    }


def _back_of_finger(t: _Template, tip: int) -> tuple[int, int]:
    """Two vertices on the back of the finger with this tip: where it starts, and its middle."""
    v = t.v
    fingers = t.of("fingers_left")
    end = v[fingers[np.linalg.norm(v[fingers] - v[tip], axis=1) < 0.03]]
    direction = np.linalg.svd(end - end.mean(axis=0))[2][0]
    direction *= np.sign(direction @ (v[fingers].mean(axis=0) - v[tip]))
    offset = v[fingers] - end.mean(axis=0)
    aside = np.linalg.norm(offset - np.outer(offset @ direction, direction), axis=1)
    finger = fingers[aside < 0.010]
    along = (v[finger] - v[tip]) @ direction
    start = finger[along > along.max() - 0.008]
    middle = finger[np.abs(along - 0.5 * along.max()) < 0.006]
    return t.extreme(start, _LEFT), t.extreme(middle, _LEFT)


def _leg(t: _Template) -> dict[str, int]:
    v = t.v
    shin, foot = t.of("shin_left"), t.of("foot_left")
    knee_z = t.border("thigh_left", "shin_left")[2] + 0.006 * t.stature
    knee = t.level(t.of("thigh_left", "shin_left"), knee_z, 0.018)
    ankle = t.level(np.concatenate([shin, foot]), _MALLEOLUS_HEIGHT * t.stature, 0.009)
    ankle = ankle[v[ankle, 1] > np.quantile(v[foot, 1], 0.5)]
    ball = foot[
        np.abs(v[foot, 1] - np.quantile(v[foot, 1], 0.0) - 0.28 * np.ptp(v[foot, 1])) < 0.012
    ]
    return {
        "knee": t.extreme(knee, _FRONT),
        "calf": t.extreme(t.level(shin, knee_z - 0.08 * t.stature, 0.05), _BACK),
        "ankle": t.extreme(ankle, _LEFT),
        "heel": t.extreme(foot, (0.0, 1.0, -0.2)),
        "toe": t.extreme(foot, _FRONT),
        "ball_outer": t.extreme(ball, _LEFT),
        "ball_inner": t.extreme(ball, (-1.0, 0.0, 0.0)),
    }
