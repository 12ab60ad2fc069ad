"""The fit through the virtual Kinects: error, time, worst part, each bar met or missed.

    python tests/bench/bench_fit.py                          # all tables
    python tests/bench/bench_fit.py --bodies 5 --peers 0     # a quick look
    python tests/bench/bench_fit.py --pictures pictures      # and each group's worst case, drawn

Against the paper's method and trimesh's nricp_amberg from the same start on the same cloud.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from fit_cases import (
    Case,
    TestBodies,
    bad_cases,
    bad_clouds,
    family_cases,
    hard_cases,
    other_cases,
    rig_cases,
    sampled,
    unlike_cases,
)
from fit_pictures import write_error_picture
from fit_report import (
    PeerRow,
    Row,
    bars_of,
    print_header,
    print_outcome,
    print_row,
    print_summary,
    print_worst_parts,
)
from numpy.typing import NDArray
from surface_errors import surface_errors
from unlike_sensor import render_unlike

from station.core.bundle import read_bundle
from station.core.config import Volume
from station.core.errors import BoothError
from station.core.words.terms import part_in_words
from station.simulation.scene import Mesh
from station.simulation.sensor import render_bundle
from workers.cloud.observed import Preprocessed
from workers.cloud.preprocess import preprocess
from workers.reconstruct.job import reconstruct_bundle, warm_up
from workers.scape.fit.fit import fit_body, sampling_of
from workers.scape.fit.initial import starting_states
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

_SIZES = (50_000, 100_000, 200_000, 400_000, 800_000)
_THREADS = (1, 2, 4)
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
_RENDERERS = 2


def nricp(model: BodyModel, scan: Preprocessed) -> Array:
    """trimesh's non-rigid ICP (Amberg et al. 2007) from the same start on the same cloud."""
    cloud = scan.cloud
    every = slice(None, None, max(1, len(cloud) // 20_000))
    scout = sampling_of(model).body.first(250)
    few = cloud.points[:: len(cloud) // 800]
    start = model.vertices(starting_states(model, scout, few, cloud.points)[0])
    target = trimesh.PointCloud(cloud.points[every])
    source = trimesh.Trimesh(start, model.faces, process=False)
    # Each step: smoothness, landmarks, normals, and how often at most.
    moved: Array = trimesh.registration.nricp_amberg(
        source, target, distance_threshold=0.1, use_faces=False,
        steps=[[0.02, 0, 0, 5], [0.007, 0, 0, 5], [0.002, 0, 0, 5]],
    )  # fmt: skip
    return moved


def _folder(case: Case, folder: Path) -> Path:
    return folder / f"{case.group}-{case.name}"


def render(case: Case, folder: Path) -> None:
    if case.sensor is None or case.body is None:
        render_bundle(case.body, _folder(case, folder), case.booth)
    else:
        render_unlike(case.body, _folder(case, folder), case.booth, case.sensor)


def render_all(cases: Sequence[Case], folder: Path) -> None:
    """Write all bundles before anything is timed."""
    start_s = time.perf_counter()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(_RENDERERS, mp_context=context) as pool:
        for index, _ in enumerate(pool.map(render, cases, [folder] * len(cases)), start=1):
            if sys.stderr.isatty():
                print(f"\rrendering {index} of {len(cases)} ", end="", file=sys.stderr, flush=True)
    print(f"{len(cases)} bundles rendered in {time.perf_counter() - start_s:.0f} s", flush=True)


def fitted(case: Case, model: BodyModel, folder: Path) -> tuple[Row, Preprocessed]:
    """One case through the whole job, and through the fit alone."""
    assert case.body is not None
    bundle = _folder(case, folder)
    out = folder / "out" / bundle.name
    out.mkdir(parents=True)
    start_s = time.perf_counter()
    reconstruct_bundle(bundle, out, model=model)
    whole_s = time.perf_counter() - start_s
    scan = preprocess(read_bundle(bundle))
    start_s = time.perf_counter()
    fit = fit_body(model, scan)
    fit_s = time.perf_counter() - start_s
    errors = surface_errors(model, fit.vertices, fit.vertex_seen, case.body, fit.cloud.points)
    return Row(case, fit, errors, fit_s, whole_s), scan


def peers_of(row: Row, model: BodyModel, scan: Preprocessed) -> list[PeerRow]:
    """The paper's method and nricp_amberg on a cloud that was fitted already."""
    assert row.case.body is not None
    found = []
    peers: dict[str, Callable[[], Array]] = {
        "paper": lambda: fit_body(model, scan, method="paper").vertices,
        "nricp_amberg": lambda: nricp(model, scan),
    }
    for name, peer in peers.items():
        start_s = time.perf_counter()
        vertices = peer()
        took_s = time.perf_counter() - start_s
        errors = surface_errors(model, vertices, None, row.case.body)
        found.append(PeerRow(name, errors, took_s, row))
        print(
            f"{'':<7}{name:<22}{errors.body_rms:7.2f}{errors.extremity_rms:7.2f}{'':7}"
            f"{errors.height:8.1f}{took_s:7.2f}{'':9}{took_s / row.fit_s:.0f} times as long",
            flush=True,
        )
    return found


def bad_input(model: BodyModel, cases: Iterable[Case], body: Mesh, folder: Path) -> int:
    """Print the outcome of each; return how many became a confident body."""
    print("\nbad input: an error or a rescan that says why")
    confident = 0
    for case in cases:
        out = folder / "out" / _folder(case, folder).name
        out.mkdir(parents=True)
        try:
            found = reconstruct_bundle(_folder(case, folder), out, model=model)
            confident += print_outcome(case.name, found.status, found.reasons)
        except BoothError as error:
            print_outcome(case.name, "error", (str(error),))
    for name, cloud in bad_clouds(body):
        try:
            verdict = fit_body(model, Preprocessed(cloud, (), ())).verdict
            confident += print_outcome(name, verdict.status, verdict.reasons)
        except BoothError as error:
            print_outcome(name, "error", (str(error),))
    return confident


def print_sizes(model: BodyModel, body: Mesh) -> None:
    """Bare clouds of one body, all around."""
    print(f"\n{'points':>10}{'fit, s':>9}{'us a point':>12}{'body, mm':>10}")
    for count in _SIZES:
        scan = Preprocessed(sampled(body, count), (), ())
        start_s = time.perf_counter()
        fit = fit_body(model, scan)
        took_s = time.perf_counter() - start_s
        errors = surface_errors(model, fit.vertices, fit.vertex_seen, body)
        print(
            f"{count:10d}{took_s:9.2f}{1e6 * took_s / count:12.2f}{errors.body_rms:10.2f}",
            flush=True,
        )


@dataclass(frozen=True, slots=True)
class WorkerRun:
    """A job in a process of its own."""

    peak_mb: float
    mesh_sha256: str


_WORKER = """
import resource, subprocess, sys
job = [sys.executable, "-m", "workers.reconstruct.job_process"]
done = subprocess.run(job, stdout=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, done.returncode)
"""


def run_worker(bundle: Path, out: Path, threads: int | None) -> WorkerRun:
    """A worker's process from its start to its end, as the pool runs it."""
    out.mkdir(parents=True)
    order = {
        "bundle": str(bundle),
        "out": str(out),
        "method": "joint",
        "volume": Volume().model_dump(),
    }
    environment = dict(os.environ)
    if threads is not None:
        environment |= dict.fromkeys(_THREAD_VARIABLES, str(threads))
    # A small process in between: memory counts from the moment of a fork, and this one is large.
    done = subprocess.run(
        [sys.executable, "-c", _WORKER],
        input=json.dumps(order) + "\n",
        capture_output=True,
        text=True,
        env=environment,
        check=True,
    )
    peak_kb, code = done.stdout.split()
    if code != "0":
        raise RuntimeError(f"the worker process ended with {code}: {done.stderr}")
    digest = hashlib.sha256((out / "mesh.ply").read_bytes()).hexdigest()
    return WorkerRun(float(peak_kb) / 1024.0, digest)


def workers(bundle: Path, folder: Path) -> tuple[float, int]:
    """Peak memory in MB of a worker, and how many different meshes come of 1, 2 and 4 threads."""
    runs: dict[int | None, WorkerRun] = {None: run_worker(bundle, folder / "worker", None)}
    print(f"\na worker's process: peak {runs[None].peak_mb:.0f} MB")
    for threads in _THREADS:
        runs[threads] = run_worker(bundle, folder / f"worker-{threads}", threads)
        print(f"{threads} threads: mesh.ply {runs[threads].mesh_sha256[:16]}", flush=True)
    return runs[None].peak_mb, len({run.mesh_sha256 for run in runs.values()})


def draw_worst(rows: dict[str, list[Row]], model: BodyModel, folder: Path) -> None:
    for group, found in rows.items():
        row = max(found, key=lambda row: row.errors.worst_part[1])
        part, rms = row.errors.worst_part
        assert row.case.body is not None
        title = (
            f"{group} {row.case.name}: {part_in_words(part)} {rms:.1f} mm rms; red: 10 mm off; "
            "below: the result"
        )
        path = folder / f"worst-{group}.png"
        write_error_picture(path, title, row.fit.vertices, model.faces, row.case.body)
        print(path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bodies", type=int, default=30, help="of the training family, 1 to 30")
    parser.add_argument("--unlike", type=int, default=20, help="sculpted test bodies, at most 40")
    parser.add_argument("--peers", type=int, default=2, help="cases to run the other methods on")
    parser.add_argument("--other-bodies", type=Path, help="folder of .npz of other families")
    parser.add_argument(
        "--only", nargs="+", metavar="GROUP", help="family, unlike, other, hard, rig, bad"
    )
    parser.add_argument("--pictures", type=Path, help="draw each group's worst case into a folder")
    arguments = parser.parse_args()
    model = warm_up()
    bodies = TestBodies()
    first = bodies.body(0)
    cases = [*family_cases(bodies, max(1, arguments.bodies))]
    cases += unlike_cases(model, arguments.unlike)
    if arguments.other_bodies:
        cases += other_cases(arguments.other_bodies)
    cases += [*hard_cases(bodies), *rig_cases(first), *bad_cases(first)]
    if arguments.only:
        cases = [
            case for index, case in enumerate(cases) if not index or case.group in arguments.only
        ]
    rows: dict[str, list[Row]] = {}
    peers: list[PeerRow] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        render_all(cases, folder)
        print_header()
        for index, case in enumerate(case for case in cases if case.group != "bad"):
            row, scan = fitted(case, model, folder)
            rows.setdefault(case.group, []).append(row)
            print_row(row)
            if index < arguments.peers:
                peers += peers_of(row, model, scan)
        print_summary(rows)
        print_worst_parts(rows)
        confident = bad_input(model, (case for case in cases if case.group == "bad"), first, folder)
        print_sizes(model, first)
        peak_mb, meshes = workers(_folder(cases[0], folder), folder)
    print()
    for bar in bars_of(rows, peers, confident, peak_mb, meshes):
        print(bar.line())
    if arguments.pictures:
        draw_worst(rows, model, arguments.pictures)


if __name__ == "__main__":
    main()
