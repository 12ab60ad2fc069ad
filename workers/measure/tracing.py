"""Lines and values of all rows on a body in the template's topology."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from station.core.errors import InputError
from workers.measure.definitions import DEFINITIONS
from workers.measure.kinds import (
    NARROWEST_OF_FOOT,
    NARROWEST_TILTS_RAD,
    NORMAL_RADIUS,
    PROTRUSION_SHARE,
    SHORTEST_TILTS_RAD,
    THICKEST_LEVELS,
    TRUNK_ENDS,
    Definition,
    Drop,
    Leg,
    Level,
    Narrowest,
    Perpendicular,
    Plane,
    Protrusion,
    Route,
    Section,
    Thickest,
    Tilted,
    Top,
)
from workers.measure.sections import (
    EdgeNet,
    EdgePoints,
    Index,
    around,
    cross,
    hull_order,
    loop_length,
    plane_axes,
    surface_order,
)
from workers.measure.tapes import Tape, tapes_around
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import area_vectors

Array = NDArray[np.float64]
_UP = np.array([0.0, 0.0, 1.0])
_CLEARANCE_M = 0.02
"""Distance between a plane and the landmark `Perpendicular.beyond`, at least."""
_BROKEN_SHARE = 0.1
"""Share of rows whose planes miss what they should cut, beyond which the mesh is no body."""


class NoLineError(ValueError):
    """The body, though sound, does not have the line of a row."""


@dataclass(frozen=True, slots=True)
class Trace:
    """Line and value of one row."""

    definition: Definition
    value_m: float
    """NaN where the body has no such line."""
    points: EdgePoints
    """The row's landmarks where the body has no such line."""
    closed: bool
    to_floor: bool
    """Whether the line continues from its last point straight down to the floor."""

    def path(self, vertices: Array) -> Array:
        """Line (n, 3) on a body (P, 3) of the same topology; empty where it has none."""
        if math.isnan(self.value_m):
            return np.empty((0, 3))
        found = self.points.on(vertices)
        if self.to_floor:
            found = np.concatenate([found, found[-1:] * (1.0, 1.0, 0.0)])
        return found


def trace_all(
    model: BodyModel, vertices: Array, definitions: Sequence[Definition] = DEFINITIONS
) -> list[Trace]:
    """The rows of a table on a body (P, 3), z up, floor at 0.

    Raises:
        InputError: a place is not a number, or many planes miss the part that they should cut.
    """
    if not np.isfinite(vertices).all():
        raise InputError("the mesh holds values that are not numbers; fit the body again")
    tracer = _Tracer(model, vertices)
    traces = [tracer.trace(definition) for definition in definitions]
    if len(tracer.missed) > _BROKEN_SHARE * len(definitions):
        raise InputError(f"{tracer.missed[0]}; fit the body again")
    return traces


@lru_cache(maxsize=64)
def _triangles(model: BodyModel, parts: tuple[str, ...]) -> Index:
    return np.flatnonzero(model.of_parts(parts)[model.faces].all(axis=1))


@lru_cache(maxsize=64)
def _net(model: BodyModel, parts: tuple[str, ...]) -> EdgeNet:
    return EdgeNet.build(model.faces[_triangles(model, parts)])


def _unit(vector: Array) -> Array:
    """A vector at length 1.

    Raises:
        ValueError: it has no direction: on a body that was fitted to nothing sensible, landmarks
            coincide, and a trunk that was crushed has no skin within reach of its own landmarks.
    """
    length = float(np.linalg.norm(vector))
    if not length > 0.0:
        raise ValueError("its landmarks give no direction")
    return np.asarray(vector / length)


class _Tracer:
    def __init__(self, model: BodyModel, vertices: Array) -> None:
        self._model = model
        self._vertices = vertices
        corners = vertices[model.faces]
        self._middles = corners.mean(axis=1)
        self._area_vectors = area_vectors(vertices, model.faces)
        self._cuts: dict[Section, Tape] = {}
        self.missed: list[str] = []
        """Rows whose planes missed what they should cut, and why."""

    def trace(self, definition: Definition) -> Trace:
        try:
            value, points, closed, to_floor = self._follow(definition)
        except ValueError as cause:
            if not isinstance(cause, NoLineError):
                self.missed.append(f"{definition.name} cannot be measured: {cause}")
            marks = [self._model.landmarks[name] for name in definition.landmarks]
            return Trace(definition, math.nan, EdgePoints.at(marks), False, False)
        return Trace(definition, value, points, closed, to_floor)

    def _follow(self, definition: Definition) -> tuple[float, EdgePoints, bool, bool]:
        match definition.kind:
            case Section() as section:
                value, points, closed = self._section(definition, section)
                return value, points, closed, False
            case Route() as route:
                points = self._route(route)
                to_floor = route.legs[-1] == "floor"
                line = points.on(self._vertices)
                value = loop_length(line, closed=route.closed)
                return value + (line[-1, 2] if to_floor else 0.0), points, route.closed, to_floor
            case Top(part):
                index = np.flatnonzero(
                    self._model.part_of_vertex == self._model.part_names.index(part)
                )
                top = int(index[np.argmax(self._vertices[index, 2])])
                return float(self._vertices[top, 2]), EdgePoints.at([top]), False, True
            case Drop(upper, lower):
                drop = max(0.0, float(self._at(upper)[2] - self._at(lower)[2]))
                ends = EdgePoints.at([self._model.landmarks[upper], self._model.landmarks[lower]])
                return drop, ends, False, False

    def _at(self, landmark: str) -> Array:
        return self._vertices[self._model.landmarks[landmark]]

    def _mean(self, landmarks: tuple[str, ...]) -> Array:
        return np.mean([self._at(landmark) for landmark in landmarks], axis=0)

    def _plane(self, plane: Plane) -> tuple[Array, Array]:
        """Point of a plane, near the part that it cuts, and its normal."""
        match plane:
            case Level(landmarks, towards, share):
                point = self._mean(landmarks)
                if towards:
                    point = point + share * (self._mean(towards) - point)
                return point, _UP
            case Perpendicular(start, end, share, at, beyond):
                line = self._at(end) - self._at(start)
                length = float(np.linalg.norm(line))
                along = share * length
                if beyond is not None:
                    passed = (self._at(beyond) - self._at(start)) @ line / length
                    along = max(along, float(passed) + _CLEARANCE_M)
                point = self._at(start) + along / length * line if at is None else self._at(at)
                return point, line / length
            case Tilted(front, back, side, other):
                normal = cross(self._at(other) - self._at(side), self._at(back) - self._at(front))
                return self._at(front), _unit(normal)
            case Protrusion():
                return self._farthest(plane), _UP

    def _farthest(self, plane: Protrusion) -> Array:
        """Weighted mean of the vertices that protrude most."""
        levels = (self._plane(level)[0][2] for level in (plane.lower, plane.upper))
        low, high = sorted(levels)
        height = self._vertices[:, 2]
        inside = self._model.of_parts(plane.parts) & (low <= height) & (height <= high)
        candidates = self._vertices[inside]
        if not low < high or not len(candidates):
            raise ValueError("no vertex lies between the two levels")
        reach = candidates[:, :2] @ _unit((self._at(plane.end) - self._at(plane.start))[:2])
        weight = np.exp((reach - reach.max()) / (PROTRUSION_SHARE * (high - low)))
        return np.asarray(weight @ candidates / weight.sum())

    def _narrowest(self, section: Section, plane: Narrowest) -> Tape:
        across = self._at(plane.other_side) - self._at(plane.side)
        ahead = cross(across, _UP)
        ahead /= np.linalg.norm(ahead)
        up = cross(ahead, across)
        up /= np.linalg.norm(up)
        front = self._at(plane.front)
        middle = 0.5 * (front + self._at(plane.back))
        net = _net(self._model, section.parts)
        foot_m = loop_length(np.stack([self._at(name) for name in plane.foot]), closed=True)
        tapes: list[tuple[float, float, Tape]] = []
        for tilt in NARROWEST_TILTS_RAD:
            normal = np.cos(tilt) * up + np.sin(tilt) * ahead
            found, crossing = net.cut(self._vertices, front, normal)
            places = found.on(self._vertices)
            for tape in tapes_around(found, places, net.pieces(crossing), normal, middle):
                girth_m = loop_length(tape.places, closed=True)
                if girth_m < NARROWEST_OF_FOOT * foot_m:
                    tapes.append((girth_m, tilt, tape))
        if not tapes:
            raise NoLineError("no section goes around it alone")
        _, tilt, least = min(tapes, key=lambda found: found[0])
        if tilt in (NARROWEST_TILTS_RAD[0], NARROWEST_TILTS_RAD[-1]):
            raise NoLineError("it is narrowest at the steepest plane")
        return least

    def _thickest(self, section: Section, plane: Thickest) -> Tape:
        low, high = self._plane(plane.lower)[0], self._plane(plane.upper)[0]
        places = np.linspace(low, high, THICKEST_LEVELS)
        tapes = [self._tape(section, place, _UP) for place in places]
        girths = [loop_length(tape.places, closed=True) for tape in tapes]
        most = int(np.argmax(girths))
        if not 0 < most < THICKEST_LEVELS - 1:
            return tapes[most]
        below, here, above = girths[most - 1 : most + 2]
        steps = 0.5 * (above - below) / max(2.0 * here - below - above, 1e-9)
        place = places[most] + steps * (places[1] - places[0])
        return self._tape(section, place, _UP)

    def _cut(self, section: Section) -> Tape:
        """Tape around a section; kept for breadth and depth."""
        key = Section(section.plane, section.parts, section.whole)
        if key not in self._cuts:
            match section.plane:
                case Narrowest() as plane:
                    self._cuts[key] = self._narrowest(section, plane)
                case Thickest() as plane:
                    self._cuts[key] = self._thickest(section, plane)
                case plane:
                    self._cuts[key] = self._tape(section, *self._plane(plane))
        return self._cuts[key]

    def _tape(self, section: Section, point: Array, normal: Array) -> Tape:
        net = _net(self._model, section.parts)
        found, crossing = net.cut(self._vertices, point, normal)
        places = found.on(self._vertices)
        if not section.whole and len(places):
            piece = net.pieces(crossing)
            if np.ptp(piece) and (tapes := tapes_around(found, places, piece, normal, point)):
                return max(tapes, key=lambda tape: loop_length(tape.places, closed=True))
            wanted = piece[np.argmin(np.linalg.norm(places - point, axis=1))]
            chosen = np.flatnonzero(piece == wanted)
            found, places = found.take(chosen), places[chosen]
        tape = hull_order(places, normal)
        return Tape(found.take(tape), places[tape], normal)

    def _section(self, definition: Definition, section: Section) -> tuple[float, EdgePoints, bool]:
        tape = self._cut(section)
        if section.across is None:
            return loop_length(tape.places, closed=True), tape.points, True
        side, other = section.across
        breadth, depth = plane_axes(tape.normal, self._at(other) - self._at(side))
        reach = tape.places @ (breadth if definition.quantity == "breadth" else depth)
        low, high = int(np.argmin(reach)), int(np.argmax(reach))
        ends = tape.points.take(np.array([low, high]))
        return float(reach[high] - reach[low]), ends, False

    def _route(self, route: Route) -> EdgePoints:
        marks = [self._model.landmarks[name] for name in route.landmarks]
        pieces: list[EdgePoints] = [EdgePoints.at(marks[:1])]
        ends = marks[1:] + (marks[:1] if route.closed else [])
        for start, end, leg in zip(marks, ends, route.legs, strict=False):
            if leg != "straight":
                pieces.append(self._over_skin(route, start, end, leg))
            pieces.append(EdgePoints.at([end]))
        if route.closed:
            pieces.pop()
        return EdgePoints.joined(pieces)

    def _over_skin(self, route: Route, start: int, end: int, leg: Leg) -> EdgePoints:
        ends = self._vertices[start], self._vertices[end]
        if route.closed:
            outward = 0.5 * (ends[0] + ends[1]) - self._mean(route.landmarks)
        else:
            outward = self._facing(route, ends[0]) + self._facing(route, ends[1])
        if leg != "shortest":
            return self._in_plane(route, ends, outward, taut=leg == "tape")
        along = ends[1] - ends[0]
        aside = _unit(cross(along, outward))
        outward = _unit(cross(aside, along))
        lines = [
            self._in_plane(route, ends, np.cos(tilt) * outward + np.sin(tilt) * aside, taut=False)
            for tilt in SHORTEST_TILTS_RAD
        ]

        def length_m(line: EdgePoints) -> float:
            path = np.vstack([ends[0], line.on(self._vertices), ends[1]])
            return loop_length(path, closed=False)

        return min(lines, key=length_m)

    def _in_plane(
        self, route: Route, ends: tuple[Array, Array], outward: Array, *, taut: bool
    ) -> EdgePoints:
        normal = _unit(cross(ends[1] - ends[0], outward))
        net = _net(self._model, route.parts)
        found, crossing = net.cut(self._vertices, ends[0], normal)
        order: Index = surface_order(
            found.on(self._vertices),
            net.segments(crossing),
            ends,
            outward,
            taut=taut,
            bulge=route.bulge,
        )
        return found.take(order)

    def _facing(self, route: Route, end: Array) -> Array:
        """Unit normal of the skin around an end of a leg."""
        neck, crotch = (self._at(landmark) for landmark in TRUNK_ENDS)
        reach_m = NORMAL_RADIUS * float(np.linalg.norm(neck - crotch))
        triangles = _triangles(self._model, route.parts)
        return _unit(around(self._middles, self._area_vectors, triangles, end, reach_m))
