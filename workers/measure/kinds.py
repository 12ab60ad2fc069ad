"""Kinds of measurements: planes, sections, routes and heights that rows of the table are made of.

Landmarks are vertices of the template and parts are its parts, both by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Quantity = Literal[
    "large girth", "girth", "height", "length", "distance", "breadth", "depth", "drop"
]
"""Quantity that a row measures; ISO 20685-1 sets its limits by quantity."""

Leg = Literal["skin", "tape", "straight", "floor"]
"""Leg of a route: along the skin; along the skin but taut over hollows, as a tape; straight through
the air; straight down to the floor, which ends the route.

Skin and tape run in the plane of both ends and the mean of their normals, on the side that the
normals point to. Points of the section that are farther from the straight line than 0.1 of its
length below it, or 0.45 above it, belong to another part of the body."""


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
class Foremost:
    """Horizontal plane where some parts protrude farthest to the front, between two levels.

    The front is the horizontal direction from the landmark `back` to the landmark `front`.
    """

    upper: Level
    lower: Level
    front: str
    back: str
    parts: tuple[str, ...]

    @property
    def named(self) -> tuple[str, ...]:
        """All landmarks of the plane."""
        return (*self.upper.named, *self.lower.named, self.front, self.back)


Plane = Level | Perpendicular | Tilted | Foremost


@dataclass(frozen=True, slots=True)
class Section:
    """Girth of the section of some parts with a plane, or its breadth or depth.

    A tape spans hollows, so its line is the convex hull of the section. Of a section in several
    pieces, `whole` takes all (a trunk with both thighs); otherwise the piece nearest to the plane's
    landmarks counts (one thigh of two). Breadth is measured along the line of the two landmarks
    `across`, projected to the plane, and depth perpendicular to it.
    """

    plane: Plane
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
