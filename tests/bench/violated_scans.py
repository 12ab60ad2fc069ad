"""Bodies scanned in booths that were calibrated despite violations: rows and their intervals.

Each body is scanned twice: as the booth is, by the calibration that was found; and with the same
noise in a booth whose calibration is true and whose sensors have no systematic errors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from fit_cases import on_the_mark
from numpy.typing import NDArray
from room import first_with_room
from true_measurements import TrueBody

from station.core.bundle import Bundle, read_bundle
from station.core.rig import Rig
from station.simulation.scene import Mesh
from station.simulation.sensor import SimulatedBooth, render_bundle
from workers.cloud.preprocess import preprocess
from workers.measure.body import MeasuredBody, measure_body
from workers.measure.definitions import DEFINITIONS
from workers.reconstruct.job import scan_errors
from workers.scape.fit.fit import fit_overlapping, separate_limbs
from workers.scape.fit.observer import unobserved
from workers.scape.learn.database import BodyDatabase, Shapes
from workers.scape.model.blas import single_threaded_blas
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

_SEED, _POOL = 41, 64
_QUANTITIES = {"girths": ("girth", "large girth"), "heights": ("height", "drop")}


@dataclass(frozen=True, slots=True)
class ScannedRows:
    """All rows of one body by the calibration that was found, and by the true one."""

    names: tuple[str, ...]
    truth_m: Array
    value_m: Array
    interval_m: Array
    """(n, 2)"""
    true_value_m: Array
    true_interval_m: Array
    status: str
    """Verdict of the fit in the booth as it is: the product delivers what is "ok"."""

    @property
    def held(self) -> NDArray[np.bool_]:
        """Rows whose interval contains the body's true size."""
        return _within(self.truth_m, self.interval_m)

    @property
    def held_by_true(self) -> NDArray[np.bool_]:
        """The same of the true calibration."""
        return _within(self.truth_m, self.true_interval_m)

    @property
    def held_other(self) -> NDArray[np.bool_]:
        """Rows whose interval contains what the true calibration measures."""
        return _within(self.true_value_m, self.interval_m)

    def added_mm(self, what: str) -> Array:
        """Differences from the true calibration of all girths, or of all heights."""
        wanted = {row.name for row in DEFINITIONS if row.quantity in _QUANTITIES[what]}
        chosen = np.array([name in wanted for name in self.names])
        return 1e3 * (self.value_m - self.true_value_m)[chosen]

    def words(self) -> str:
        sizes = {what: np.abs(self.added_mm(what)) for what in _QUANTITIES}
        added = ", ".join(f"{what} {mm.mean():.2f}/{mm.max():.2f}" for what, mm in sizes.items())
        held, by_true, other = (
            100.0 * rows.mean() for rows in (self.held, self.held_by_true, self.held_other)
        )
        return (
            f"    scanned: {self.status}; mm from the true calibration's: {added}; intervals hold "
            f"{held:.0f} % (true calibration {by_true:.0f} %), its values {other:.0f} %"
        )


def scan_rows(model: BodyModel, booth: SimulatedBooth, rig: Rig, folder: Path) -> ScannedRows:
    """One body of the test split, another one in each booth."""
    database = BodyDatabase()
    index = booth.seed % _POOL
    shapes = database.sample("test", _POOL, _SEED).take(np.array([index]))
    poses = np.roll(database.sample_poses("test", _POOL, _SEED), -index, axis=0)
    body = first_with_room(
        database.vertices(shapes)[0], _posed(database, shapes, poses), database.faces
    )
    mesh = on_the_mark(body, database.faces)
    sound = replace(booth, bias_m=0.0, violations=frozenset())
    found, status = _measured(model, mesh, booth, rig, folder / "found")
    true, _ = _measured(model, mesh, sound, booth.rig, folder / "true")
    truth = TrueBody(model, mesh.vertices).values()
    names = tuple(row.name for row in found.rows)
    return ScannedRows(
        names,
        np.array([truth[name] for name in names]),
        np.array([row.value_m for row in found.rows]),
        np.array([row.interval95_m for row in found.rows]),
        np.array([row.value_m for row in true.rows]),
        np.array([row.interval95_m for row in true.rows]),
        status,
    )


def _posed(database: BodyDatabase, shapes: Shapes, poses: Array) -> Iterator[Array]:
    return (database.vertices(shapes, pose[None])[0] for pose in poses)


def _measured(
    model: BodyModel, body: Mesh, booth: SimulatedBooth, rig: Rig, folder: Path
) -> tuple[MeasuredBody, str]:
    return measured(model, read_bundle(render_bundle(body, folder, booth)), rig)


def measured(model: BodyModel, bundle: Bundle, rig: Rig) -> tuple[MeasuredBody, str]:
    """Measurements by a calibration and the fit's verdict, as a reconstruction job has them."""
    scan = preprocess(replace(bundle, rig=rig))
    with single_threaded_blas():
        fit = fit_overlapping(model, scan, "joint", lambda *_: None, unobserved)
        verdict = separate_limbs(model, fit, scan.findings, unobserved).verdict
        errors = scan_errors(model, fit, rig.predicted)
        surface = fit.surface
        return measure_body(model, fit.vertices, surface.sigma_m, surface.seen, errors), str(
            verdict.status
        )


def _within(values: Array, intervals: Array) -> NDArray[np.bool_]:
    return (intervals[:, 0] <= values) & (values <= intervals[:, 1])
