"""Table of measurements: the definition of each row, in words and for the program.

Landmarks are vertices of the template (workers.scape.learn.landmarks) and parts are its parts, so a
definition is made once and applies to every fit. The rows of limbs are in `workers.measure.limbs`.
"""

from __future__ import annotations

from workers.measure.kinds import (
    Definition,
    Drop,
    Level,
    Narrowest,
    Protrusion,
    Route,
    Section,
    Tilted,
    Top,
)
from workers.measure.limbs import arm, bodice, hand, leg, shoulder
from workers.measure.vocabulary import (
    BODY,
    CLOTHES,
    COLLAR,
    HIPS,
    NECK_FOOT,
    SHOULDERS,
    TRUNK,
    YOKE,
    distance,
)

_BUST = ("bust_left", "bust_right")
_UNDERBUST = ("underbust_left", "underbust_right")
_WAIST = ("waist_front", "waist_back", "waist_side_left", "waist_side_right")
_BUTTOCKS = ("buttock_left", "buttock_right")
_ARMPITS = ("armpit_left", "armpit_right")
_BELLY = Protrusion(
    Level(_WAIST, _UNDERBUST, 0.5), Level(_BUTTOCKS), "waist_back", "waist_front",
    ("pelvis", "abdomen"),
)  # fmt: skip
_SEAT = Protrusion(
    Level(_WAIST, _BUTTOCKS, 0.5), Level(("crotch",)), "waist_front", "waist_back",
    ("pelvis", "thigh_left", "thigh_right"),
)  # fmt: skip


def _both(name: str) -> tuple[str, str]:
    return f"{name}_right", f"{name}_left"


def _height(name: str, words: str, landmark: str, standard: str = "") -> Definition:
    return Definition(name, words, "height", Route((landmark,), ("floor",)), standard)


def _heights() -> tuple[Definition, ...]:
    return (
        Definition("height", "top of the head above the floor", "height", Top("head"), BODY),
        _height("nape_to_floor", "seventh neck vertebra above the floor", "cervicale", CLOTHES),
        _height("chin_height", "chin above the floor", "chin"),
        _height("shoulder_height", "right shoulder point above the floor", "acromion_right", BODY),
        _height("bust_height", "right bust point above the floor", "bust_right", CLOTHES),
        _height("waist_height", "front of the natural waist above the floor", "waist_front",
                CLOTHES),
        _height("hip_height", "right buttock's farthest point above the floor", "buttock_right",
                CLOTHES),
        _height("crotch_height", "inside leg: crotch above the floor", "crotch", BODY),
        _height("knee_height", "middle of the right kneecap above the floor", "knee_right",
                CLOTHES),
    )  # fmt: skip


def _head_and_neck() -> tuple[Definition, ...]:
    return (
        Definition(
            "head_girth", "around brow and back of the head, above the ears", "girth",
            Section(Tilted("glabella", "occiput", *_both("side_neck")), ("head",), whole=True),
            BODY,
        ),
        Definition(
            "neck_girth", "just below the larynx, perpendicular to the neck", "girth",
            Section(
                Narrowest("neck_front", "neck_back", *_both("side_neck"), NECK_FOOT),
                ("head", *SHOULDERS),
            ),
            f"{CLOTHES} 5.3.2",
        ),
        Definition(
            "neck_base_girth",
            "seventh neck vertebra, side of the neck, pit of the neck and around, over the skin",
            "girth",
            Route(
                NECK_FOOT, ("shortest", "shortest", "shortest", "shortest"),
                ("head", *SHOULDERS), closed=True,
            ),
            f"{CLOTHES} 5.3.3",
        ),
    )  # fmt: skip


def _trunk_girths() -> tuple[Definition, ...]:
    return (
        Definition(
            "chest_girth", "level, at the bust points", "large girth",
            Section(Level(_BUST), TRUNK, whole=True), f"{CLOTHES} 5.3.4",
        ),
        Definition(
            "high_bust_girth", "level, midway from the armpits to the bust points", "large girth",
            Section(Level(_ARMPITS, _BUST, 0.5), TRUNK, whole=True), f"{CLOTHES} 5.3.6",
        ),
        Definition(
            "underbust_girth", "level, in the fold below the bust", "large girth",
            Section(Level(_UNDERBUST), TRUNK, whole=True), f"{CLOTHES} 5.3.8",
        ),
        Definition(
            "waist_girth", "level, at the natural waist between ribs and hip bones", "large girth",
            Section(Level(_WAIST), TRUNK, whole=True), f"{CLOTHES} 5.3.10",
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
                ("tape", "tape", "tape", "tape", "tape"), (*TRUNK, "neck", *COLLAR), closed=True,
            ),
            CLOTHES,
        ),
        Definition(
            "high_hip_girth", "level, midway from waist to hip", "large girth",
            Section(Level(_WAIST, _BUTTOCKS, 0.5), HIPS, whole=True), f"{CLOTHES} 5.3.12",
        ),
        Definition(
            "hip_girth", "level, where the buttocks protrude farthest", "large girth",
            Section(_SEAT, HIPS, whole=True), f"{CLOTHES} 5.3.13",
        ),
    )  # fmt: skip


def _trunk_breadths() -> tuple[Definition, ...]:
    chest, waist = Level(_BUST), Level(_WAIST)
    return (
        Definition(
            "chest_breadth", "at the bust points, from side to side", "breadth",
            Section(chest, TRUNK, whole=True, across=_both("armpit")), BODY,
        ),
        Definition(
            "chest_depth", "at the bust points, from front to back", "depth",
            Section(chest, TRUNK, whole=True, across=_both("armpit")), BODY,
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
            Section(_SEAT, HIPS, whole=True, across=_both("hip_side")), BODY,
        ),
        Definition(
            "hip_depth", "where the buttocks protrude farthest, from front to back", "depth",
            Section(_SEAT, HIPS, whole=True, across=_both("hip_side")),
        ),
    )  # fmt: skip


def _trunk_lengths() -> tuple[Definition, ...]:
    return (
        distance("shoulder_width", "shoulder point to shoulder point, straight",
                  _both("acromion"), BODY),
        Definition(
            "across_back_shoulder_width",
            "shoulder point over the seventh neck vertebra to the other", "length",
            Route(("acromion_right", "cervicale", "acromion_left"), ("tape", "tape"), YOKE),
            f"{CLOTHES} 5.4.3",
        ),
        distance("across_back_width", "between the back folds of the armpits, straight",
                  _both("armpit_back"), CLOTHES),
        distance("across_front_width", "between the front folds of the armpits, straight",
                  _both("armpit_front"), CLOTHES),
        distance("bust_point_width", "bust point to bust point, straight", _BUST, CLOTHES),
        Definition(
            "back_waist_length", "seventh neck vertebra to the waist, following the back's curve",
            "length", Route(("cervicale", "waist_back"), ("skin",), ("neck", *TRUNK)),
            f"{CLOTHES} 5.4.5",
        ),
        Definition(
            "front_waist_length", "pit of the neck to the waist, along the front", "length",
            Route(("suprasternale", "waist_front"), ("tape",), ("neck", *TRUNK)),
            f"{CLOTHES} 5.4.8",
        ),
        Definition(
            "across_back_skin_width", "between the back folds of the armpits, along the skin",
            "length", Route(_both("armpit_back"), ("tape",), YOKE), CLOTHES,
        ),
        Definition(
            "across_front_skin_width", "between the front folds of the armpits, along the skin",
            "length", Route(_both("armpit_front"), ("tape",), YOKE), f"{CLOTHES} 5.4.7",
        ),
        Definition(
            "body_rise", "right side of the waist above the crotch, vertical", "drop",
            Drop("waist_side_right", "crotch"),
        ),
        Definition(
            "crotch_length", "front of the waist, between the legs, to the back of the waist",
            "length",
            Route(("waist_front", "crotch", "waist_back"), ("tape", "tape"), TRUNK), CLOTHES,
        ),
        Definition(
            "crotch_length_front", "front of the waist to the crotch", "length",
            Route(("waist_front", "crotch"), ("tape",), TRUNK), CLOTHES,
        ),
        Definition(
            "crotch_length_back", "crotch to the back of the waist", "length",
            Route(("crotch", "waist_back"), ("tape",), TRUNK), CLOTHES,
        ),
        distance("head_length", "brow to the back of the head, straight",
                  ("glabella", "occiput"), BODY),
    )  # fmt: skip


DEFINITIONS: tuple[Definition, ...] = (
    *_heights(),
    *_head_and_neck(),
    *_trunk_girths(),
    *_trunk_breadths(),
    *_trunk_lengths(),
    *arm("left"),
    *shoulder("left"),
    *hand("left"),
    *bodice("left"),
    *arm("right"),
    *shoulder("right"),
    *hand("right"),
    *bodice("right"),
    *leg("left"),
    *leg("right"),
)
"""All rows in the order of the table."""
