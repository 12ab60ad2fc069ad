"""Sculpting: what real bodies have and generated ones don't, as displacements of a surface.

Folds, muscles, sagging flesh, the edges of underwear, necks, flattened cross-sections, other faces,
hands and feet. Amplitudes and wavelengths are estimates by eye of what people look like; none is
taken from the model, its prior or its intervals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Random = np.random.Generator

SIDES = (("left", 1.0), ("right", -1.0))
_WAVES = 60


@dataclass(frozen=True, slots=True)
class Body:
    """A body in the neutral pose (z up, facing -y, arms held off the trunk) to be sculpted."""

    vertices: Array
    """(P, 3) metres."""
    normals: Array
    parts: dict[str, Array]
    """Part -> smooth share (P,) of each vertex that belongs to it."""
    at: dict[str, Array]
    """Landmark -> position (3,)."""
    female: bool

    def share(self, *names: str) -> Array:
        """Summed shares (P,) of some parts."""
        return np.asarray(sum(self.parts[name] for name in names))

    @property
    def trunk(self) -> Array:
        return self.share("pelvis", "abdomen", "chest")

    def facing(self, direction: tuple[float, float, float]) -> Array:
        """Share (P,) by which each vertex faces a direction: 0 to 1."""
        return np.clip(self.normals @ np.asarray(direction), 0.0, 1.0)


Feature = Callable[[Body, Random], Array]
"""Displacements (P, 3) in metres of one trait, of random strength."""


def sculpted(body: Body, rng: Random) -> Array:
    """Displacements (P, 3) of all traits together."""
    return np.asarray(sum(feature(body, rng) for feature in FEATURES))


def bump(points: Array, center: Array, radii: tuple[float, float, float]) -> Array:
    """A Gaussian hill (P,) of height 1 with a standard deviation along each axis."""
    return np.asarray(np.exp(-0.5 * np.square((points - center) / np.asarray(radii)).sum(axis=1)))


def groove(away: Array, width: float) -> Array:
    """Profile (P,) of a crease at a signed distance: depth 1, flesh standing up on both banks."""
    crease = np.exp(-np.square(away / width))
    banks = np.exp(-np.square((np.abs(away) - 2.2 * width) / (1.3 * width)))
    return np.asarray(0.45 * banks - crease)


def smooth_step(value: Array, start: float, end: float) -> Array:
    """From 0 at the start to 1 at the end."""
    t = np.clip((value - start) / (end - start), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def random_field(points: Array, wavelengths: tuple[float, float], rng: Random) -> Array:
    """A smooth random field (P,) of unit variance that holds a range of wavelengths (metres)."""
    directions = rng.standard_normal((3, _WAVES))
    directions /= np.linalg.norm(directions, axis=0)
    shortest, longest = wavelengths
    lengths = shortest * (longest / shortest) ** rng.random(_WAVES)
    phases = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    waves = np.cos(points @ (2.0 * np.pi * directions / lengths) + phases)
    return np.asarray(np.sqrt(2.0 / _WAVES) * waves.sum(axis=1))


def random_shift(points: Array, wavelengths: tuple[float, float], rng: Random) -> Array:
    """Displacements (P, 3), each coordinate a random field: skin that is folded finely (lips,
    lids, fingers) would be torn by displacements along its normals."""
    return np.stack([random_field(points, wavelengths, rng) for _ in range(3)], axis=1)


def _sided(low: float, high: float, rng: Random) -> Array:
    """Two strengths that differ by some 15 per cent: left and right."""
    return rng.uniform(low, high) * (1.0 + 0.15 * rng.standard_normal(2))


def folds(body: Body, rng: Random) -> Array:
    """Creases of the armpits, below the buttocks, across the belly and along the back."""
    v, height = body.vertices, np.zeros(len(body.vertices))
    back, front = body.facing((0.0, 1.0, 0.0)), body.facing((0.0, -1.0, 0.0))
    for (side, sign), gluteal, armpit in zip(
        SIDES, _sided(0.004, 0.010, rng), _sided(0.003, 0.009, rng), strict=True
    ):
        buttock = body.at[f"buttock_{side}"]
        level = 0.75 * body.at["crotch"][2] + 0.25 * buttock[2] + rng.uniform(-0.01, 0.01)
        across = sign * v[:, 0] - sign * buttock[0]
        curve = level + 1.2 * np.square(across)
        along = np.exp(-0.5 * np.square(across / 0.055)) * smooth_step(sign * v[:, 0], 0.0, 0.02)
        where = along * back * body.share("pelvis", f"thigh_{side}")
        height += gluteal * where * groove(v[:, 2] - curve, rng.uniform(0.008, 0.014))
        for place, facing in (("front", front), ("back", back)):
            start = body.at[f"armpit_{place}_{side}"]
            inwards = sign * (v[:, 0] - start[0]) + 0.35 * (v[:, 2] - start[2])
            up = smooth_step(v[:, 2], start[2] - 0.05, start[2]) * (
                1.0 - smooth_step(v[:, 2], start[2] + 0.03, start[2] + 0.09)
            )
            near = body.share("chest", f"shoulder_{side}", f"upper_arm_{side}")
            strength = armpit * rng.uniform(0.6, 1.2)
            height += strength * up * facing * near * groove(inwards, rng.uniform(0.008, 0.013))
    waist, crotch = body.at["waist_front"][2], body.at["crotch"][2]
    for _ in range(int(rng.integers(0, 3))):
        level = crotch + (waist - crotch) * rng.uniform(0.35, 1.05)
        wide = np.exp(-np.square(v[:, 0] / rng.uniform(0.10, 0.18)))
        crease = groove(v[:, 2] - level + 0.8 * np.square(v[:, 0]), rng.uniform(0.009, 0.016))
        height += rng.uniform(0.003, 0.010) * wide * front * body.trunk * crease
    for _ in range(int(rng.integers(0, 3))):
        level = waist + (body.at["bust_left"][2] - waist) * rng.uniform(0.1, 1.0)
        slant = rng.uniform(0.2, 0.6) * np.abs(v[:, 0])
        crease = groove(v[:, 2] - level + slant, rng.uniform(0.010, 0.018))
        height += rng.uniform(0.002, 0.006) * back * body.trunk * crease
    return height[:, None] * body.normals


def muscles(body: Body, rng: Random) -> Array:
    """Bellies of muscles that stand out, or have wasted, with the furrows around them."""
    height = np.zeros(len(body.vertices))
    strength = rng.uniform(-0.6, 1.3)
    for side, sign in SIDES:
        at = {name: body.at[f"{name}_{side}"] for name in ("acromion", "elbow", "wrist", "knee")}
        hip, ankle = body.at[f"hip_side_{side}"], body.at[f"ankle_{side}"]
        arm, shin = (f"upper_arm_{side}", f"shoulder_{side}"), (f"shin_{side}",)
        thigh = (f"thigh_{side}",)
        for start, end, share, aside, radius, height_m, parts in (
            (at["acromion"], at["elbow"], 0.12, (sign * 0.05, 0.0, 0.0), 0.035, 0.007, arm),
            (at["acromion"], at["elbow"], 0.55, (0.0, -0.04, 0.0), 0.032, 0.006, arm),
            (at["acromion"], at["elbow"], 0.50, (0.0, 0.05, 0.0), 0.032, 0.006, arm),
            (at["elbow"], at["wrist"], 0.22, (sign * 0.03, 0.0, 0.0), 0.03, 0.004,
             (f"forearm_{side}",)),
            (hip, at["knee"], 0.45, (0.0, -0.08, 0.0), 0.055, 0.007, thigh),
            (hip, at["knee"], 0.82, (-sign * 0.03, -0.02, 0.0), 0.03, 0.006, thigh),
            (hip, at["knee"], 0.45, (0.0, 0.08, 0.0), 0.055, 0.006, thigh),
            (at["knee"], ankle, 0.28, (-sign * 0.02, 0.07, 0.0), 0.04, 0.007, shin),
            (at["knee"], ankle, 0.28, (sign * 0.03, 0.07, 0.0), 0.035, 0.005, shin),
            (body.at[f"bust_{side}"], at["acromion"], 0.3, (0.0, 0.0, 0.0), 0.05, 0.007,
             ("chest",)),
            (body.at[f"side_neck_{side}"], at["acromion"], 0.3, (0.0, 0.02, 0.0), 0.035, 0.008,
             ("chest", "neck", f"shoulder_{side}")),
        ):  # fmt: skip
            center = (1.0 - share) * start + share * end + np.asarray(aside)
            radii = (0.8 * radius, 0.8 * radius, 1.4 * radius)
            wide = (1.5 * radii[0], 1.5 * radii[1], 1.4 * radii[2])
            hill = bump(body.vertices, center, radii) - 0.5 * bump(body.vertices, center, wide)
            mine = height_m * (strength + 0.35 * rng.standard_normal())
            height += 2.0 * mine * hill * body.share(*parts)
    return height[:, None] * body.normals


def sagging(body: Body, rng: Random) -> Array:
    """Breasts, belly, buttocks and the backs of the arms hang: down, and out at their lower end."""
    down, out = np.zeros(len(body.vertices)), np.zeros(len(body.vertices))
    v = body.vertices
    belly = 0.55 * body.at["waist_front"] + 0.45 * body.at["crotch"]
    places = [(np.array([0.0, body.at["waist_front"][1], belly[2]]), (0.13, 0.07, 0.06), 0.016)]
    breast = 0.022 if body.female else 0.007
    for side, _ in SIDES:
        arm = 0.55 * body.at[f"acromion_{side}"] + 0.45 * body.at[f"elbow_{side}"]
        places += [
            (body.at[f"bust_{side}"], (0.055, 0.05, 0.045), breast),
            (body.at[f"buttock_{side}"], (0.07, 0.07, 0.05), 0.014),
            (arm + np.array([0.0, 0.03, -0.05]), (0.05, 0.04, 0.05), 0.008),
        ]
    flesh = body.trunk + sum(
        body.parts[f"{part}_{side}"] for part in ("upper_arm", "thigh") for side, _ in SIDES
    )
    amount = rng.uniform(0.0, 1.0)
    for center, radii, most in places:
        mine = most * amount * (1.0 + 0.2 * rng.standard_normal())
        down += mine * bump(v, center, radii)
        out += 0.5 * mine * bump(v, center - (0.0, 0.0, 0.6 * radii[2]), radii)
    moved = out[:, None] * body.normals
    moved[:, 2] -= down
    return np.asarray(flesh[:, None] * moved)


def _band(away: Array, pressed: float) -> Array:
    """Profile (P,) across an elastic edge: a dent under it, flesh that stands up on both sides."""
    dent = np.exp(-np.square(away / 0.007))
    swell = np.exp(-np.square((away - 0.018) / 0.011)) + 0.5 * np.exp(
        -np.square((away + 0.022) / 0.014)
    )
    return np.asarray(pressed * (0.6 * swell - dent))


def underwear(body: Body, rng: Random) -> Array:
    """Briefs' waistband and leg openings; the band and straps of a bra."""
    v, height = body.vertices, np.zeros(len(body.vertices))
    cloth = rng.uniform(0.0008, 0.002)
    hips = body.share("pelvis", "abdomen", "thigh_left", "thigh_right")
    waist, crotch = body.at["waist_front"][2], body.at["crotch"][2]
    top = crotch + (waist - crotch) * rng.uniform(0.45, 0.8) - 0.15 * v[:, 1]
    below = 1.0 - smooth_step(v[:, 2] - top, -0.004, 0.004)
    inside = hips * below
    height += hips * _band(v[:, 2] - top, rng.uniform(0.001, 0.004))
    slope = rng.uniform(0.2, 1.6)
    for _, sign in SIDES:
        leg = sign * v[:, 0] - 0.02 - (v[:, 2] - crotch + rng.uniform(0.0, 0.06)) / slope
        away = leg / np.sqrt(1.0 + 1.0 / slope**2)
        own = hips * smooth_step(sign * v[:, 0], 0.0, 0.02) * below
        inside *= 1.0 - smooth_step(sign * v[:, 0], 0.0, 0.01) * smooth_step(away, -0.004, 0.004)
        height += own * _band(away, rng.uniform(0.001, 0.004))
    height += cloth * inside
    if body.female:
        level = 0.5 * (body.at["underbust_left"][2] + body.at["underbust_right"][2])
        pressed = rng.uniform(0.0015, 0.005)
        chest = body.share("chest", "abdomen")
        height += chest * _band(v[:, 2] - level, pressed)
        for side, sign in SIDES:
            line = body.at[f"bust_{side}"][0] + 0.15 * (v[:, 2] - level)
            above = smooth_step(v[:, 2], body.at[f"bust_{side}"][2] + 0.03, level + 0.15)
            strap = np.exp(-np.square((sign * v[:, 0] - sign * line) / 0.010))
            height -= 0.6 * pressed * strap * above * body.share("chest", f"shoulder_{side}")
    return height[:, None] * body.normals


def necks(body: Body, rng: Random) -> Array:
    """Heavy or thin necks, a hump below the nape, a larynx, a head carried forwards."""
    v, neck = body.vertices, body.parts["neck"]
    level = body.normals * (1.0, 1.0, 0.0)
    thick = rng.uniform(-0.003, 0.010) * (0.5 + body.facing((0.0, 1.0, 0.0)))
    moved = (thick * neck)[:, None] * level
    hump = rng.uniform(0.0, 0.014) * bump(v, body.at["cervicale"], (0.05, 0.04, 0.035))
    moved += hump[:, None] * body.normals
    larynx = (0.001 if body.female else 0.005) * rng.uniform(0.3, 1.5)
    moved += (larynx * bump(v, body.at["neck_front"], (0.012, 0.02, 0.014)))[:, None] * level
    jowl = body.at["chin"] + (0.0, 0.03, -0.015)
    chin = rng.uniform(0.0, 0.010) * bump(v, jowl, (0.04, 0.03, 0.02))
    moved += chin[:, None] * body.normals
    moved[:, 1] -= rng.uniform(-0.005, 0.015) * (body.parts["head"] + 0.5 * neck)
    return np.asarray(moved)


def cross_sections(body: Body, rng: Random) -> Array:
    """A trunk broader and flatter, or narrower and deeper, and limbs that aren't round."""
    v, moved = body.vertices, np.zeros_like(body.vertices)
    top, bottom = body.at["armpit_left"][2], body.at["crotch"][2] - 0.1
    window = smooth_step(v[:, 2], bottom, bottom + 0.15) * (
        1.0 - smooth_step(v[:, 2], top - 0.06, top + 0.06)
    )
    soft = body.share("pelvis", "abdomen", "chest", "thigh_left", "thigh_right") * window
    levels = v * (0.0, 0.0, 1.0)
    middle_y = 0.5 * (body.at["waist_front"][1] + body.at["waist_back"][1])
    common = 0.025 * rng.standard_normal()
    broad = common + 0.02 * random_field(levels, (0.25, 0.6), rng)
    deep = -common + 0.02 * random_field(levels, (0.25, 0.6), rng)
    moved[:, 0] += soft * broad * v[:, 0]
    moved[:, 1] += soft * deep * (v[:, 1] - middle_y)
    for side, _ in SIDES:
        for part in ("upper_arm", "forearm", "thigh", "shin"):
            share = body.parts[f"{part}_{side}"]
            center = np.average(v, axis=0, weights=share)
            spread = np.cov((v - center).T, aweights=share)
            axis, first, second = np.linalg.eigh(spread)[1].T[::-1]
            along = (v - center) @ axis
            window = share * np.exp(-np.square(along / (1.3 * np.sqrt(axis @ spread @ axis))))
            turn = rng.uniform(0.0, np.pi)
            x = np.cos(turn) * first + np.sin(turn) * second
            y = np.cos(turn) * second - np.sin(turn) * first
            amount = 0.04 * rng.standard_normal()
            stretched = np.outer((v - center) @ x, x) - np.outer((v - center) @ y, y)
            moved += amount * window[:, None] * stretched
    return moved


def heads(body: Body, rng: Random) -> Array:
    """Other faces and skulls."""
    v, head = body.vertices, body.parts["head"]
    center = np.average(v, axis=0, weights=head)
    moved = (v - center) * (0.025 * rng.standard_normal(3))
    face = smooth_step(center[1] - v[:, 1], 0.02, 0.06)
    moved += 0.002 * (0.5 + face)[:, None] * random_shift(v, (0.06, 0.15), rng)
    nose = bump(v, body.at["glabella"] + (0.0, -0.01, -0.055), (0.012, 0.02, 0.02))
    moved[:, 1] -= rng.uniform(-0.003, 0.006) * nose
    return np.asarray(head[:, None] * moved)


def hands_and_feet(body: Body, rng: Random) -> Array:
    """Longer or shorter hands, broader, longer or higher feet; the soles stay on the floor."""
    v, moved = body.vertices, np.zeros_like(body.vertices)
    longer, other = 0.05 * rng.standard_normal(), 0.04 * rng.standard_normal(2)
    for side, _ in SIDES:
        hand = body.share(*(f"{part}_{side}" for part in ("hand", "thumb", "fingers")))
        size = longer + 0.01 * rng.standard_normal()
        moved += size * hand[:, None] * (v - body.at[f"wrist_{side}"])
        moved += 0.0012 * hand[:, None] * random_shift(v, (0.06, 0.15), rng)
        foot, ankle = body.parts[f"foot_{side}"], body.at[f"ankle_{side}"]
        scale = np.array([other[0], other[1], 0.0]) + 0.01 * rng.standard_normal(3)
        moved += foot[:, None] * scale * (v - ankle) * (1.0, 1.0, 0.0)
        above = smooth_step(v[:, 2], 0.015, 0.05)
        moved[:, 2] += 0.003 * rng.standard_normal() * above * foot
        moved += 0.0015 * (above * foot)[:, None] * random_shift(v, (0.06, 0.15), rng)
    return moved


def everywhere(body: Body, rng: Random) -> Array:
    """Individual irregularities of a body, at all wavelengths from 6 to 40 cm."""
    v = body.vertices
    fine = ("head", "hand", "thumb", "fingers", "foot")
    skin = 1.0 - body.share(*(name for name in body.parts if name.startswith(fine)))
    height = 0.0026 * random_field(v, (0.10, 0.40), rng) + 0.0009 * random_field(
        v, (0.06, 0.1), rng
    )
    return (skin * height)[:, None] * body.normals


FEATURES: tuple[Feature, ...] = (
    folds,
    muscles,
    sagging,
    underwear,
    necks,
    cross_sections,
    heads,
    hands_and_feet,
    everywhere,
)
