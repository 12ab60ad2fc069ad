"""Table of measurements: the definition of each row, in words and for the program.

Landmarks are vertices of the template (workers.scape.learn.landmarks) and parts are its parts, so a
definition is made once and applies to every fit. Clauses of ISO 8559-1:2017 (clothing) and ISO
7250-1:2017 (body) are given where public sources name them: the contents of ISO 8559-1 in its free
preview, and measuring guides that quote its clauses. A row that follows a standard whose clause
could not be confirmed names the standard alone; a row that differs from its standard names none.
"""

from __future__ import annotations

from workers.measure.kinds import (
    Definition,
    Drop,
    Foremost,
    Leg,
    Level,
    Perpendicular,
    Route,
    Section,
    Tilted,
    Top,
)

TRUNK = ("pelvis", "abdomen", "chest")
HIPS = (*TRUNK, "thigh_left", "thigh_right")
SHOULDERS = (
    "neck", "chest", "shoulder_left", "shoulder_right", "upper_arm_left", "upper_arm_right",
)  # fmt: skip
YOKE = tuple(part for part in SHOULDERS if part != "neck")
"""Parts below the seventh neck vertebra, without a neck that may lean to one side."""
FLANK = (*HIPS, "shin_left", "shin_right")

_CLOTHES = "ISO 8559-1:2017"
_BODY = "ISO 7250-1:2017"
_BUST = ("bust_left", "bust_right")
_UNDERBUST = ("underbust_left", "underbust_right")
_WAIST = ("waist_front", "waist_back", "waist_side_left", "waist_side_right")
_BUTTOCKS = ("buttock_left", "buttock_right")
_ARMPITS = ("armpit_left", "armpit_right")
_BELLY = Foremost(
    Level(_WAIST, _UNDERBUST, 0.5), Level(_BUTTOCKS), "waist_front", "waist_back",
    ("pelvis", "abdomen"),
)  # fmt: skip


def _both(name: str) -> tuple[str, str]:
    return f"{name}_right", f"{name}_left"


def _height(name: str, words: str, landmark: str, standard: str = "") -> Definition:
    return Definition(name, words, "height", Route((landmark,), ("floor",)), standard)


def _distance(name: str, words: str, landmarks: tuple[str, ...], standard: str = "") -> Definition:
    straight: tuple[Leg, ...] = tuple("straight" for _ in landmarks[1:])
    return Definition(name, words, "distance", Route(landmarks, straight), standard)


def _heights() -> tuple[Definition, ...]:
    return (
        Definition("height", "top of the head above the floor", "height", Top("head"), _BODY),
        _height("nape_to_floor", "seventh neck vertebra above the floor", "cervicale", _CLOTHES),
        _height("chin_height", "chin above the floor", "chin"),
        _height("shoulder_height", "right shoulder point above the floor", "acromion_right", _BODY),
        _height("bust_height", "right bust point above the floor", "bust_right", _CLOTHES),
        _height("waist_height", "front of the natural waist above the floor", "waist_front",
                _CLOTHES),
        _height("hip_height", "right buttock's farthest point above the floor", "buttock_right",
                _CLOTHES),
        _height("crotch_height", "inside leg: crotch above the floor", "crotch", _BODY),
        _height("knee_height", "middle of the right kneecap above the floor", "knee_right",
                _CLOTHES),
    )  # fmt: skip


def _trunk_girths() -> tuple[Definition, ...]:
    waist, chest, hips = Level(_WAIST), Level(_BUST), Level(_BUTTOCKS)
    return (
        Definition(
            "head_girth", "around brow and back of the head, above the ears", "girth",
            Section(Tilted("glabella", "occiput", *_both("side_neck")), ("head",), whole=True),
            _BODY,
        ),
        Definition(
            "neck_girth", "just below the larynx, perpendicular to the neck", "girth",
            Section(
                Tilted("neck_front", "neck_back", *_both("side_neck")),
                ("neck", "head", "chest"),
            ),
            f"{_CLOTHES} 5.3.2",
        ),
        Definition(
            "neck_base_girth",
            "seventh neck vertebra, side of the neck, pit of the neck and around, over the skin",
            "girth",
            Route(
                ("cervicale", "side_neck_left", "suprasternale", "side_neck_right"),
                ("tape", "tape", "tape", "tape"), SHOULDERS, closed=True,
            ),
            f"{_CLOTHES} 5.3.3",
        ),
        Definition(
            "chest_girth", "level, at the bust points", "large girth",
            Section(chest, TRUNK, whole=True), f"{_CLOTHES} 5.3.4",
        ),
        Definition(
            "high_bust_girth", "level, below the armpits and above the bust", "large girth",
            Section(Level(_ARMPITS, _BUST, 0.3), TRUNK, whole=True), f"{_CLOTHES} 5.3.6",
        ),
        Definition(
            "underbust_girth", "level, in the fold below the bust", "large girth",
            Section(Level(_UNDERBUST), TRUNK, whole=True), f"{_CLOTHES} 5.3.8",
        ),
        Definition(
            "waist_girth", "level, at the natural waist between ribs and hip bones", "large girth",
            Section(waist, TRUNK, whole=True), f"{_CLOTHES} 5.3.10",
        ),
        Definition(
            "trouser_waist_girth",
            "level, a quarter of the way from waist to hip, where trousers are worn", "large girth",
            Section(Level(_WAIST, _BUTTOCKS, 0.25), HIPS, whole=True),
        ),
        Definition(
            "belly_girth", "level, where the belly protrudes farthest", "large girth",
            Section(_BELLY, HIPS, whole=True),
        ),
        Definition(
            "trunk_girth",
            "side of the neck over bust point and waist, between the legs, up the back, right side",
            "large girth",
            Route(
                ("side_neck_right", "bust_right", "waist_front", "crotch", "waist_back"),
                ("tape", "tape", "tape", "tape", "tape"), (*TRUNK, *SHOULDERS), closed=True,
            ),
            _CLOTHES,
        ),
        Definition(
            "high_hip_girth", "level, midway from waist to hip", "large girth",
            Section(Level(_WAIST, _BUTTOCKS, 0.5), HIPS, whole=True), f"{_CLOTHES} 5.3.12",
        ),
        Definition(
            "hip_girth", "level, where the buttocks protrude farthest", "large girth",
            Section(hips, HIPS, whole=True), f"{_CLOTHES} 5.3.13",
        ),
        Definition(
            "chest_breadth", "at the bust points, from side to side", "breadth",
            Section(chest, TRUNK, whole=True, across=_both("armpit")), _BODY,
        ),
        Definition(
            "chest_depth", "at the bust points, from front to back", "depth",
            Section(chest, TRUNK, whole=True, across=_both("armpit")), _BODY,
        ),
        Definition(
            "waist_breadth", "at the natural waist, from side to side", "breadth",
            Section(waist, TRUNK, whole=True, across=_both("waist_side")),
        ),
        Definition(
            "waist_depth", "at the natural waist, from front to back", "depth",
            Section(waist, TRUNK, whole=True, across=_both("waist_side")),
        ),
        Definition(
            "hip_breadth", "where the buttocks protrude farthest, from side to side", "breadth",
            Section(hips, HIPS, whole=True, across=_both("hip_side")), _BODY,
        ),
        Definition(
            "hip_depth", "where the buttocks protrude farthest, from front to back", "depth",
            Section(hips, HIPS, whole=True, across=_both("hip_side")),
        ),
    )  # fmt: skip


def _trunk_lengths() -> tuple[Definition, ...]:
    return (
        _distance("shoulder_width", "shoulder point to shoulder point, straight",
                  _both("acromion"), _BODY),
        Definition(
            "across_back_shoulder_width",
            "shoulder point over the seventh neck vertebra to the other", "length",
            Route(("acromion_right", "cervicale", "acromion_left"), ("tape", "tape"), YOKE),
            f"{_CLOTHES} 5.4.3",
        ),
        _distance("across_back_width", "between the back folds of the armpits, straight",
                  _both("armpit_back"), _CLOTHES),
        _distance("across_front_width", "between the front folds of the armpits, straight",
                  _both("armpit_front"), _CLOTHES),
        _distance("bust_point_width", "bust point to bust point, straight", _BUST, _CLOTHES),
        Definition(
            "back_waist_length", "seventh neck vertebra to the waist, following the back's curve",
            "length", Route(("cervicale", "waist_back"), ("skin",), ("neck", *TRUNK)),
            f"{_CLOTHES} 5.4.5",
        ),
        Definition(
            "front_waist_length", "pit of the neck to the waist, along the front", "length",
            Route(("suprasternale", "waist_front"), ("tape",), ("neck", *TRUNK)),
            f"{_CLOTHES} 5.4.8",
        ),
        Definition(
            "across_back_skin_width", "between the back folds of the armpits, along the skin",
            "length", Route(_both("armpit_back"), ("tape",), YOKE), _CLOTHES,
        ),
        Definition(
            "across_front_skin_width", "between the front folds of the armpits, along the skin",
            "length", Route(_both("armpit_front"), ("tape",), YOKE), f"{_CLOTHES} 5.4.7",
        ),
        Definition(
            "body_rise", "right side of the waist above the crotch, vertical", "drop",
            Drop("waist_side_right", "crotch"),
        ),
        Definition(
            "crotch_length", "front of the waist, between the legs, to the back of the waist",
            "length",
            Route(("waist_front", "crotch", "waist_back"), ("tape", "tape"), TRUNK), _CLOTHES,
        ),
        Definition(
            "crotch_length_front", "front of the waist to the crotch", "length",
            Route(("waist_front", "crotch"), ("tape",), TRUNK), _CLOTHES,
        ),
        Definition(
            "crotch_length_back", "crotch to the back of the waist", "length",
            Route(("crotch", "waist_back"), ("tape",), TRUNK), _CLOTHES,
        ),
        _distance("head_length", "brow to the back of the head, straight",
                  ("glabella", "occiput"), _BODY),
    )  # fmt: skip


def _arm(side: str) -> tuple[Definition, ...]:
    acromion, elbow, wrist = (f"{name}_{side}" for name in ("acromion", "elbow", "wrist"))
    upper = (f"upper_arm_{side}", f"forearm_{side}", f"shoulder_{side}")
    lower = (f"forearm_{side}", f"hand_{side}", f"upper_arm_{side}")
    return (
        Definition(
            f"upper_arm_girth_{side}",
            "midway from shoulder point to elbow, at least 2 cm below the armpit", "girth",
            Section(Perpendicular(acromion, elbow, 0.5, beyond=f"armpit_{side}"), upper),
            f"{_CLOTHES} 5.3.16",
        ),
        Definition(
            f"elbow_girth_{side}", "at the elbow, perpendicular to the line from shoulder to "
            "wrist", "girth",
            Section(Perpendicular(acromion, wrist, at=elbow), upper), _CLOTHES,
        ),
        Definition(
            f"forearm_girth_{side}", "a quarter of the way from elbow to wrist", "girth",
            Section(Perpendicular(elbow, wrist, 0.25), lower),
        ),
        Definition(
            f"wrist_girth_{side}", "at the wrist bone, perpendicular to the forearm", "girth",
            Section(Perpendicular(elbow, wrist, 1.0), lower), f"{_CLOTHES} 5.3.19",
        ),
        _distance(f"arm_length_{side}", "shoulder point over elbow to wrist, straight between them",
                  (acromion, elbow, wrist), f"{_CLOTHES} 5.7.8"),
        _distance(f"upper_arm_length_{side}", "shoulder point to elbow", (acromion, elbow),
                  _CLOTHES),
        _distance(f"forearm_length_{side}", "elbow to wrist", (elbow, wrist), _CLOTHES),
        Definition(
            f"sleeve_length_{side}",
            "seventh neck vertebra over the shoulder point, then straight to elbow and wrist",
            "length",
            Route(("cervicale", acromion, elbow, wrist), ("tape", "straight", "straight"), YOKE),
            f"{_CLOTHES} 5.4.17",
        ),
        _distance(f"hand_length_{side}", "wrist along the back of the middle finger to its tip",
                  (wrist, f"knuckle_{side}", f"finger_joint_{side}", f"fingertip_{side}"), _BODY),
        Definition(
            f"shoulder_length_{side}", "side of the neck to the shoulder point", "length",
            Route((f"side_neck_{side}", acromion), ("tape",), SHOULDERS), _CLOTHES,
        ),
        Definition(
            f"shoulder_drop_{side}", "shoulder point below the side of the neck", "drop",
            Drop(f"side_neck_{side}", acromion),
        ),
        Definition(
            f"armscye_girth_{side}",
            "shoulder point, both folds of the armpit, below the armpit and around", "girth",
            Route(
                (acromion, f"armpit_front_{side}", f"armpit_{side}", f"armpit_back_{side}"),
                ("tape", "straight", "straight", "tape"),
                ("chest", f"shoulder_{side}", f"upper_arm_{side}"), closed=True,
            ),
            f"{_CLOTHES} 5.3.15",
        ),
        Definition(
            f"armscye_depth_{side}", "seventh neck vertebra above the armpit, vertical", "drop",
            Drop("cervicale", f"armpit_{side}"),
        ),
        Definition(
            f"hand_girth_{side}",
            "around the hand without the thumb, a quarter of the way from knuckles to wrist",
            "girth",
            Section(
                Perpendicular(wrist, f"knuckle_{side}", 0.75),
                (f"hand_{side}", f"fingers_{side}"),
            ),
            _CLOTHES,
        ),
        Definition(
            f"neck_shoulder_to_waist_front_{side}",
            "side of the neck over the bust point to the front of the waist", "length",
            Route(
                (f"side_neck_{side}", f"bust_{side}", "waist_front"), ("tape", "tape"),
                (*TRUNK, *SHOULDERS),
            ),
            _CLOTHES,
        ),
        Definition(
            f"neck_shoulder_to_waist_back_{side}",
            "side of the neck to the back of the waist", "length",
            Route((f"side_neck_{side}", "waist_back"), ("tape",), (*TRUNK, *SHOULDERS)), _CLOTHES,
        ),
        Definition(
            f"neck_to_bust_length_{side}", "side of the neck to the bust point", "length",
            Route((f"side_neck_{side}", f"bust_{side}"), ("tape",), SHOULDERS), _CLOTHES,
        ),
    )  # fmt: skip


def _leg(side: str) -> tuple[Definition, ...]:
    knee, ankle, heel = (f"{name}_{side}" for name in ("knee", "ankle", "heel"))
    thigh = (f"thigh_{side}", "pelvis", f"shin_{side}")
    shin = (f"shin_{side}", f"foot_{side}", f"thigh_{side}")
    return (
        Definition(
            f"thigh_girth_{side}", "level, just below the crotch", "girth",
            Section(Level(("crotch",), (knee,), 0.05), thigh), f"{_CLOTHES} 5.3.20",
        ),
        Definition(
            f"mid_thigh_girth_{side}", "level, midway from crotch to knee", "girth",
            Section(Level(("crotch",), (knee,), 0.5), thigh), f"{_CLOTHES} 5.3.21",
        ),
        Definition(
            f"knee_girth_{side}", "level, at the middle of the kneecap", "girth",
            Section(Level((knee,)), shin), f"{_CLOTHES} 5.3.22",
        ),
        Definition(
            f"calf_girth_{side}", "level, at the calf's thickest", "girth",
            Section(Level((f"calf_{side}",)), shin), f"{_CLOTHES} 5.3.24",
        ),
        Definition(
            f"ankle_girth_{side}", "level, just above the ankle bone", "girth",
            Section(Level((ankle,), (knee,), 0.09), shin), _CLOTHES,
        ),
        Definition(
            f"outside_leg_length_{side}",
            "waist at the side over the hip, then straight down to the floor", "length",
            Route((f"waist_side_{side}", f"hip_side_{side}"), ("tape", "floor"), FLANK), _CLOTHES,
        ),
        Definition(
            f"waist_to_hip_length_{side}", "waist to hip at the side, over the skin", "length",
            Route((f"waist_side_{side}", f"hip_side_{side}"), ("tape",), FLANK), _CLOTHES,
        ),
        _distance(f"lower_leg_length_{side}", "middle of the kneecap to the ankle bone",
                  (knee, ankle)),
        _distance(f"foot_length_{side}", "heel to the longest toe", (heel, f"toe_{side}"), _BODY),
        _distance(f"foot_breadth_{side}", "across the ball of the foot",
                  (f"ball_inner_{side}", f"ball_outer_{side}"), _BODY),
    )  # fmt: skip


DEFINITIONS: tuple[Definition, ...] = (
    *_heights(),
    *_trunk_girths(),
    *_trunk_lengths(),
    *_arm("left"),
    *_arm("right"),
    *_leg("left"),
    *_leg("right"),
)
"""All rows in the order of the table."""
