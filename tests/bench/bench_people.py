"""Evidence of many people's scans about the cameras: is the one that moved named, and no other?

Different bodies are rendered and fitted, first with every camera where it was calibrated, then with
one of them moved by 3 mm and 0.2 degrees. Only accepted scans count, as in the product. A
correction is offered if each half of the scans confirms that from the other.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from fit_cases import on_the_mark
from numpy.typing import NDArray
from room import first_with_room

from station.calibration.drift.people import ENOUGH, Drift, Evidence, find_drift
from station.core.bundle import read_bundle
from station.simulation.scene import bumped, default_rig
from station.simulation.sensor import SimulatedBooth, render_bundle
from workers.cloud.preprocess import preprocess
from workers.reconstruct.job import warm_up
from workers.scape.fit.fit import fit_overlapping, separate_limbs
from workers.scape.fit.observer import unobserved
from workers.scape.learn.database import BodyDatabase
from workers.scape.model.blas import single_threaded_blas
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

SHIFT_M, TURN_RAD = 0.003, float(np.radians(0.2))
_SEED, _POOL = 51, 96


def evidence(model: BodyModel, moved: Mapping[str, Array], first: int) -> Iterator[Evidence | None]:
    """Evidence of one person's scan after another; None of those that are not accepted."""
    database = BodyDatabase()
    shapes = database.sample("test", _POOL, _SEED)
    poses = database.sample_poses("test", _POOL, _SEED)
    for index in range(_POOL):
        own = shapes.take(np.array([index]))
        tried = (database.vertices(own, pose[None])[0] for pose in np.roll(poses, -index, axis=0))
        neutral = database.vertices(own)[0]
        mesh = on_the_mark(first_with_room(neutral, tried, database.faces), database.faces)
        booth = SimulatedBooth(seed=first + index, moved_cameras=moved)
        with tempfile.TemporaryDirectory() as folder:
            scan = preprocess(read_bundle(render_bundle(mesh, Path(folder) / "scan", booth)))
            with single_threaded_blas():
                fit = fit_overlapping(model, scan, "joint", lambda *_: None, unobserved)
                verdict = separate_limbs(model, fit, scan.findings, unobserved).verdict
        if verdict.status != "ok" or fit.evidence is None:
            yield None
            continue
        views = [view.calibration for view in scan.views]
        yield Evidence.from_json(fit.evidence.document(views, "2026"))


def after(
    model: BodyModel, moved: Mapping[str, Array], args: argparse.Namespace
) -> tuple[Drift | None, int]:
    """Verdict after so many accepted scans, and the number of those that were taken for them."""
    taken: list[Evidence] = []
    tried = 0
    for one in evidence(model, moved, args.first):
        tried += 1
        if one is not None:
            taken.append(one)
        if len(taken) == args.scans:
            break
    return find_drift(taken), tried


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=ENOUGH, help="accepted scans of each row")
    parser.add_argument("--first", type=int, default=9000, help="seed of the first scan")
    parser.add_argument(
        "--camera", action="append", choices=["none", *default_rig().cameras], help="only these"
    )
    args = parser.parse_args()
    model = warm_up()
    print(
        f"{'moved':<14}{'named':<14}{'mm off':>8}{'deg off':>9}{'offered':>9}{'tried':>7}"
        f"  after {args.scans} accepted scans"
    )
    for chosen in args.camera or ("none", *default_rig().cameras):
        camera = None if chosen == "none" else chosen
        drift, tried = after(
            model, {} if camera is None else {camera: bumped(SHIFT_M, TURN_RAD)}, args
        )
        named = None if drift is None else drift.camera
        offered = drift is not None and drift.confirmed
        verdict = "met" if named == camera and offered == (camera is not None) else "MISSED"
        print(
            f"{camera or 'none':<14}{named or 'none':<14}{_off(drift)}"
            f"{'yes' if offered else 'no':>9}{tried:>7}  {verdict}",
            flush=True,
        )


def _off(drift: Drift | None) -> str:
    """Difference of the named motion's size from the true one's."""
    if drift is None:
        return f"{'':>17}"
    shift_m, turn_rad = np.linalg.norm(drift.xi[3:]), np.linalg.norm(drift.xi[:3])
    return f"{1e3 * (shift_m - SHIFT_M):>8.2f}{np.degrees(turn_rad - TURN_RAD):>9.3f}"


if __name__ == "__main__":
    main()
