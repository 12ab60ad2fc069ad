"""Fitted poses that no standing person has: what the fit did with a part that it did not find."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from station.core.geometry import so3_log
from station.core.words.terms import part_in_words
from workers.cloud.observed import UNKNOWN_FLOOR, Finding
from workers.scape.evidence.crown import FACE_ALONE_M
from workers.scape.evidence.inside import shares_inside
from workers.scape.model.body_model import HAND, BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.verdict.hair import BROW_LEVELS, NAPE_LEVELS, zone_of_head

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAN_RAD = 0.26
"""Lean of the trunk from which it is not a person who stands: up to 0.13 in 50 sound scans."""
_HEAD_TURN_RAD = 0.8
"""Turn of the head against the chest from which it was not found: up to 0.4 in 50 sound scans, 1.5
to 2.4 where the readings of head and neck are missing and the neck bends to what is left."""
_INSIDE = 0.3
"""Share of a forearm, or of a hand, inside the body from which the arm was not found: 0 in sound
scans, 0.54 and more where the fit put the arm into the trunk, whose points then pass for the arm's.
A forearm that gave no reading was bent to the trunk with 0.5 of the hand and 0.28 of itself inside,
and passed for sound."""
_TOES_SHOWN, _AT_TOES_M = 0.6, 0.025
"""Least share of the upper side of a foot's toes that a bare cloud has points within this distance
of: 0.90 and more on 14 booth clouds and on sampled bodies of 3000 points or more. Of one foot at
least it is at most 0.24 where 4 cm are cut off, 0.06 where 6 are: the fit presses what is left of
the legs onto the floor."""
_OFF_FLOOR_M = 0.009
"""Distance of the lower foot from a bare cloud's lowest points from which these are no soles: -3.4
to 1.5 mm on eight sound bodies in 32 clouds, -7 on the vertices of one of another family, -11 and
less where 15 mm of the feet are cut off."""
_BROW_SEEN, _NAPE_SEEN = 0.6, 0.4
"""Share of the brow that was seen at least, and of the back of the head below it at most, if dark
hair hides the top: 0.75 and 0.13 on three bodies. Where 14 cm or more of a head are cut off,
heights are up to 44 mm off, and the brow has at most 0.47 or the back at least 0.5."""
_TOES_SHARE, _UPWARDS = 0.35, 0.5
"""Share of a foot's length that its toes are, and the least z component of its upper side's
normals."""


def arms_inside(model: BodyModel, vertices: Array) -> dict[str, str]:
    """Reasons by the forearm that lies inside the body, or whose hand does.

    Args:
        vertices: (P, 3), the fitted surface before crossings are mended.
    """
    forearms = ["forearm_left", "forearm_right"]
    hands = [[f"{part}_{side}" for part in HAND] for side in ("left", "right")]
    shares = shares_inside(model, vertices, [*([forearm] for forearm in forearms), *hands])
    return {
        forearm: f"the {part_in_words(forearm)} was not found: hold both arms away from the body"
        for forearm, *inside in zip(forearms, shares[:2], shares[2:], strict=True)
        if max(inside) > _INSIDE
    }


def head_turned(model: BodyModel, rotations: Array) -> dict[str, str]:
    """The reason by the head where it looks away from where the chest points.

    Args:
        rotations: (L, 3, 3), the parts' rotations from the neutral pose to the world.
    """
    chest, head = (rotations[model.part_names.index(part)] for part in ("chest", "head"))
    if np.linalg.norm(so3_log(chest.T @ head)) < _HEAD_TURN_RAD:
        return {}
    return {
        "head": "the head was not found: look straight ahead, with thick hair tied up or covered"
    }


def feet_cut_off(model: BodyModel, vertices: Array, points: Array) -> dict[str, str]:
    """Reasons by the foot whose toes a bare cloud does not show: its lowest points are no soles.

    Args:
        vertices: (P, 3), the fitted surface.
        points: (n, 3), the cloud's.
    """
    upper = vertex_normals(model.mean, model.faces)[:, 2] > _UPWARDS
    ahead = -model.mean[:, 1]
    reasons = {}
    for foot in ("foot_left", "foot_right"):
        mine = model.of_parts((foot,))
        toe, heel = ahead[mine].max(), ahead[mine].min()
        toes = vertices[mine & upper & (ahead > toe - _TOES_SHARE * (toe - heel))]
        low = points[points[:, 2] < toes[:, 2].max() + _AT_TOES_M]
        away = cKDTree(low).query(toes, distance_upper_bound=_AT_TOES_M)[0]
        if np.isfinite(away).mean() < _TOES_SHOWN:
            reasons[foot] = (
                f"the toes of the {part_in_words(foot)} were not seen: "
                "scan the person down to the soles"
            )
    return reasons


def off_floor(model: BodyModel, reference: Array) -> list[Finding]:
    """The finding that a bare cloud's lowest points are not the soles of who stands there.

    Args:
        reference: (P, 3), the model's surface before its feet are put on the floor.
    """
    low_m = float(reference[model.of_parts(("foot_left", "foot_right")), 2].min())
    if abs(low_m) < _OFF_FLOOR_M:
        return []
    distance = f"{1e3 * abs(low_m):.0f} mm"
    if low_m < 0.0:
        message = (
            f"the feet end {distance} below the lowest points of the cloud: "
            "scan the person down to the soles"
        )
    else:
        message = (
            f"the feet end {distance} above the floor of the cloud: "
            "leave only the person in it, with the soles at 0"
        )
    return [Finding(UNKNOWN_FLOOR, None, low_m, message)]


def head_cut_off(model: BodyModel, seen: Mask, crown_sigma_m: float) -> dict[str, str]:
    """The reason by the head where a bare cloud ends below its top and dark hair is no explanation.

    Args:
        seen: (P,), vertices with points.
        crown_sigma_m: of the head's top.
    """
    if crown_sigma_m < FACE_ALONE_M:
        return {}
    brow, nape = zone_of_head(model, BROW_LEVELS, 1.0), zone_of_head(model, NAPE_LEVELS, -1.0)
    if seen[brow].mean() > _BROW_SEEN and seen[nape].mean() < _NAPE_SEEN:
        return {}
    return {"head": "the top of the head was not seen: scan the person up to it"}


def leaning(model: BodyModel, rotations: Array) -> list[Finding]:
    """The finding that the trunk leans, where it does.

    Args:
        rotations: (L, 3, 3), as in `head_turned`.
    """
    upwards = sum(rotations[model.part_names.index(part)][:, 2] for part in ("pelvis", "chest"))
    lean = float(np.arctan2(np.linalg.norm(upwards[:2]), upwards[2]))
    if lean <= _LEAN_RAD:
        return []
    message = f"the person leans by {np.degrees(lean):.0f} degrees: stand upright"
    return [Finding("leaning", None, lean, message)]
