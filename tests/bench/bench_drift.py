"""Does every scan notice a camera that moved, and leave those alone that did not?

Cameras are moved by exactly the limit, 5 mm or 0.3 degrees, in random directions; a person stands
in the booth. Noise is simulated anew for every scan.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from station.calibration.detect.scene import StaticView, static_view
from station.calibration.drift.motion import (
    LEVER_M,
    MOVED_M,
    MOVED_RAD,
    CameraMove,
    DriftReference,
    estimate_move,
)
from station.core.geometry import se3_exp
from station.core.kinect_v1 import DEPTH_SCALE_M, TABLE
from station.core.rig import CameraCalibration
from station.simulation.noise import NoiselessView, TrueView
from station.simulation.scene import Mesh, VirtualScene, fixed_posts, load_mesh
from station.simulation.sensor import SimulatedBooth, SimulatedUnit

BODIES = Path(__file__).parents[2] / "station/simulation/bodies"
STORED_FRAMES, SCAN_FRAMES, CHECK_FRAMES = 45, 10, 30
FALSE_ALARMS_BAR = 1e-3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=300, help="in which nothing moved")
    parser.add_argument("--moves", type=int, default=25, help="of each kind, for each camera")
    arguments = parser.parse_args()
    report(arguments.scans, arguments.moves)


def report(scans: int, moves: int) -> None:
    """Print both tables."""
    booth = SimulatedBooth(bias_m=0.01, clutter=fixed_posts())
    sensors = {name: _Sensor(booth, name) for name in booth.rig.cameras}
    _false_alarms(sensors, scans)
    _detection(sensors, moves)


class _Sensor:
    """One camera, its stored background, and what it would see from anywhere."""

    def __init__(self, booth: SimulatedBooth, name: str) -> None:
        self.camera: CameraCalibration = booth.rig.cameras[name]
        self._unit = SimulatedUnit.of(booth, name)
        self._around = booth.fixtures
        self._rng = np.random.default_rng((7, list(booth.rig.cameras).index(name)))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "view.npz"
            static_view(self.frames(self.view(None), STORED_FRAMES), DEPTH_SCALE_M).save(path)
            self.reference = DriftReference.prepare(self.camera, StaticView.load(path))

    def view(self, body: Mesh | None, xi: NDArray[np.float64] | None = None) -> TrueView:
        pose = self.camera.world_from_camera
        moved = pose if xi is None else pose @ se3_exp(xi)
        scene = VirtualScene([*self._around, *([] if body is None else [body])])
        return scene.view(self.camera, moved)

    def frames(self, view: TrueView, count: int) -> list[NDArray[np.uint16]]:
        still = NoiselessView.of(view, self._unit.error)
        return [TABLE[still.read(self._rng)] for _ in range(count)]

    def estimate(self, view: TrueView, frames: int) -> CameraMove:
        return estimate_move(self.reference, self.frames(view, frames), DEPTH_SCALE_M)


def _false_alarms(sensors: dict[str, _Sensor], scans: int) -> None:
    people = [load_mesh(BODIES / f"{name}.npz") for name in ("ann", "ben", "cleo")]
    scale = np.array([LEVER_M] * 3 + [1.0] * 3)
    print(f"\nNothing moved: {scans} scans of three people, 10 frames, four cameras")
    print(f"  {'camera':<14}{'alarms':>8}{'nearest':>10}{'rms mm':>9}{'chi2 / 6':>10}")
    alarms = np.zeros(scans, bool)
    for name, sensor in sensors.items():
        views = [sensor.view(body) for body in people]
        moves = [sensor.estimate(views[scan % len(views)], SCAN_FRAMES) for scan in range(scans)]
        named = np.array([move.moved or move.lost for move in moves])
        alarms |= named
        size = np.sqrt(np.mean([np.sum((move.xi * scale) ** 2) for move in moves]))
        chi = np.mean([move.xi @ np.linalg.solve(move.covariance, move.xi) for move in moves]) / 6
        nearest = max(move.alarm() for move in moves)
        print(f"  {name:<14}{named.sum():>8}{nearest:>10.2f}{1e3 * size:>9.2f}{chi:>10.2f}")
    count = int(alarms.sum())
    # Clopper and Pearson 1934, one-sided.
    bound = float(beta.ppf(0.95, count + 1, scans - count)) if count < scans else 1.0
    enough = int(np.ceil(np.log(0.05) / np.log1p(-FALSE_ALARMS_BAR)))
    if bound < FALSE_ALARMS_BAR:
        verdict = "met"
    elif scans < enough:
        verdict = f"not shown: that takes {enough} scans without an alarm"
    else:
        verdict = "missed"
    print(
        f"  scans refused for nothing: {count} of {scans}, at 95 % confidence below {bound:.5f}   "
        f"(bar: < {FALSE_ALARMS_BAR:g}; {verdict}; nearest: share of what alarms)"
    )


def _detection(sensors: dict[str, _Sensor], moves: int) -> None:
    rng = np.random.default_rng(11)
    body = load_mesh(BODIES / "ben.npz")
    print(f"\nMoved by the limit: {moves} random directions for each camera")
    print(f"  {'camera':<14}{'5 mm, scan':>12}{'0.3 deg, scan':>15}{'5 mm, check':>13}"
          f"{'0.3 deg, check':>16}   unseen by the empty booth")  # fmt: skip
    counts = np.zeros(4)
    for name, sensor in sensors.items():
        named = np.zeros(4)
        for _ in range(moves):
            direction = rng.standard_normal(3)
            direction /= np.linalg.norm(direction)
            shift = np.concatenate([np.zeros(3), MOVED_M * direction])
            turn = np.concatenate([MOVED_RAD * direction, np.zeros(3)])
            for index, (xi, person, frames) in enumerate(
                (
                    (shift, body, SCAN_FRAMES),
                    (turn, body, SCAN_FRAMES),
                    (shift, None, CHECK_FRAMES),
                    (turn, None, CHECK_FRAMES),
                )
            ):
                move = sensor.estimate(sensor.view(person, xi), frames)
                named[index] += move.moved or move.lost
        counts += named
        empty = sensor.estimate(sensor.view(None), CHECK_FRAMES)
        words = ", ".join(empty.unseen_words()) or "nothing"
        figures = "".join(
            f"{100 * value / moves:>{width}.0f} %"
            for value, width in zip(named, (10, 13, 11, 14), strict=True)
        )
        print(f"  {name:<14}{figures}   {words}")
    shares = counts / (moves * len(sensors))
    print(
        f"  named: {', '.join(f'{100 * share:.0f} %' for share in shares)}   (bar: all; "
        f"{'met' if (shares == 1.0).all() else 'missed'})"
    )


if __name__ == "__main__":
    main()
