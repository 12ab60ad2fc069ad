"""The rows of one side of the body: arm, shoulder, hand, one side of the trunk, leg."""

from __future__ import annotations

from workers.measure.kinds import Definition, Drop, Level, Perpendicular, Route, Section, Thickest
from workers.measure.vocabulary import (
    BODY,
    CLOTHES,
    COLLAR,
    FLANK,
    SHOULDERS,
    TRUNK,
    YOKE,
    distance,
)


def arm(side: str) -> tuple[Definition, ...]:
    """The rows from the shoulder point to the fingertips."""
    acromion, elbow, wrist = (f"{name}_{side}" for name in ("acromion", "elbow", "wrist"))
    upper = (f"upper_arm_{side}", f"forearm_{side}", f"shoulder_{side}")
    lower = (f"forearm_{side}", f"hand_{side}", f"upper_arm_{side}")
    return (
        Definition(
            f"upper_arm_girth_{side}",
            "midway from shoulder point to elbow, at least 2 cm below the armpit", "girth",
            Section(Perpendicular(acromion, elbow, 0.5, beyond=f"armpit_{side}"), upper),
            f"{CLOTHES} 5.3.16",
        ),
        Definition(
            f"elbow_girth_{side}", "at the elbow, perpendicular to the line from shoulder to "
            "wrist", "girth",
            Section(Perpendicular(acromion, wrist, at=elbow), upper), CLOTHES,
        ),
        Definition(
            f"forearm_girth_{side}", "a quarter of the way from elbow to wrist", "girth",
            Section(Perpendicular(elbow, wrist, 0.25), lower),
        ),
        Definition(
            f"wrist_girth_{side}", "at the wrist bone, perpendicular to the forearm", "girth",
            Section(Perpendicular(elbow, wrist, 1.0), lower), f"{CLOTHES} 5.3.19",
        ),
        distance(f"arm_length_{side}", "shoulder point over elbow to wrist, straight between them",
                  (acromion, elbow, wrist), f"{CLOTHES} 5.7.8"),
        distance(f"upper_arm_length_{side}", "shoulder point to elbow", (acromion, elbow),
                  CLOTHES),
        distance(f"forearm_length_{side}", "elbow to wrist", (elbow, wrist), CLOTHES),
        Definition(
            f"sleeve_length_{side}",
            "seventh neck vertebra over the shoulder point, then straight to elbow and wrist",
            "length",
            Route(("cervicale", acromion, elbow, wrist), ("tape", "straight", "straight"), YOKE),
            f"{CLOTHES} 5.4.17",
        ),
        distance(f"hand_length_{side}", "wrist along the back of the middle finger to its tip",
                  (wrist, f"knuckle_{side}", f"finger_joint_{side}", f"fingertip_{side}"), BODY),
    )  # fmt: skip


def shoulder(side: str) -> tuple[Definition, ...]:
    """The rows of the shoulder and the armhole."""
    acromion = f"acromion_{side}"
    return (
        Definition(
            f"shoulder_length_{side}", "side of the neck to the shoulder point", "length",
            Route((f"side_neck_{side}", acromion), ("tape",), SHOULDERS), CLOTHES,
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
            f"{CLOTHES} 5.3.15",
        ),
        Definition(
            f"armscye_depth_{side}", "seventh neck vertebra above the armpit, vertical", "drop",
            Drop("cervicale", f"armpit_{side}"),
        ),
    )  # fmt: skip


def hand(side: str) -> tuple[Definition, ...]:
    """The row around the hand."""
    parts = (f"hand_{side}", f"fingers_{side}")
    return (
        Definition(
            f"hand_girth_{side}",
            "around the hand without the thumb, a quarter of the way from knuckles to wrist",
            "girth",
            Section(
                Perpendicular(f"wrist_{side}", f"knuckle_{side}", 0.75),
                parts,
            ),
            CLOTHES,
        ),
    )  # fmt: skip


def bodice(side: str) -> tuple[Definition, ...]:
    """The rows from the side of the neck down one side of the trunk."""
    return (
        Definition(
            f"neck_shoulder_to_waist_front_{side}",
            "side of the neck over the bust point to the front of the waist", "length",
            Route(
                (f"side_neck_{side}", f"bust_{side}", "waist_front"), ("tape", "tape"),
                (*TRUNK, "neck", *COLLAR),
            ),
            CLOTHES,
        ),
        Definition(
            f"neck_shoulder_to_waist_back_{side}",
            "side of the neck to the back of the waist", "length",
            Route((f"side_neck_{side}", "waist_back"), ("tape",), (*TRUNK, "neck", *COLLAR)),
            CLOTHES,
        ),
        Definition(
            f"neck_to_bust_length_{side}", "side of the neck to the bust point", "length",
            Route((f"side_neck_{side}", f"bust_{side}"), ("tape",), ("neck", "chest", *COLLAR)),
            CLOTHES,
        ),
    )  # fmt: skip


def leg(side: str) -> tuple[Definition, ...]:
    """The rows of thigh, knee, shin and foot."""
    knee, ankle, heel = (f"{name}_{side}" for name in ("knee", "ankle", "heel"))
    thigh = (f"thigh_{side}", "pelvis", f"shin_{side}")
    shin = (f"shin_{side}", f"foot_{side}", f"thigh_{side}")
    return (
        Definition(
            f"thigh_girth_{side}", "level, about 3 cm below the crotch", "girth",
            Section(Level(("crotch",), (knee,), 0.08), thigh), f"{CLOTHES} 5.3.20",
        ),
        Definition(
            f"mid_thigh_girth_{side}", "level, midway from crotch to knee", "girth",
            Section(Level(("crotch",), (knee,), 0.5), thigh), f"{CLOTHES} 5.3.21",
        ),
        Definition(
            f"knee_girth_{side}", "level, at the middle of the kneecap", "girth",
            Section(Level((knee,)), shin), f"{CLOTHES} 5.3.22",
        ),
        Definition(
            f"calf_girth_{side}", "level, at the calf's thickest", "girth",
            Section(
                Thickest(Level((knee,), (ankle,), 0.15), Level((knee,), (ankle,), 0.6)), shin
            ),
            f"{CLOTHES} 5.3.24",
        ),
        Definition(
            f"ankle_girth_{side}", "level, just above the ankle bone", "girth",
            Section(Level((ankle,), (knee,), 0.09), shin), CLOTHES,
        ),
        Definition(
            f"outside_leg_length_{side}",
            "waist at the side over the hip, then straight down to the floor", "length",
            Route((f"waist_side_{side}", f"hip_side_{side}"), ("tape", "floor"), FLANK), CLOTHES,
        ),
        Definition(
            f"waist_to_hip_length_{side}", "waist to hip at the side, over the skin", "length",
            Route((f"waist_side_{side}", f"hip_side_{side}"), ("tape",), FLANK), CLOTHES,
        ),
        distance(f"lower_leg_length_{side}", "middle of the kneecap to the ankle bone",
                  (knee, ankle)),
        distance(f"foot_length_{side}", "heel to the longest toe", (heel, f"toe_{side}"), BODY),
        distance(f"foot_breadth_{side}", "across the ball of the foot",
                  (f"ball_inner_{side}", f"ball_outer_{side}"), BODY),
    )  # fmt: skip
