"""The fit on held-out bodies through the virtual Kinects: error, time, worst part; against the
paper's method and trimesh's nricp_amberg from the same start on the same cloud."""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from station.bundle import read_bundle
from station.depth import Preprocessed, preprocess
from station.drivers.virtual import SimulatedBooth, render_bundle
from station.drivers.virtual_scene import Mesh, chair
from station.geometry import so3_exp
from workers.job import reconstruct_bundle, warm_up
from workers.scape.database import BodyDatabase
from workers.scape.fit import fit_body, sampling_of
from workers.scape.initial import starting_states
from workers.scape.model import BodyModel

Array = NDArray[np.float64]

_EXTREMITIES = ("hand", "thumb", "fingers", "foot")


@dataclass(frozen=True, slots=True)
class Case:
    """One body in one booth."""

    group: str
    name: str
    body: Mesh
    booth: SimulatedBooth


def family_cases(count: int) -> Iterator[Case]:
    """Held-out bodies of the training family in held-out poses."""
    database = BodyDatabase()
    shapes = database.sample("test", count, 11)
    for index, vertices in enumerate(
        database.vertices(shapes, database.sample_poses("test", count, 11))
    ):
        centered = vertices - np.append(np.ptp(vertices, axis=0)[:2] / 2 + vertices.min(0)[:2], 0)
        yield Case(
            "family", f"test {index:02d}", Mesh(centered, database.faces),
            SimulatedBooth(seed=index, sway_m=0.0),
        )  # fmt: skip


def other_cases(folder: Path) -> Iterator[Case]:
    """Bodies of other families, each straight, shifted and turned."""
    for path in sorted(folder.glob("*.npz")):
        data = np.load(path)
        for name, turn_deg, shift in (
            ("straight", 0.0, (0.0, 0.0, 0.0)),
            ("shifted", 0.0, (0.2, 0.05, 0.0)),
            ("turned", 25.0, (0.0, 0.0, 0.0)),
        ):
            vertices = data["vertices"] @ so3_exp([0, 0, np.radians(turn_deg)]).T + shift
            yield Case(
                "other", f"{path.stem} {name}", Mesh(vertices, data["faces"].astype(np.int32)),
                SimulatedBooth(seed=3, sway_m=0.0),
            )  # fmt: skip


def hard_cases(body: Mesh) -> Iterator[Case]:
    """What goes wrong in a shop."""
    size = body.vertices * (1.45 / np.ptp(body.vertices[:, 2]))
    tall = body.vertices * (2.05 / np.ptp(body.vertices[:, 2]))
    low, high = np.quantile(body.vertices[body.faces].mean(axis=1)[:, 2], [0.42, 0.52])
    middle = body.vertices[body.faces].mean(axis=1)[:, 2]
    dark = (middle > 0.97 * body.vertices[:, 2].max()) | ((middle > low) & (middle < high))
    for name, mesh, booth in (
        ("a fifth dropped", body, SimulatedBooth(seed=5, drop_rate=0.2)),
        ("camera 5 mm off", body, SimulatedBooth(seed=5, moved_cameras={"back-upper": (0.005, 0)})),
        (
            "camera 0.3 deg off", body,
            SimulatedBooth(seed=5, moved_cameras={"back-lower": (0.0, np.radians(0.3))}),
        ),
        ("dark hair and briefs", Mesh(body.vertices, body.faces, dark), SimulatedBooth(seed=5)),
        ("sway 10 mm", body, SimulatedBooth(seed=5, sway_m=0.01)),
        ("chair in view", body, SimulatedBooth(seed=5, clutter=chair((0.75, 0.45)))),
        ("1.45 m", Mesh(size, body.faces), SimulatedBooth(seed=5)),
        ("2.05 m", Mesh(tall, body.faces), SimulatedBooth(seed=5)),
    ):  # fmt: skip
        yield Case("hard", name, mesh, booth)


@dataclass(frozen=True, slots=True)
class Errors:
    """Distances of the true surface from a result, mm."""

    trunk_rms: float
    extremity_rms: float
    worst_part: str


def errors(model: BodyModel, vertices: Array, faces: NDArray[np.int32], truth: Mesh) -> Errors:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    away = scene.compute_distance(o3d.core.Tensor(truth.vertices.astype(np.float32))).numpy()
    part = model.part_of_vertex[cKDTree(vertices).query(truth.vertices)[1]]
    names = np.array(model.part_names)[part]
    extremity = np.array([name.startswith(_EXTREMITIES) for name in names])
    by_part = {n: 1e3 * np.sqrt(np.mean(away[names == n] ** 2)) for n in np.unique(names)}
    worst = max(by_part, key=by_part.__getitem__)
    return Errors(
        1e3 * float(np.sqrt(np.mean(away[~extremity] ** 2))),
        1e3 * float(np.sqrt(np.mean(away[extremity] ** 2))),
        f"{worst} {by_part[worst]:.1f}",
    )


def nricp(model: BodyModel, scan: Preprocessed) -> Array:
    """trimesh's non-rigid ICP (Amberg et al. 2007) from the same start on the same cloud."""
    cloud = scan.cloud
    every = slice(None, None, max(1, len(cloud) // 20_000))
    scout, _ = sampling_of(model).stage(250)
    start = model.vertices(starting_states(model, scout, cloud.points[:: len(cloud) // 800])[0])
    target = trimesh.PointCloud(cloud.points[every])
    source = trimesh.Trimesh(start, model.faces, process=False)
    moved: Array = trimesh.registration.nricp_amberg(
        source, target, distance_threshold=0.1, use_faces=False,
        steps=[[0.02, 0, 0, 5], [0.007, 0, 0, 5], [0.002, 0, 0, 5]],
    )  # fmt: skip
    return moved


def run(case: Case, model: BodyModel, folder: Path, peers: bool) -> dict[str, float]:
    """One row of the table."""
    bundle = render_bundle(case.body, folder / f"{case.group}-{case.name}", case.booth)
    out = folder / f"{case.group}-{case.name}-out"
    out.mkdir()
    start_s = time.perf_counter()
    reconstruct_bundle(bundle, out, model=model)
    whole_s = time.perf_counter() - start_s
    scan = preprocess(read_bundle(bundle))
    start_s = time.perf_counter()
    fit = fit_body(model, scan)
    fit_s = time.perf_counter() - start_s
    found = errors(model, fit.vertices, model.faces, case.body)
    tall_mm = 1e3 * (np.ptp(fit.vertices[:, 2]) - np.ptp(case.body.vertices[:, 2]))
    print(
        f"{case.group:<7}{case.name:<22}{found.trunk_rms:7.2f}{found.extremity_rms:7.2f}"
        f"{tall_mm:8.1f}{fit_s:7.2f}{whole_s:7.2f}  {fit.verdict.status:<7}{found.worst_part}"
        f"  {'; '.join(fit.verdict.reasons)}",
        flush=True,
    )
    row = {"trunk": found.trunk_rms, "hands": found.extremity_rms, "height": abs(tall_mm),
           "fit_s": fit_s, "whole_s": whole_s}  # fmt: skip
    if peers:
        for name, peer in (
            ("paper", lambda: fit_body(model, scan, method="paper").vertices),
            ("nricp_amberg", lambda: nricp(model, scan)),
        ):
            start_s = time.perf_counter()
            theirs = errors(model, peer(), model.faces, case.body)
            took_s = time.perf_counter() - start_s
            print(
                f"       {name:<22}{theirs.trunk_rms:7.2f}{theirs.extremity_rms:7.2f}{'':8}"
                f"{took_s:7.2f}  {took_s / fit_s:.0f} times as long",
                flush=True,
            )
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bodies", type=int, default=30, help="of the training family")
    parser.add_argument("--peers", type=int, default=2, help="cases to run the other methods on")
    parser.add_argument("--other-bodies", type=Path, help="folder of .npz of other families")
    arguments = parser.parse_args()
    model = warm_up()
    cases = list(family_cases(arguments.bodies))
    body = cases[0].body
    if arguments.other_bodies:
        cases += other_cases(arguments.other_bodies)
    cases += hard_cases(body)
    print("errors in mm rms of the true surface; height in mm; times in s")
    print(f"{'group':<7}{'case':<22}{'trunk':>7}{'hands':>7}{'height':>8}{'fit':>7}{'whole':>7}")
    rows: dict[str, list[dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as name:
        for index, case in enumerate(cases):
            row = run(case, model, Path(name), index < arguments.peers)
            rows.setdefault(case.group, []).append(row)
    print(f"\n{'':<24}{'mean':>8}{'p95':>8}{'worst':>8}")
    for group, found in rows.items():
        for key in found[0]:
            values = np.array([row[key] for row in found])
            print(
                f"{group:<10}{key:<14}{values.mean():8.2f}{np.quantile(values, 0.95):8.2f}"
                f"{values.max():8.2f}"
            )


if __name__ == "__main__":
    main()
