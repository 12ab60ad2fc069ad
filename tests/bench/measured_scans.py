"""Scans of bodies with known dimensions, rendered and fitted, and the errors of their rows."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from room import first_with_room
from true_measurements import TrueBody
from unlike_bodies import UnlikeBodies, UnlikeSplit
from unlike_sensor import render_unlike

from station.core.bundle import read_bundle
from station.core.words.tables import Pose
from station.simulation import violations
from station.simulation.scene import Mesh, astray, default_rig
from station.simulation.sensor import SimulatedBooth, render_bundle
from workers.cloud.preprocess import preprocess
from workers.measure.body import measure_body
from workers.measure.intervals import RowErrors, content_sigma, sides_pooled
from workers.measure.scan_errors import line_sigma
from workers.measure.standing import standard_turns, stood_upright
from workers.measure.tracing import trace_all
from workers.scape.fit.fit import FitResult, fit_body
from workers.scape.learn.database import PARTS, BodyDatabase, Shapes, Split
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

POSES: tuple[Pose, ...] = ("as-scanned", "standard")
CONTENTS = ("volume", "surface")
_SEEDS: dict[Split, tuple[int, ...]] = {"validation": (21, 22), "test": (31,)}
_POOL = 96
"""Bodies that are drawn with each seed, however many of them are used."""
_REPEAT_TURN_DEG = 1.5


@dataclass(frozen=True, slots=True)
class Scan:
    """One body as the booth saw it, and its true measurements."""

    name: str
    truth: dict[Pose, dict[str, float]]
    fit: FitResult


class Studio:
    """Renders and fits held-out bodies; scans that were rendered before are used again."""

    def __init__(self, model: BodyModel, folder: Path) -> None:
        self.model = model
        self._folder = folder
        self._database = BodyDatabase()
        turns = standard_turns(model)
        self._standing = np.zeros((1, len(self._database.bones), 3))
        for part, turn in turns.items():
            self._standing[0, self._database.bones.index(PARTS[part][1][0])] = turn

    def population(
        self, split: Split, count: int, switches: frozenset[str] = frozenset()
    ) -> Iterator[Scan]:
        """The first so many bodies of a split, each in a pose of its own.

        Args:
            switches: names of `station.simulation.violations` that the sensors have.
        """
        for pool, seed in enumerate(_SEEDS[split]):
            first = pool * _POOL
            if first >= count:
                return
            shapes = self._database.sample(split, _POOL, seed)
            poses = self._database.sample_poses(split, _POOL, seed)
            for index in range(min(count - first, _POOL)):
                name = "-".join((split, *sorted(switches), f"{first + index:03d}"))
                one = shapes.take(np.array([index]))
                posed = (self._posed(one, pose) for pose in np.roll(poses, -index, axis=0))
                neutral = self._database.vertices(one)[0]
                body = first_with_room(neutral, posed, self._database.faces)
                yield self._scan(name, one, body, first + index, switches)

    def noisy(self, split: Split, count: int) -> Iterator[Scan]:
        """The first so many bodies of a split before sensors with noise that stays."""
        return self.population(split, count, frozenset({violations.FROZEN}))

    def disturbed(self, split: Split, count: int) -> Iterator[Scan]:
        """The first so many bodies of a split before sensors that disturb each other."""
        return self.population(split, count, frozenset({violations.INTERFERENCE}))

    def unlike(self, split: UnlikeSplit, count: int) -> Iterator[Scan]:
        """The first so many sculpted bodies of a split, before sensors unlike the assumed ones."""
        bodies = UnlikeBodies(self.model, split)
        for index, body in enumerate(bodies.bodies(count)):
            vertices = body.mesh.vertices
            bundle = self._bundle(f"unlike-{split}-{index:03d}", vertices)
            if not bundle.exists():
                render_unlike(body.mesh, bundle, SimulatedBooth(seed=7000 + index))
            yield Scan(body.name, body.truth, self._fit(bundle))

    def anew(self, times: int) -> Iterator[Scan]:
        """One body that steps into the booth again and again."""
        shapes = self._database.sample("test", 8, 5).take(np.array([3]))
        base = 0.6 * self._database.sample_poses("test", 8, 5)[3]
        moving = np.abs(base).max(axis=1) > 0.0
        for index in range(times):
            rng = np.random.default_rng((index, 6))
            turned = base.copy()
            turned[moving] += np.radians(_REPEAT_TURN_DEG) * rng.standard_normal((moving.sum(), 3))
            yield self._scan(f"anew-{index:02d}", shapes, self._posed(shapes, turned), 5000 + index)

    def _posed(self, shapes: Shapes, pose: Array) -> Array:
        return self._database.vertices(shapes, pose[None])[0]

    def _scan(
        self,
        name: str,
        shapes: Shapes,
        body: Array,
        seed: int,
        switches: frozenset[str] = frozenset(),
    ) -> Scan:
        rng = np.random.default_rng((seed, 77))
        middle = 0.5 * (body.min(axis=0) + body.max(axis=0))
        body = body - (*(middle[:2] + rng.uniform(-0.03, 0.03, 2)), 0.0)
        bundle = self._bundle(name, body)
        if not bundle.exists():
            booth = SimulatedBooth(
                seed=seed,
                sway_m=float(rng.uniform(0.0, 0.003)),
                moved_cameras={
                    camera: astray(rng.uniform(0.0, 1e-3), np.radians(rng.uniform(0.0, 0.05)), rng)
                    for camera in default_rig().cameras
                },
                violations=switches,
            )
            render_bundle(Mesh(body, self._database.faces), bundle, booth)
        standing = self._database.vertices(shapes, self._standing)[0]
        standing[:, 2] -= self._sole_height(standing) - self._sole_height(self.model.mean)
        truth: dict[Pose, dict[str, float]] = {
            "as-scanned": TrueBody(self.model, body).values(),
            "standard": TrueBody(self.model, standing).values(),
        }
        return Scan(name, truth, self._fit(bundle))

    def _bundle(self, name: str, body: Array) -> Path:
        """Folder of a body's scan: another body database renders other bodies."""
        return self._folder / f"{name}-{hashlib.sha256(body.tobytes()).hexdigest()[:12]}"

    def _fit(self, bundle: Path) -> FitResult:
        return fit_body(self.model, preprocess(read_bundle(bundle)))

    def _sole_height(self, body: Array) -> float:
        """The mean height of the lowest fifth of each foot's vertices, mean of both feet."""
        names = np.array(self.model.part_names)[self.model.part_of_vertex]
        feet = [body[names == f"foot_{side}", 2] for side in ("left", "right")]
        return float(np.mean([np.sort(foot)[: len(foot) // 5].mean() for foot in feet]))


def accepted(scans: Iterator[Scan], wanted: int) -> list[Scan]:
    """The first scans that the product does not ask to take again."""
    kept: list[Scan] = []
    for scan in scans:
        verdict = scan.fit.verdict
        if verdict.status == "ok":
            kept.append(scan)
        print(f"  {scan.name} {verdict.status} {'; '.join(verdict.reasons)}", flush=True)
        if len(kept) == wanted:
            break
    return kept


def row_errors(model: BodyModel, scans: Sequence[Scan]) -> dict[Pose, dict[str, RowErrors]]:
    """Errors of each row over scans, both sides of the body together, with the lines' sigmas and
    the scans' noise."""
    found: dict[Pose, dict[str, list[tuple[float, float, float]]]] = {pose: {} for pose in POSES}
    for scan in scans:
        fit = scan.fit
        noise = fit.cloud.excess_noise_m
        standing = stood_upright(model, fit.overlapping, fit.state)
        for pose, vertices in zip(POSES, (fit.overlapping, standing), strict=True):
            truth = scan.truth[pose]
            for trace in trace_all(model, vertices):
                name = trace.definition.name
                if math.isnan(trace.value_m):
                    continue
                sigma = line_sigma(trace, fit.vertex_sigma_m)
                rows = found[pose].setdefault(sides_pooled(name), [])
                rows.append((trace.value_m - truth[name], sigma, noise))
            measured = measure_body(model, vertices)
            contents = measured.volume_m3, measured.surface_m2
            for name, content in zip(CONTENTS, contents, strict=True):
                if name not in truth:
                    continue
                sigma = content_sigma(fit.vertex_sigma_m)
                rows = found[pose].setdefault(name, [])
                rows.append((content.value / truth[name] - 1.0, sigma, noise))
    return {
        pose: {name: RowErrors(*np.array(rows).T) for name, rows in of_pose.items()}
        for pose, of_pose in found.items()
    }
