"""Measures a true body for the benchmark, sharing with the product's measuring only the written
definitions: the table of rows with its planes' shares, tilts and limits, the landmarks' vertices,
the parts' names.

Everything is done another way. A plane cuts whole triangles into segments; a tape around them is
as long as the mean of the section's widths over all directions times pi (Cauchy's formula for
convex curves); a tape over the skin follows the envelope of the section above its chord.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from station.core.geometry import so3_exp
from workers.measure.definitions import DEFINITIONS
from workers.measure.kinds import (
    NARROWEST_TILTS_RAD,
    NORMAL_RADIUS,
    PROTRUSION_SHARE,
    SHORTEST_TILTS_RAD,
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
    Top,
)
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

_DIRECTIONS = 720
_STEP_M = 2.5e-4
_LEVEL_STEP_M = 2e-3
_SAME_POINT_M = 1e-6
_BELOW = 0.10
_SHORTEST_TILTS = 21


class TrueBody:
    """One body (P, 3) with the template's landmarks and parts."""

    def __init__(self, model: BodyModel, vertices: Array) -> None:
        self._v = vertices
        self._faces = model.faces
        self._at = {name: vertices[index] for name, index in model.landmarks.items()}
        self._part = np.array(model.part_names)[model.part_of_vertex]

    def values(self) -> dict[str, float]:
        """Row -> metres; "volume" in cubic metres and "surface" in square metres."""
        found = {row.name: self._value(row) for row in DEFINITIONS}
        a, b, c = (self._v[self._faces[:, i]] for i in range(3))
        found["volume"] = float(np.linalg.det(np.stack([a, b, c], axis=1)).sum() / 6.0)
        sides = [np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))]
        half = sum(sides) / 2.0
        square = half * (half - sides[0]) * (half - sides[1]) * (half - sides[2])
        found["surface"] = float(np.sqrt(np.maximum(square, 0.0)).sum())
        return found

    def _value(self, row: Definition) -> float:
        kind = row.kind
        if isinstance(kind, Top):
            return float(self._v[self._part == kind.part, 2].max())
        if isinstance(kind, Drop):
            return max(0.0, float(self._at[kind.upper][2] - self._at[kind.lower][2]))
        if isinstance(kind, Route):
            return self._route(kind)
        return self._section(row, kind)

    def _section(self, row: Definition, kind: Section) -> float:
        if isinstance(kind.plane, Narrowest):
            girths = [self._neck(kind.plane, kind.parts, tilt) for tilt in NARROWEST_TILTS_RAD]
            return min(girth for girth in girths if girth is not None)
        if isinstance(kind.plane, Thickest):
            return self._thickest(kind.plane, kind)
        point, normal = self._plane(kind.plane)
        points = self._points(point, normal, kind)
        if kind.across is None:
            return _tape_around(points, normal)
        side, other = kind.across
        across = self._at[other] - self._at[side]
        across = across - normal * (normal @ across)
        across /= np.linalg.norm(across)
        if row.quantity == "depth":
            across = np.cross(normal, across)
        return float(np.ptp(points @ across))

    def _points(self, point: Array, normal: Array, kind: Section) -> Array:
        segments = self._segments(point, normal, kind.parts)
        if not kind.whole:
            segments = _own_chain(segments, point, normal)
        return segments.reshape(-1, 3)

    def _thickest(self, plane: Thickest, kind: Section) -> float:
        """Every 2 mm, the greatest of all."""
        (low, _), (high, up) = self._plane(plane.lower), self._plane(plane.upper)
        count = int(np.ceil(np.linalg.norm(high - low) / _LEVEL_STEP_M))
        levels = (low + share * (high - low) for share in np.linspace(0.0, 1.0, count + 1))
        return max(_tape_around(self._points(level, up, kind), up) for level in levels)

    def _neck(self, plane: Narrowest, parts: tuple[str, ...], tilt: float) -> float | None:
        at = self._at
        side = at[plane.other_side] - at[plane.side]
        side /= np.sqrt(side @ side)
        upright = np.array([0.0, 0.0, 1.0]) - side[2] * side
        normal = so3_exp(tilt * side) @ (upright / np.sqrt(upright @ upright))
        middle = (at[plane.front] + at[plane.back]) / 2.0
        for chain in _chains(self._segments(at[plane.front], normal, parts)):
            if _goes_around(chain, normal, middle):
                return _tape_around(chain.reshape(-1, 3), normal)
        return None

    def _plane(self, plane: Plane) -> tuple[Array, Array]:
        at = self._at
        if isinstance(plane, Level):
            start = sum(at[name] for name in plane.landmarks) / len(plane.landmarks)
            if plane.towards:
                end = sum(at[name] for name in plane.towards) / len(plane.towards)
                start = (1.0 - plane.share) * start + plane.share * end
            return start, np.array([0.0, 0.0, 1.0])
        if isinstance(plane, Protrusion):
            heights = [float(self._plane(level)[0][2]) for level in (plane.lower, plane.upper)]
            ahead = (at[plane.end] - at[plane.start]) * (1.0, 1.0, 0.0)
            ahead /= np.sqrt(ahead @ ahead)
            places = [
                place
                for place, part in zip(self._v, self._part, strict=True)
                if part in plane.parts and heights[0] <= place[2] <= heights[1]
            ]
            most = max(float(place @ ahead) for place in places)
            softness = PROTRUSION_SHARE * (heights[1] - heights[0])
            shares = [np.exp((float(place @ ahead) - most) / softness) for place in places]
            return np.average(places, axis=0, weights=shares), np.array([0.0, 0.0, 1.0])
        if isinstance(plane, Perpendicular):
            line = at[plane.end] - at[plane.start]
            share = plane.share
            if plane.beyond:
                passed = (at[plane.beyond] - at[plane.start]) @ line / (line @ line)
                share = max(share, passed + 0.02 / np.sqrt(line @ line))
            through = at[plane.at] if plane.at else at[plane.start] + share * line
            return through, line / np.sqrt(line @ line)
        normal = np.cross(at[plane.back] - at[plane.front], at[plane.other_side] - at[plane.side])
        return at[plane.front], normal / np.sqrt(normal @ normal)

    def _segments(self, point: Array, normal: Array, parts: tuple[str, ...]) -> Array:
        """Segments (n, 2, 3) in which a plane cuts the triangles of some parts."""
        mine = np.isin(self._part, parts)[self._faces].all(axis=1)
        corners = self._v[self._faces[mine]]
        height = (corners - point) @ normal
        above = height >= 0.0
        cut = above.any(axis=1) & ~above.all(axis=1)
        corners, height, above = corners[cut], height[cut], above[cut]
        # The corner that is alone on its side, and the two others.
        alone = np.where(above.sum(axis=1) == 1, np.argmax(above, axis=1), np.argmin(above, axis=1))
        index = np.arange(len(alone))
        ends = []
        for step in (1, 2):
            other = (alone + step) % 3
            share = height[index, alone] / (height[index, alone] - height[index, other])
            start = corners[index, alone]
            ends.append(start + share[:, None] * (corners[index, other] - start))
        return np.stack(ends, axis=1)

    def _route(self, kind: Route) -> float:
        names = list(kind.landmarks) + ([kind.landmarks[0]] if kind.closed else [])
        total = 0.0
        for index, leg in enumerate(kind.legs):
            if leg == "floor":
                total += float(self._at[names[index]][2])
            elif leg == "straight":
                total += float(np.linalg.norm(self._at[names[index + 1]] - self._at[names[index]]))
            else:
                total += self._over(kind, names[index], names[index + 1], leg)
        return total

    def _over(self, kind: Route, start: str, end: str, leg: Leg) -> float:
        a, b = self._at[start], self._at[end]
        if kind.closed:
            middle = sum(self._at[name] for name in kind.landmarks) / len(kind.landmarks)
            outward = (a + b) / 2.0 - middle
        else:
            outward = self._normal(start, kind.parts) + self._normal(end, kind.parts)
        if leg != "shortest":
            return self._in_plane(kind, a, b, outward, leg == "tape")
        along = (b - a) / np.sqrt((b - a) @ (b - a))
        tilts = np.linspace(SHORTEST_TILTS_RAD[0], SHORTEST_TILTS_RAD[-1], _SHORTEST_TILTS)
        turned = (so3_exp(tilt * along) @ outward for tilt in tilts)
        return min(self._in_plane(kind, a, b, outward, False) for outward in turned)

    def _in_plane(self, kind: Route, a: Array, b: Array, outward: Array, taut: bool) -> float:
        length = float(np.linalg.norm(b - a))
        along = (b - a) / length
        up = outward - along * (along @ outward)
        up /= np.linalg.norm(up)
        segments = self._segments(a, np.cross(along, up), kind.parts)
        x, y = (segments - a) @ along, (segments - a) @ up
        mine = ((y > -_BELOW * length) & (y < kind.bulge * length)).all(axis=1)
        x, y = x[mine], y[mine]
        corners = x[(x > 0.0) & (x < length)]
        grid = np.unique(np.concatenate([np.arange(0.0, length, _STEP_M), corners]))
        envelope = np.full(len(grid), -np.inf)
        for (x0, x1), (y0, y1) in zip(x, y, strict=True):
            if x1 < x0:
                x0, x1, y0, y1 = x1, x0, y1, y0
            inside = slice(np.searchsorted(grid, x0), np.searchsorted(grid, x1, side="right"))
            heights = np.interp(grid[inside], (x0, x1), (y0, y1))
            envelope[inside] = np.maximum(envelope[inside], heights)
        seen = np.isfinite(envelope)
        line = np.stack([grid[seen], envelope[seen]], axis=1)
        line = np.concatenate([[[0.0, 0.0]], line, [[length, 0.0]]])
        if not taut:
            return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
        # A taut tape: the shortest path that stays above, by relaxing towards the chord from above.
        angle = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
        line[:, 1] = np.maximum(line[:, 1], 0.0)
        reach = np.outer(line[:, 0], np.cos(angle)) + np.outer(line[:, 1], np.sin(angle))
        return float(np.pi * np.ptp(reach, axis=0).mean()) - length

    def _normal(self, landmark: str, parts: tuple[str, ...]) -> Array:
        """Mean normal of the triangles around a landmark, by area and nearness."""
        mine = np.isin(self._part, parts)[self._faces].all(axis=1)
        a, b, c = (self._v[self._faces[mine][:, i]] for i in range(3))
        trunk = np.linalg.norm(np.subtract(*(self._at[end] for end in TRUNK_ENDS)))
        away = np.linalg.norm((a + b + c) / 3.0 - self._at[landmark], axis=1)
        away /= NORMAL_RADIUS * trunk
        nearness = np.where(away < 1.0, 1.0 - away**2, 0.0)
        total = (nearness[:, None] * np.cross(b - a, c - a)).sum(axis=0)
        return np.asarray(total / np.sqrt(total @ total))


def _tape_around(points: Array, normal: Array) -> float:
    """Length of a tape around points (n, 3) of a plane section."""
    return float(np.pi * np.ptp(_reach(points, normal), axis=0).mean())


def _reach(points: Array, normal: Array) -> Array:
    """Coordinate of points (n, 3) along each direction of a plane, (n, directions)."""
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(normal, helper)
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    angle = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
    found = (points @ x)[:, None] * np.cos(angle) + (points @ y)[:, None] * np.sin(angle)
    return np.asarray(found)


def _own_chain(segments: Array, point: Array, normal: Array) -> Array:
    """The segments that hang together around a point, else with the one nearest to it."""

    def away(chain: Array) -> float:
        return float(np.linalg.norm(chain.mean(axis=1) - point, axis=1).min())

    chains = _chains(segments)
    around = [chain for chain in chains if _goes_around(chain, normal, point)]
    if around:
        return max(around, key=lambda chain: _tape_around(chain.reshape(-1, 3), normal))
    return min(chains, key=away)


def _goes_around(chain: Array, normal: Array, point: Array) -> bool:
    """Whether segments (n, 2, 3) of a plane reach as far as a point in every direction."""
    reach, inner = (_reach(points, normal) for points in (chain.reshape(-1, 3), point[None]))
    return bool(((inner <= reach.max(axis=0)) & (inner >= reach.min(axis=0))).all())


def _chains(segments: Array) -> list[Array]:
    """Segments (n, 2, 3), those that hang together."""
    keys = np.round(segments / _SAME_POINT_M).astype(np.int64)
    ends: dict[tuple[int, ...], list[int]] = {}
    for index, pair in enumerate(keys):
        for key in pair:
            ends.setdefault(tuple(key.tolist()), []).append(index)
    left, chains = set(range(len(segments))), []
    while left:
        start = left.pop()
        reached, open_ends = {start}, [start]
        while open_ends:
            for key in keys[open_ends.pop()]:
                for neighbour in ends[tuple(key.tolist())]:
                    if neighbour not in reached:
                        reached.add(neighbour)
                        open_ends.append(neighbour)
        left -= reached
        chains.append(segments[sorted(reached)])
    return chains
