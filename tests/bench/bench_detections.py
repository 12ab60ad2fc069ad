"""Detections of a waved ball in rendered images, with hand, arm and a walking helper in view.

How far the ball is from where it is found: of all detections, of those that a calibration keeps by
their radius, and of those that are left once the cameras are compared, which is what it uses. It
weighs these by how far each lies off the ball's path, for which the true path stands here. The
sensors have noise but no systematic errors.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))

import synthetic_calibration as synthetic

from station.calibration.adjust.equations import TREMOR_M
from station.calibration.adjust.residuals import robust_weight
from station.calibration.detect.ball import find_ball
from station.calibration.detect.detections import BallDetection
from station.calibration.detect.scene import static_view
from station.calibration.detect.step_names import BALL, EMPTY
from station.calibration.solve.initial import sorted_detections
from station.calibration.solve.pairwise import GATE_M
from station.core.geometry import transform
from station.core.kinect_v1 import DEPTH_SCALE_M, TABLE
from station.simulation import violations
from station.simulation.procedure import VirtualProcedure

Array = NDArray[np.float64]

SWITCHES = (violations.HAND, violations.HELPER)
_FAR_MM, _LARGEST_SHARE, _ENOUGH = 5.0, 2.0, 500
_EMPTY_S = 0.5


def detected(procedure: VirtualProcedure, name: str, rate_hz: float) -> list[BallDetection]:
    """Detections of one camera in images so many times a second."""
    camera = synthetic.factory(procedure.booth.rig)[name]
    empty = [TABLE[frame.raw] for frame in procedure.frames(name, EMPTY, limit_s=_EMPTY_S)]
    background = static_view(np.stack(empty), DEPTH_SCALE_M).depth_m()
    found = (
        find_ball(
            TABLE[frame.raw] * np.float32(DEPTH_SCALE_M),
            camera,
            procedure.radius_m,
            frame.time_s,
            background,
        )
        for frame in procedure.frames(name, BALL, stride=30.0 / rate_hz)
    )
    return [detection for detection in found if detection is not None]


def off_m(procedure: VirtualProcedure, name: str, detections: Sequence[BallDetection]) -> Array:
    """Vectors (n, 3) from where the ball is to where it was found, world frame."""
    pose = procedure.booth.rig.cameras[name].world_from_camera
    found = [
        transform(pose, ball.center_m) - procedure.ball_center_m(ball.time_s) for ball in detections
    ]
    return np.array(found).reshape(-1, 3)


def agreeing(
    procedure: VirtualProcedure,
    kept: Mapping[str, Sequence[BallDetection]],
    others: Mapping[str, Sequence[BallDetection]],
    within_s: float,
) -> dict[str, NDArray[np.bool_]]:
    """Masks of the detections that another camera agrees with, as a calibration compares them.

    It does so between a camera's neighbouring images; here the ball's true path lies between them.
    """
    found = {}
    for name, own in kept.items():
        agreed = np.zeros(len(own), bool)
        times, off = np.array([ball.time_s for ball in own]), off_m(procedure, name, own)
        for other, theirs in others.items():
            if other != name:
                apart_s = np.abs(times[:, None] - np.array([ball.time_s for ball in theirs]))
                apart = off[:, None] - off_m(procedure, other, theirs)
                near = np.linalg.norm(apart, axis=2) < GATE_M
                agreed |= ((apart_s < within_s) & near).any(axis=1)
        found[name] = agreed
    return found


def weights(procedure: VirtualProcedure, name: str, used: Sequence[BallDetection]) -> Array:
    """Weights (n,) that a solution gives to the detections of a camera."""
    if not used:
        return np.zeros(0)
    turn = procedure.booth.rig.cameras[name].world_from_camera[:3, :3]
    off = off_m(procedure, name, used) @ turn
    spread = np.array([ball.covariance_m2 for ball in used]) + TREMOR_M**2 * np.eye(3)
    deviation = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[..., None])[..., 0])
    return robust_weight(deviation)


def judge(seed: int, rate_hz: float) -> tuple[Array, Array, Array, Array]:
    """Errors (n,) of one booth, mm: of what is found, of what is kept, of what is used; and the
    weights of the last."""
    procedure = VirtualProcedure(synthetic.booth(seed, bias_m=0.0, switches=SWITCHES))
    found, kept, others, errors, kept_mm = {}, {}, {}, {}, {}
    for name in procedure.booth.rig.cameras:
        found[name] = detected(procedure, name, rate_hz)
        kept[name], others[name] = (
            sorted_detections(found[name], [name], procedure.radius_m, held=held)[name].waved
            for held in (True, False)
        )
        errors[name], kept_mm[name] = (
            1e3 * np.linalg.norm(off_m(procedure, name, balls), axis=1)
            for balls in (found[name], kept[name])
        )
    agreed = agreeing(procedure, kept, others, 0.5 / rate_hz)
    used_mm = {name: own[agreed[name]] for name, own in kept_mm.items()}
    for name in found:
        cells = [
            f"{len(own):>7}{_far_share(own):>9.1f}{own.max(initial=0.0):>8.1f}"
            for own in (errors[name], kept_mm[name], used_mm[name])
        ]
        print(f"{seed:>4} {name:<14}{''.join(cells)}", flush=True)
    weighed = {
        name: weights(
            procedure, name, [ball for ball, good in zip(own, agreed[name], strict=True) if good]
        )
        for name, own in kept.items()
    }
    every, some, last, weight = (
        np.concatenate(list(own.values())) for own in (errors, kept_mm, used_mm, weighed)
    )
    return every, some, last, weight


def _far_share(errors_mm: Array, weight: Array | None = None) -> float:
    """Percentage of the errors (n,), weighed, that are too large."""
    if not len(errors_mm):
        return 0.0
    return 100.0 * float(np.average(errors_mm > _FAR_MM, weights=weight))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2, help="booths")
    parser.add_argument("--first", type=int, default=1, help="seed of the first booth")
    parser.add_argument("--rate", type=float, default=4.0, help="images a second of each camera")
    given = parser.parse_args(arguments)
    columns = "".join(f"{what:>7}{'> 5 mm %':>9}{'worst':>8}" for what in ("found", "kept", "used"))
    print(f"{'seed':>4} {'camera':<14}{columns}")
    booths = [judge(seed, given.rate) for seed in range(given.first, given.first + given.seeds)]
    found, kept, used, weight = (np.concatenate(group) for group in zip(*booths, strict=True))
    verdict = "met" if _far_share(used) <= _LARGEST_SHARE else "MISSED"
    if len(used) < _ENOUGH:
        verdict += f", but fewer than {_ENOUGH} say little"
    print(
        f"\nof {len(used)} detections that are used, {_far_share(used):.2f} % are off by more than "
        f"{_FAR_MM:g} mm  <= {_LARGEST_SHARE:g}  {verdict}"
    )
    print(
        f"  as the solution weighs them {_far_share(used, weight):.2f} %; {np.sum(weight == 0.0)} "
        "get no weight"
    )
    print(
        f"  before the cameras are compared {_far_share(kept):.2f} % of {len(kept)}; of all found "
        f"{_far_share(found):.1f} % of {len(found)}; median error used {np.median(used):.2f} mm"
    )


if __name__ == "__main__":
    main()
