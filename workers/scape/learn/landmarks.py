"""Named points on the template that measuring starts from.

A landmark is a vertex of the template, the same in every model: what is learned from other bodies
moves the mean body and leaves the definitions of the rows alone. They were placed on a symmetric
mean body in the neutral pose, by its geometry and, where skin alone does not show where a bone
ends, by the shares of the stature of large surveys (ANSUR II, men and women averaged). The shares
below are those of the day they were placed; other mean bodies differ by up to 2 % of the stature.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_MIDDLE = {
    "crown": 690,  # highest point of the head
    "glabella": 234,  # foremost point of the brow
    "occiput": 4862,  # rearmost point of the head at the brow's height
    "chin": 4705,
    "cervicale": 666,  # seventh neck vertebra
    "suprasternale": 1079,  # pit of the neck, where the breast's slope turns up into the throat
    "neck_front": 600,  # below the larynx, where the neck is narrowest
    "neck_back": 664,  # behind it, perpendicular to the neck
    "crotch": 3889,  # lowest point of the trunk
    "waist_front": 3671,  # midway from the lowest rib to the hip bone: 0.628 of the stature
    "waist_back": 3547,
}
_LEFT = {
    "side_neck": 6842,  # where the shoulder's ridge turns up into the neck
    "acromion": 7326,  # top of the shoulder at half the biacromial breadth: 0.115 of the stature
    "armpit": 7389,  # deepest point
    "armpit_front": 7175,  # fold, 25 mm above the deepest point
    "armpit_back": 9520,
    "elbow": 9077,  # tip of the bent elbow
    "wrist": 9247,  # head of the ulna
    "knuckle": 9006,  # start of the middle finger, on its back
    "finger_joint": 7795,  # middle of the middle finger, on its back
    "fingertip": 7822,
    "waist_side": 9691,
    "hip_side": 9937,  # outermost point of the hip at the buttock's height
    "buttock": 9865,  # rearmost point
    "bust": 7522,  # foremost point of the breast
    "underbust": 7573,  # fold under the breast
    "knee": 10242,  # middle of the kneecap: 0.285 of the stature
    "calf": 10369,  # rearmost point
    "ankle": 11937,  # outer ankle bone: 0.040 of the stature
    "heel": 11409,
    "toe": 10562,  # end of the longest toe
    "ball_outer": 11721,
    "ball_inner": 11357,
}


def landmarks(symmetry: NDArray[np.int32]) -> dict[str, int]:
    """Landmark -> vertex of the template, given its symmetry map (P,)."""
    left = {f"{name}_left": vertex for name, vertex in _LEFT.items()}
    right = {f"{name}_right": int(symmetry[vertex]) for name, vertex in _LEFT.items()}
    return _MIDDLE | left | right
