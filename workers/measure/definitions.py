"""The table of measurements: what each one is, in words and for the program.

A tape spans hollows, so every girth is the perimeter of the convex hull of a plane section. Heights
are above the floor. Clauses of ISO 8559-1:2017 are given where they are known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["girth", "distance", "surface", "height"]
Axis = Literal["vertical", "neck", "limb"]

TRUNK = ("pelvis", "abdomen", "chest")


@dataclass(frozen=True, slots=True)
class Definition:
    """One measurement."""

    name: str
    words: str
    kind: Kind
    landmarks: tuple[str, ...]
    """girth: the plane passes through the mean of these; distance, surface: from one to the next;
    height: of the first."""
    parts: tuple[str, ...] = ()
    """girth: the section of these parts alone."""
    axis: tuple[str, str] | None = None
    """girth: the plane's normal runs from one landmark to the other; vertical if absent."""
    share: float = 0.0
    """girth: the plane lies this far from the first landmark towards the second."""
    standard: str = ""


def _sided(side: str) -> tuple[Definition, ...]:
    arm = (f"acromion_{side}", f"elbow_{side}")
    fore = (f"elbow_{side}", f"wrist_{side}")
    thigh = (f"thigh_{side}", "pelvis", f"shin_{side}")
    shin = (f"shin_{side}", f"foot_{side}", f"thigh_{side}")
    upper = (f"upper_arm_{side}", f"forearm_{side}")
    iso = "ISO 8559-1:2017 "
    return (
        Definition(
            f"upper_arm_girth_{side}", "midway from shoulder to elbow", "girth", arm, upper,
            arm, 0.5, iso + "5.3.16",
        ),
        Definition(
            f"elbow_girth_{side}", "at the elbow, square to the line shoulder to wrist", "girth",
            (f"elbow_{side}",), upper, (f"acromion_{side}", f"wrist_{side}"),
        ),
        Definition(
            f"wrist_girth_{side}", "at the wrist's bone", "girth", fore,
            (f"forearm_{side}", f"hand_{side}"), fore, 1.0, iso + "5.3.19",
        ),
        Definition(
            f"thigh_girth_{side}", "just below the crotch", "girth",
            ("crotch", f"knee_{side}"), thigh, None, 0.05, iso + "5.3.20",
        ),
        Definition(
            f"mid_thigh_girth_{side}", "midway from crotch to knee", "girth",
            ("crotch", f"knee_{side}"), thigh, None, 0.5, iso + "5.3.21",
        ),
        Definition(
            f"knee_girth_{side}", "at the middle of the kneecap", "girth", (f"knee_{side}",),
            shin, None, 0.0, iso + "5.3.22",
        ),
        Definition(
            f"calf_girth_{side}", "at the calf's thickest", "girth", (f"calf_{side}",),
            shin, None, 0.0, iso + "5.3.24",
        ),
        Definition(
            f"ankle_girth_{side}", "just above the ankle's bone", "girth",
            (f"ankle_{side}", f"knee_{side}"), shin, None, 0.09,
        ),
        Definition(
            f"arm_length_{side}", "shoulder point over elbow to wrist, straight between them",
            "distance", (f"acromion_{side}", f"elbow_{side}", f"wrist_{side}"),
        ),
        Definition(f"upper_arm_length_{side}", "shoulder point to elbow", "distance", arm),
        Definition(f"forearm_length_{side}", "elbow to wrist", "distance", fore),
        Definition(
            f"hand_length_{side}", "wrist to the middle fingertip", "distance",
            (f"wrist_{side}", f"fingertip_{side}"),
        ),
        Definition(
            f"lower_leg_length_{side}", "kneecap's middle to the ankle's bone", "distance",
            (f"knee_{side}", f"ankle_{side}"),
        ),
        Definition(
            f"foot_length_{side}", "heel to the longest toe", "distance",
            (f"heel_{side}", f"toe_{side}"),
        ),
        Definition(
            f"shoulder_length_{side}", "side of the neck to the shoulder point", "surface",
            (f"side_neck_{side}", f"acromion_{side}"),
        ),
    )  # fmt: skip


DEFINITIONS: tuple[Definition, ...] = (
    Definition("height", "top of the head above the floor", "height", ("crown",)),
    Definition("nape_to_floor", "seventh neck vertebra above the floor", "height", ("cervicale",)),
    Definition("waist_height", "natural waist above the floor", "height", ("waist_front",)),
    Definition("hip_height", "most prominent buttock point to the floor", "height", ("buttock",)),
    Definition("crotch_height", "inside leg: crotch above the floor", "height", ("crotch",)),
    Definition("shoulder_height", "shoulder point above the floor", "height", ("acromion_left",)),
    Definition("knee_height", "kneecap's middle above the floor", "height", ("knee_left",)),
    Definition("head_girth", "around brow and back of the head", "girth", ("glabella",), ("head",)),
    Definition(
        "neck_girth", "level, at the middle of the neck", "girth", ("cervicale", "chin"),
        ("neck", "head"), None, 0.5, "ISO 8559-1:2017 5.3.2",
    ),
    Definition(
        "chest_girth", "at the bust points", "girth", ("bust_left", "bust_right"), TRUNK,
        None, 0.5, "ISO 8559-1:2017 5.3.4",
    ),
    Definition(
        "underbust_girth", "just below the bust", "girth", ("underbust_front",), TRUNK,
        None, 0.0, "ISO 8559-1:2017 5.3.8",
    ),
    Definition(
        "waist_girth", "at the natural waist", "girth", ("waist_front", "waist_back"), TRUNK,
        None, 0.5, "ISO 8559-1:2017 5.3.10",
    ),
    Definition(
        "high_hip_girth", "midway from waist to hip", "girth", ("high_hip_front",), TRUNK,
        None, 0.0, "ISO 8559-1:2017 5.3.12",
    ),
    Definition(
        "hip_girth", "at the buttocks' most prominent point", "girth", ("buttock",),
        (*TRUNK, "thigh_left", "thigh_right"), None, 0.0, "ISO 8559-1:2017 5.3.13",
    ),
    Definition(
        "shoulder_width", "shoulder point to shoulder point, straight", "distance",
        ("acromion_left", "acromion_right"),
    ),
    Definition(
        "across_back_width", "between the back folds of the armpits", "distance",
        ("armpit_back_left", "armpit_back_right"),
    ),
    Definition(
        "across_front_width", "between the front folds of the armpits", "distance",
        ("armpit_front_left", "armpit_front_right"),
    ),
    Definition(
        "back_waist_length", "seventh neck vertebra to the waist, along the back", "surface",
        ("cervicale", "waist_back"), (), None, 0.0, "ISO 8559-1:2017 5.4.5",
    ),
    *_sided("left"),
    *_sided("right"),
)  # fmt: skip
"""All rows, in the order in which they are printed."""
