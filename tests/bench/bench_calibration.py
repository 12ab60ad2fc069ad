"""The calibration of simulated booths, from images: poses, their covariances, what a scan gains.

Each booth is put up differently, its sensors err by up to 15 mm at 2 m, tilted over the image, and
their clocks drift. A person waves a ball through it for 60 s, then come mark, floor and board.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).parents[1]))

import synthetic_calibration as synthetic
from calibrated_booths import normalised_square, pair_errors, solved
from procedure_time import print_procedure

from station.calibration.detect.detections import Observations
from station.core.bundle import read_bundle
from station.core.errors import CalibrationError
from station.core.rig import Rig
from station.simulation.observations import simulate
from station.simulation.procedure import VirtualProcedure
from station.simulation.scene import Mesh, load_mesh
from station.simulation.sensor import SimulatedBooth, SimulatedUnit, render_bundle
from workers.cloud.preprocess import preprocess

Array = NDArray[np.float64]

_BODY = Path(__file__).parents[2] / "station/simulation/bodies/ann.npz"
_CYLINDER_M = (0.15, 1.7)


@dataclass(frozen=True, slots=True)
class Row:
    """One booth."""

    seed: int
    shift_mm: Array
    """Errors of each pair of cameras."""
    turn_deg: Array
    normalised: float
    """Squared error of all poses relative to the reference's, in units of their covariance."""
    unknowns: int
    cylinder_mm: float
    body_mm: float
    body_true_mm: float
    seconds: float


def calibrate(seed: int) -> Row | str:
    """Simulate, solve and judge one booth; words if it is refused."""
    procedure = VirtualProcedure(synthetic.booth(seed))
    cameras = synthetic.factory(procedure.booth.rig)
    seen = [simulate(procedure, camera) for camera in cameras.values()]
    return judged(procedure, Observations.merged(seen))


def judged(procedure: VirtualProcedure, observations: Observations) -> Row | str:
    """Solve and judge a booth from its detections; words if it is refused."""
    booth = procedure.booth
    start_s = time.perf_counter()
    try:
        solution = solved(booth.rig, observations, procedure.radius_m)
    except CalibrationError as refusal:
        return f"{booth.seed:<7}refused: {refusal}"
    seconds = time.perf_counter() - start_s
    with tempfile.TemporaryDirectory() as folder:
        cylinder_mm = _cylinder(booth, solution.rig, Path(folder) / "cylinder")
        body_mm, body_true_mm = _body(booth, solution.rig, Path(folder) / "body")
    twists = pair_errors(booth.rig, solution.world_poses)
    return Row(
        booth.seed,
        1e3 * np.linalg.norm(twists[:, 3:], axis=1),
        np.degrees(np.linalg.norm(twists[:, :3], axis=1)),
        normalised_square(booth.rig, solution.world_poses),
        6 * (len(booth.rig.cameras) - 1),
        cylinder_mm,
        body_mm,
        body_true_mm,
        seconds,
    )


def true_rig(booth: SimulatedBooth) -> Rig:
    """Poses and depth corrections as they are."""
    cameras = {}
    for name, camera in booth.rig.cameras.items():
        correction = synthetic.true_correction(SimulatedUnit.of(booth, name).error)
        cameras[name] = replace(camera, depth_correction=correction)
    return replace(booth.rig, cameras=cameras)


def _cylinder(booth: SimulatedBooth, rig: Rig, folder: Path) -> float:
    """Rms distance of merged points from a cylinder on the mark, mm."""
    radius, height = _CYLINDER_M
    shape = o3d.geometry.TriangleMesh.create_cylinder(radius, height, 360, 1)
    up = np.array([0.0, 0.0, height / 2 + 0.05])
    mesh = Mesh(np.asarray(shape.vertices) + up, np.asarray(shape.triangles, np.int32))
    points = _cloud(booth, rig, mesh, folder)
    side = points[(points[:, 2] > 0.2) & (points[:, 2] < height - 0.1)]
    return 1e3 * float(np.sqrt(np.mean((np.hypot(side[:, 0], side[:, 1]) - radius) ** 2)))


def _body(booth: SimulatedBooth, rig: Rig, folder: Path) -> tuple[float, float]:
    """Rms distance of a scanned body's points from it, by the found and by the true rig, mm."""
    body = load_mesh(_BODY)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(body.vertices.astype(np.float32), body.faces.astype(np.uint32))
    found = []
    for name, used in (("found", rig), ("true", true_rig(booth))):
        points = _cloud(booth, used, body, folder.with_name(name)).astype(np.float32)
        away = scene.compute_distance(o3d.core.Tensor(points)).numpy()
        found.append(1e3 * float(np.sqrt(np.mean(away**2))))
    return found[0], found[1]


def _cloud(booth: SimulatedBooth, rig: Rig, mesh: Mesh, folder: Path) -> Array:
    still = replace(booth, sway_m=0.0)
    bundle = read_bundle(render_bundle(mesh, folder, still))
    return preprocess(replace(bundle, rig=rig)).cloud.points


def refusals() -> None:
    """Sessions that must be refused, and the operator's messages."""
    procedure = VirtualProcedure(synthetic.booth(101))
    seen = synthetic.observations(procedure)
    print("\nrefused")
    for fault in synthetic.FAULTS:
        try:
            solved(procedure.booth.rig, fault.spoil(seen), fault.radius_m)
            print(f"  MISSED  {fault.name}")
        except CalibrationError as refusal:
            print(
                f"  {'met' if fault.words in str(refusal) else 'MISSED'}  {fault.name}: {refusal}"
            )


def _bar(text: str, value: float, limit: float, form: str = ".2f") -> None:
    verdict = "met" if value <= limit else "MISSED"
    print(f"  {text:<58}{value:>9{form}}  <= {limit:<7g}{verdict}")


def summary(rows: Sequence[Row], booths: int) -> None:
    """The bars."""
    shift = np.concatenate([row.shift_mm for row in rows])
    turn = np.concatenate([row.turn_deg for row in rows])
    print(f"\n{len(rows)} of {booths} booths, all six pairs of cameras")
    _bar("sound booths refused", booths - len(rows), 0, ".0f")
    _bar("relative poses, mean (mm)", shift.mean(), 1.0)
    _bar("relative poses, worst (mm)", shift.max(), 2.0)
    _bar("relative poses, mean (degrees)", turn.mean(), 0.05, ".3f")
    _bar("relative poses, worst (degrees)", turn.max(), 0.1, ".3f")
    _bar("points off a known cylinder, worst (mm rms)", max(r.cylinder_mm for r in rows), 1.5)
    worse = [row.body_mm - row.body_true_mm for row in rows]
    _bar("a body's cloud worse than by the true rig, worst (mm rms)", max(worse), 0.5)
    _bar("solving, worst (s)", max(row.seconds for row in rows), 10.0)
    total, unknowns = sum(r.normalised for r in rows), sum(r.unknowns for r in rows)
    low, high = chi2.ppf([0.025, 0.975], unknowns)
    verdict = "met" if low <= total <= high else "MISSED"
    print(
        f"  chi-square of the normalised errors {total:.0f}, its 95 % band "
        f"{low:.0f} to {high:.0f}  {verdict}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--booths", type=int, default=20)
    parser.add_argument("--first", type=int, default=1, help="seed of the first booth")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.booths)
    print(
        f"{'booth':<7}{'mm mean':>9}{'worst':>7}{'deg mean':>10}{'worst':>7}{'chi2/n':>8}"
        f"{'cylinder':>10}{'body':>7}{'true':>7}{'s':>6}"
    )
    rows = []
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        for row in pool.imap(calibrate, seeds):
            if isinstance(row, str):
                print(row, flush=True)
                continue
            rows.append(row)
            print(
                f"{row.seed:<7}{row.shift_mm.mean():9.2f}{row.shift_mm.max():7.2f}"
                f"{row.turn_deg.mean():10.3f}{row.turn_deg.max():7.3f}"
                f"{row.normalised / row.unknowns:8.2f}{row.cylinder_mm:10.2f}{row.body_mm:7.2f}"
                f"{row.body_true_mm:7.2f}{row.seconds:6.1f}",
                flush=True,
            )
    summary(rows, len(seeds))
    refusals()
    print_procedure()


if __name__ == "__main__":
    main()
