"""Named points on the template that measuring starts from, found once by their geometry.

Rules act on the symmetric mean body in the neutral pose (z up, facing -y, left is +x). What is
found is a vertex; every fit carries it along.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class _Template:
    def __init__(self, vertices: Array, parts: list[str], owner: NDArray[np.intp]) -> None:
        self.v = vertices
        self._parts = parts
        self._owner = owner

    def of(self, *names: str) -> NDArray[np.intp]:
        wanted = [self._parts.index(name) for name in names]
        return np.flatnonzero(np.isin(self._owner, wanted))

    def extreme(self, chosen: NDArray[np.intp], direction: tuple[float, float, float]) -> int:
        """The vertex that lies farthest along a direction."""
        return int(chosen[np.argmax(self.v[chosen] @ np.array(direction))])

    def nearest(self, point: Array, chosen: NDArray[np.intp] | None = None) -> int:
        pool = np.arange(len(self.v)) if chosen is None else chosen
        return int(pool[np.argmin(np.linalg.norm(self.v[pool] - point, axis=1))])

    def near_level(self, chosen: NDArray[np.intp], z: float, width: float) -> NDArray[np.intp]:
        return chosen[np.abs(self.v[chosen, 2] - z) < width]


def find_landmarks(vertices: Array, parts: list[str], owner: NDArray[np.intp]) -> dict[str, int]:
    """Landmark -> vertex of a template (P, 3) whose vertices belong to parts."""
    t = _Template(vertices, parts, owner)
    found = _head_and_trunk(t)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        found |= {f"{name}_{side}": vertex for name, vertex in _limbs(t, side, sign).items()}
    return found


def _head_and_trunk(t: _Template) -> dict[str, int]:
    v = t.v
    head, trunk = t.of("head"), t.of("pelvis", "abdomen", "chest")
    middle = trunk[np.abs(v[trunk, 0]) < 0.012]
    neck = t.of("neck")
    neck_middle = neck[np.abs(v[neck, 0]) < 0.012]
    neck_back = neck_middle[v[neck_middle, 1] > np.median(v[neck, 1])]
    neck_front = neck_middle[v[neck_middle, 1] < np.median(v[neck, 1])]
    crown = t.extreme(head, (0, 0, 1))
    crotch_band = middle[v[middle, 2] < v[middle, 2].min() + 0.02]
    crotch = t.extreme(crotch_band, (0, 0, -1))
    crotch_z, neck_z = v[crotch, 2], v[neck_back, 2].min()
    back = middle[v[middle, 1] > np.median(v[middle, 1])]
    front = middle[v[middle, 1] <= np.median(v[middle, 1])]
    torso = neck_z - crotch_z
    waist_z = crotch_z + 0.46 * torso
    hips = t.of("pelvis", "thigh_left", "thigh_right")
    hip_band = hips[(v[hips, 2] > crotch_z) & (v[hips, 2] < crotch_z + 0.3 * torso)]
    buttock = t.extreme(hip_band, (0, 1, 0))
    chest = t.of("chest", "abdomen")
    bust_band = chest[
        (np.abs(v[chest, 2] - (crotch_z + 0.74 * torso)) < 0.06) & (v[chest, 0] > 0.03)
    ]
    bust = t.extreme(bust_band, (0, -1, 0))
    mirrored_bust = t.nearest(v[bust] * (-1.0, 1.0, 1.0))
    return {
        "crown": crown,
        "glabella": t.extreme(t.near_level(head, v[crown, 2] - 0.105, 0.02), (0, -1, 0)),
        "occiput": t.extreme(t.near_level(head, v[crown, 2] - 0.10, 0.03), (0, 1, 0)),
        "chin": t.extreme(t.near_level(head, v[head, 2].min() + 0.05, 0.06), (0, -0.8, -0.6)),
        "cervicale": int(neck_back[np.argmin(v[neck_back, 2])]),
        "suprasternale": int(neck_front[np.argmin(v[neck_front, 2])]),
        "crotch": crotch,
        "bust_left": bust,
        "bust_right": mirrored_bust,
        "underbust_front": t.nearest(np.array([0, -0.2, v[bust, 2] - 0.065]), front),
        "waist_front": t.nearest(np.array([0, -0.2, waist_z]), front),
        "waist_back": t.nearest(np.array([0, 0.1, waist_z]), back),
        "navel": t.nearest(np.array([0, -0.2, waist_z - 0.04]), front),
        "high_hip_front": t.nearest(np.array([0, -0.2, 0.5 * (waist_z + v[buttock, 2])]), front),
        "buttock": buttock,
    }


def _limbs(t: _Template, side: str, sign: float) -> dict[str, int]:
    v = t.v

    def part(name: str) -> NDArray[np.intp]:
        return t.of(f"{name}_{side}")

    outward = (sign, 0.0, 0.0)
    upper, fore, hand = part("upper_arm"), part("forearm"), part("hand")
    thigh, shin, foot = part("thigh"), part("shin"), part("foot")
    elbow = 0.5 * (v[upper].mean(axis=0) + v[fore].mean(axis=0))
    border = np.concatenate([upper, fore])
    at_elbow = border[np.linalg.norm(v[border] - elbow, axis=1) < 0.09]
    forearm_axis = v[hand].mean(axis=0) - elbow
    forearm_axis /= np.linalg.norm(forearm_axis)
    wrist_end = fore[np.argsort(v[fore] @ forearm_axis)[-60:]]
    ulnar = (sign * 0.3, 0.8, -0.5)
    inner = np.quantile(np.abs(v[upper, 0]), 0.02)
    shoulder = np.concatenate([upper, part("shoulder"), t.of("chest")])
    shoulder = shoulder[
        (v[shoulder, 0] * sign > inner + 0.02) & (v[shoulder, 0] * sign < inner + 0.045)
    ]
    acromion = t.extreme(shoulder, (0, 0, 1))
    knee_z = 0.5 * (v[thigh, 2].min() + v[shin, 2].max())
    knee = t.near_level(np.concatenate([thigh, shin]), knee_z, 0.02)
    calf = t.near_level(shin, knee_z - 0.13, 0.05)
    ankle_z = v[foot, 2].min() + 0.075
    ankle = t.near_level(np.concatenate([shin, foot]), ankle_z, 0.015)
    ankle = ankle[v[ankle, 1] > np.quantile(v[foot, 1], 0.5)]
    fingers = part("fingers")
    neck_side = t.of("neck", "chest")
    low_neck = t.near_level(neck_side, v[t.of("neck"), 2].min() + 0.035, 0.02)
    armpit = t.extreme(upper, (-sign, 0, -0.6))
    around = np.concatenate([upper, t.of("chest")])
    fold = around[np.linalg.norm((v[around] - v[armpit])[:, [0, 2]], axis=1) < 0.035]
    hips = t.of("pelvis", "abdomen")
    return {
        "side_neck": t.extreme(low_neck, outward),
        "acromion": acromion,
        "armpit": armpit,
        "armpit_front": t.extreme(fold, (0, -1, 0)),
        "armpit_back": t.extreme(fold, (0, 1, 0)),
        "elbow": t.extreme(at_elbow, (sign * 0.25, 0.95, 0.1)),
        "wrist": t.extreme(wrist_end, ulnar),
        "fingertip": t.extreme(fingers, tuple(forearm_axis)),
        "iliac": t.extreme(
            t.near_level(hips, v[hips, 2].min() + 0.75 * np.ptp(v[t.of("pelvis"), 2]), 0.02),
            outward,
        ),
        "knee": t.extreme(knee, (0, -1, 0)),
        "knee_outer": t.extreme(knee, outward),
        "calf": t.extreme(calf, (0, 1, 0)),
        "ankle": t.extreme(ankle, outward),
        "heel": t.extreme(foot, (0, 1, -0.2)),
        "toe": t.extreme(foot, (0, -1, 0)),
    }
