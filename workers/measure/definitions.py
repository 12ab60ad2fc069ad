"""The table of measurements: what each one is, in words and for the program.

Landmarks are vertices of the template (workers.scape.learn.landmarks), parts are its parts, so a
definition is made once and every fit carries it. Clauses are given where public sources name
them: ISO 8559-1:2017 for clothing, ISO 7250-1:2017 for the body; a row that follows a standard
whose clause number could not be confirmed names the standard alone, any other row names none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Quantity = Literal[
    "large girth", "girth", "height", "length", "distance", "breadth", "depth", "drop"
]
"""What a row is; ISO 20685-1 sets its limits by this."""

Leg = Literal["skin", "tape", "straight", "floor"]
"""How a route goes on: along the skin; along the skin but taut over hollows; straight through the
air; straight down to the floor, which ends the route.

Skin and tape run in the plane that holds both ends and the mean of their normals, on the side that
the normals point to; what the plane cuts farther from the straight line than a tenth of its length
below it or 0.45 of its length above it is another part of the body."""


@dataclass(frozen=True, slots=True)
class Level:
    """A horizontal plane: at the mean height of some landmarks, or between two such heights."""

    landmarks: tuple[str, ...]
    towards: tuple[str, ...] = ()
    share: float = 0.0

    @property
    def named(self) -> tuple[str, ...]:
        """All landmarks of the plane."""
        return (*self.landmarks, *self.towards)


@dataclass(frozen=True, slots=True)
class Square:
    """A plane square to the line between two landmarks: through `at`, or at a share of the line.

    A share's plane lies at least 2 cm farther along than the landmark `beyond`: no tape goes round
    an arm above the armpit, however low that is.
    """

    start: str
    end: str
    share: float = 0.0
    at: str | None = None
    beyond: str | None = None

    @property
    def named(self) -> tuple[str, ...]:
        """All landmarks of the plane."""
        more = (name for name in (self.at, self.beyond) if name is not None)
        return (self.start, self.end, *more)


@dataclass(frozen=True, slots=True)
class Tilted:
    """A plane through the line of two landmarks, parallel to the line of two others."""

    front: str
    back: str
    side: str
    other_side: str

    @property
    def named(self) -> tuple[str, ...]:
        """All landmarks of the plane."""
        return (self.front, self.back, self.side, self.other_side)


@dataclass(frozen=True, slots=True)
class Section:
    """A girth, or the breadth or depth of one: where a plane cuts some parts of the body.

    A tape spans hollows, so its way is the convex hull of the section. Of a section that falls
    apart, `whole` takes every piece (a trunk with both thighs), otherwise the one nearest to the
    plane's landmarks counts (one thigh of two). `across` names what breadth runs along, projected
    to the plane; depth is square to it.
    """

    plane: Level | Square | Tilted
    parts: tuple[str, ...]
    whole: bool = False
    across: tuple[str, str] | None = None


@dataclass(frozen=True, slots=True)
class Route:
    """From landmark to landmark, over parts of the body."""

    landmarks: tuple[str, ...]
    legs: tuple[Leg, ...]
    parts: tuple[str, ...] = ()
    closed: bool = False


@dataclass(frozen=True, slots=True)
class Top:
    """The highest point of a part above the floor."""

    part: str


@dataclass(frozen=True, slots=True)
class Drop:
    """How much lower one landmark is than another; 0 if it is not."""

    upper: str
    lower: str


@dataclass(frozen=True, slots=True)
class Definition:
    """One measurement."""

    name: str
    words: str
    quantity: Quantity
    way: Section | Route | Top | Drop
    standard: str = ""

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Landmarks that the row depends on."""
        match self.way:
            case Section(plane, _, _, across):
                return (*plane.named, *(across or ()))
            case Route(landmarks):
                return landmarks
            case Top():
                return ()
            case Drop(upper, lower):
                return (upper, lower)


TRUNK = ("pelvis", "abdomen", "chest")
HIPS = (*TRUNK, "thigh_left", "thigh_right")
SHOULDERS = (
    "neck", "chest", "shoulder_left", "shoulder_right", "upper_arm_left", "upper_arm_right",
)  # fmt: skip
YOKE = tuple(part for part in SHOULDERS if part != "neck")
"""What lies below the seventh neck vertebra: a neck that leans to one side is not in the way."""
FLANK = (*HIPS, "shin_left", "shin_right")

_CLOTHES = "ISO 8559-1:2017"
_BODY = "ISO 7250-1:2017"
_BUST = ("bust_left", "bust_right")
_UNDERBUST = ("underbust_left", "underbust_right")
_WAIST = ("waist_front", "waist_back", "waist_side_left", "waist_side_right")
_BUTTOCKS = ("buttock_left", "buttock_right")


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
            "neck_girth", "just below the larynx, square to the neck", "girth",
            Section(
                Tilted("neck_front", "neck_back", *_both("side_neck")),
                ("neck", "head", "chest"),
            ),
            f"{_CLOTHES} 5.3.2",
        ),
        Definition(
            "neck_base_girth",
            "seventh neck vertebra, side of the neck, pit of the neck and round, over the skin",
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
            "underbust_girth", "level, in the fold below the bust", "large girth",
            Section(Level(_UNDERBUST), TRUNK, whole=True), f"{_CLOTHES} 5.3.8",
        ),
        Definition(
            "waist_girth", "level, at the natural waist between ribs and hip bones", "large girth",
            Section(waist, TRUNK, whole=True), f"{_CLOTHES} 5.3.10",
        ),
        Definition(
            "high_hip_girth", "level, midway from waist to hip", "large girth",
            Section(Level(_WAIST, _BUTTOCKS, 0.5), HIPS, whole=True), f"{_CLOTHES} 5.3.12",
        ),
        Definition(
            "hip_girth", "level, where the buttocks stand out farthest", "large girth",
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
            "hip_breadth", "where the buttocks stand out farthest, from side to side", "breadth",
            Section(hips, HIPS, whole=True, across=_both("hip_side")), _BODY,
        ),
        Definition(
            "hip_depth", "where the buttocks stand out farthest, from front to back", "depth",
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
            Section(Square(acromion, elbow, 0.5, beyond=f"armpit_{side}"), upper),
            f"{_CLOTHES} 5.3.16",
        ),
        Definition(
            f"elbow_girth_{side}", "at the elbow, square to the line shoulder to wrist", "girth",
            Section(Square(acromion, wrist, at=elbow), upper), _CLOTHES,
        ),
        Definition(
            f"forearm_girth_{side}", "a quarter of the way from elbow to wrist", "girth",
            Section(Square(elbow, wrist, 0.25), lower),
        ),
        Definition(
            f"wrist_girth_{side}", "at the wrist's bone, square to the forearm", "girth",
            Section(Square(elbow, wrist, 1.0), lower), f"{_CLOTHES} 5.3.19",
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
            f"ankle_girth_{side}", "level, just above the ankle's bone", "girth",
            Section(Level((ankle,), (knee,), 0.09), shin), _CLOTHES,
        ),
        Definition(
            f"outside_leg_length_{side}",
            "waist at the side over the hip, then straight down to the floor", "length",
            Route((f"waist_side_{side}", f"hip_side_{side}"), ("tape", "floor"), FLANK), _CLOTHES,
        ),
        _distance(f"lower_leg_length_{side}", "kneecap's middle to the ankle's bone",
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
"""All rows, in the order in which they are printed."""
