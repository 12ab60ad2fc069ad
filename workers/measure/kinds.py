"""Kinds of measurements: planes, sections, routes and heights that rows of the table are made of.

Landmarks are vertices of the template and parts are its parts, both by name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Quantity = Literal[
    "large girth", "girth", "height", "length", "distance", "breadth", "depth", "drop"
]
"""Quantity that a row measures; ISO 20685-1 sets its limits by quantity."""

Leg = Literal["skin", "tape", "shortest", "straight", "floor"]
"""Leg of a route: along the skin; along the skin but taut over hollows, as a tape; along the skin
where it is shortest; straight through the air; straight down to the floor, which ends the route.

Skin and tape run in the plane of both ends and a direction outwards, on the side of that direction.
It is the one from the middle of all landmarks to the middle of both ends where the route is closed;
else the sum of both ends' normals, each the mean over the skin of the route's parts, with weights
1 - (d / r)^2 at the distance d from the end, r being `NORMAL_RADIUS` of the trunk's length. The
shortest leg, of closed routes only, is the shortest of those along the skin whose direction
outwards is tilted about the straight line by `SHORTEST_TILTS_RAD`, towards where the landmarks are
seen to follow each other clockwise.
Points of the section that are farther from the straight line than 0.1 of its length below it, or
`Route.bulge` above it, belong to another part of the body. Where the skin folds back, the line
follows its outside."""
SHORTEST_TILTS_RAD = tuple(math.radians(degrees) for degrees in range(5, 46, 5))
"""Around a neck's foot most lines are shortest in between. Planes of other tilts graze shoulders or
neck: with wider ranges the girth errs by as much or more."""
TRUNK_ENDS = ("cervicale", "crotch")
NORMAL_RADIUS = 0.11
"""7 cm on an average trunk. Folds of an armpit turn the normals at a landmark itself by 90 degrees:
lines between two armpits came out up to 13 cm too short."""


@dataclass(frozen=True, slots=True)
class Level:
    """Horizontal plane at the mean height of some landmarks, or between two such heights."""

    landmarks: tuple[str, ...]
    towards: tuple[str, ...] = ()
    share: float = 0.0

    @property
    def named(self) -> tuple[str, ...]:
        """All landmarks of the plane."""
        return (*self.landmarks, *self.towards)


@dataclass(frozen=True, slots=True)
class Perpendicular:
    """Plane perpendicular to the line of two landmarks: through `at`, or at a share of the line.

    The plane at a share is at least 2 cm beyond the landmark `beyond`, since a tape cannot go
    around an arm above the armpit.
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
    """Plane through the line of two landmarks, parallel to the line of two others."""

    front: str
    back: str
    side: str
    other_side: str

    @property
    def named(self) -> tuple[str, ...]:
        """All landmarks of the plane."""
        return (self.front, self.back, self.side, self.other_side)


@dataclass(frozen=True, slots=True)
class Protrusion:
    """Horizontal plane where some parts protrude farthest, between two levels.

    The direction is the horizontal one from the landmark `start` to the landmark `end`. The height
    is the mean of the parts' vertices in between, each with the weight exp(-d / s), where d is how
    much less it protrudes than the farthest, and s is `PROTRUSION_SHARE` of the distance of the two
    levels: on a flat belly the farthest vertex alone moves by decimetres with the least error of
    the surface.
    """

    upper: Level
    lower: Level
    start: str
    end: str
    parts: tuple[str, ...]

    @property
    def named(self) -> tuple[str, ...]:
        """All landmarks of the plane."""
        return (*self.upper.named, *self.lower.named, self.start, self.end)


@dataclass(frozen=True, slots=True)
class Narrowest:
    """Plane through the landmark `front`, parallel to the line of two others, tilted to where the
    girth is least: a tape around a neck lies perpendicular to it.

    Of a section in several pieces, the one around the middle of `front` and `back` counts. The
    tilts are `NARROWEST_TILTS_RAD`, to the front where `side` is the right one of the two.
    A section longer than `NARROWEST_OF_FOOT` times the straight lines around `foot` takes in
    shoulders or chin and does not count. Where the first or the last tilt is the best, or none goes
    around, the body has no such line.
    """

    front: str
    back: str
    side: str
    other_side: str
    foot: tuple[str, ...]
    """Landmarks around the neck's foot, in order."""

    @property
    def named(self) -> tuple[str, ...]:
        """All landmarks of the plane."""
        return (self.front, self.back, self.side, self.other_side)


@dataclass(frozen=True, slots=True)
class Thickest:
    """Horizontal plane where the girth is greatest, between two levels.

    The girths at `THICKEST_LEVELS` heights, evenly from level to level, are compared; the parabola
    through the greatest and its neighbours gives the height.
    """

    upper: Level
    lower: Level

    @property
    def named(self) -> tuple[str, ...]:
        """All landmarks of the plane."""
        return (*self.upper.named, *self.lower.named)


THICKEST_LEVELS = 9
"""At a calf they are 2 cm apart."""
NARROWEST_TILTS_RAD = tuple(math.radians(degrees) for degrees in range(-12, 73, 4))
"""Angles between a horizontal plane and those that `Narrowest` tries: necks lean by 19 degrees, by
55 with a trunk that leans and a head that is bowed."""
NARROWEST_OF_FOOT = 1.2
"""Limit of a neck's girth: 98 in 100 of 313 bodies have 0.87 to 1.1, one with its chin 1.4."""
PROTRUSION_SHARE = 0.05
"""13 mm at the belly and 8 at the seat. With it the girth of the belly errs by 3.4 mm on sculpted
bodies, with the farthest vertex alone by 15."""

Plane = Level | Perpendicular | Tilted | Protrusion


@dataclass(frozen=True, slots=True)
class Section:
    """Girth of the section of some parts with a plane, or its breadth or depth.

    A tape spans hollows, so its line is the convex hull of the section. Of a section in several
    pieces, `whole` takes all (a trunk with both thighs); otherwise the piece counts that goes
    around the plane's point (the palm, not a finger that is curled before it), and if none does,
    the one nearest to it (one thigh of two). Breadth is measured along the line of the two
    landmarks `across`, projected to the plane, and depth perpendicular to it.
    """

    plane: Plane | Narrowest | Thickest
    parts: tuple[str, ...]
    whole: bool = False
    across: tuple[str, str] | None = None


@dataclass(frozen=True, slots=True)
class Route:
    """Line from landmark to landmark, over some parts of the body."""

    landmarks: tuple[str, ...]
    legs: tuple[Leg, ...]
    parts: tuple[str, ...] = ()
    closed: bool = False
    bulge: float = 0.45
    """Height above the straight line of a leg from which skin belongs to another part, as a share
    of its length."""


@dataclass(frozen=True, slots=True)
class Top:
    """Height of the highest point of a part."""

    part: str


@dataclass(frozen=True, slots=True)
class Drop:
    """Vertical distance from one landmark down to another; 0 where the second is higher."""

    upper: str
    lower: str


@dataclass(frozen=True, slots=True)
class Definition:
    """One row of the table."""

    name: str
    words: str
    quantity: Quantity
    kind: Section | Route | Top | Drop
    standard: str = ""

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Landmarks that the row depends on."""
        match self.kind:
            case Section(plane, _, _, across):
                return (*plane.named, *(across or ()))
            case Route(landmarks):
                return landmarks
            case Top():
                return ()
            case Drop(upper, lower):
                return (upper, lower)
