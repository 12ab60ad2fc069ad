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
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
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
)
from fit_pictures import write_error_picture
from numpy.typing import NDArray
from surface_errors import SurfaceErrors, surface_errors

from station.bundle import read_bundle
from station.depth import Preprocessed, Volume, preprocess
from station.drivers.virtual import render_bundle
from station.drivers.virtual_scene import Mesh
from station.errors import BoothError
from workers.job import reconstruct_bundle, warm_up
from workers.scape.fit import FitResult, fit_body, sampling_of
from workers.scape.initial import starting_states
from workers.scape.model import BodyModel

Array = NDArray[np.float64]

_LOST_MM = 15.0
_PAPERS_SECONDS = 60.0
_SIZES = (50_000, 100_000, 200_000, 400_000, 800_000)
_THREADS = (1, 2, 4)
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
_RENDERERS = 2


@dataclass(frozen=True, slots=True)
class Row:
    """One case, fitted."""

    case: Case
    fit: FitResult
    errors: SurfaceErrors
    fit_s: float
    whole_s: float
    """From the bundle on disk to the files written."""

    @property
    def lost_unnamed(self) -> list[str]:
        """Parts that are lost without a word to the operator."""
        verdict = self.fit.verdict
        lost = [name for name, rms in self.errors.by_part.items() if rms > _LOST_MM]
        return [
            name
            for name in lost
            if verdict.status != "rescan"
            or not any(_words(name) in reason for reason in verdict.reasons)
        ]


@dataclass(frozen=True, slots=True)
class PeerRow:
    """Another method on the same cloud."""

    name: str
    errors: SurfaceErrors
    seconds: float
    ours: Row


@dataclass(frozen=True, slots=True)
class Bar:
    """What the product promises."""

    words: str
    value: float | None
    """None: nothing was measured."""
    limit: float
    unit: str = "mm"
    at_least: bool = False

    def line(self) -> str:
        if self.value is None or not np.isfinite(self.value):
            return f"{self.words:<58}{'':>10} not measured"
        met = self.value >= self.limit if self.at_least else self.value <= self.limit
        sign = ">=" if self.at_least else "<="
        shown = f"{self.value:10.2f} {sign} {self.limit:g} {self.unit}"
        return f"{self.words:<58}{shown:<28}{'met' if met else 'MISSED'}"


def _words(part: str) -> str:
    """As the operator reads it."""
    stem, _, side = part.rpartition("_")
    return f"{side} {stem.replace('_', ' ')}" if side in ("left", "right") else part


def nricp(model: BodyModel, scan: Preprocessed) -> Array:
    """trimesh's non-rigid ICP (Amberg et al. 2007) from the same start on the same cloud."""
    cloud = scan.cloud
    every = slice(None, None, max(1, len(cloud) // 20_000))
    scout = sampling_of(model).body.first(250)
    start = model.vertices(starting_states(model, scout, cloud.points[:: len(cloud) // 800])[0])
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


def _render(case: Case, folder: Path) -> None:
    render_bundle(case.body, _folder(case, folder), case.booth)


def render_all(cases: Sequence[Case], folder: Path) -> None:
    """Write all bundles before anything is timed."""
    start_s = time.perf_counter()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(_RENDERERS, mp_context=context) as pool:
        for index, _ in enumerate(pool.map(_render, cases, [folder] * len(cases)), start=1):
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
    errors = surface_errors(model, fit.vertices, fit.vertex_seen, case.body)
    return Row(case, fit, errors, fit_s, whole_s), scan


def print_header() -> None:
    print(
        "\nDistances of the true surface from the result, weighted by area: rms of trunk, limbs and"
        "\nhead; rms of hands and feet; median of the former where a camera saw the surface."
        "\nmm; height: error in mm; times in s\n"
    )
    print(
        f"{'group':<7}{'case':<22}{'body':>7}{'hands':>7}{'seen':>7}{'height':>8}{'fit':>7}"
        f"{'whole':>7}  {'status':<7}worst part"
    )


def print_row(row: Row) -> None:
    errors, verdict = row.errors, row.fit.verdict
    part, rms = errors.worst_part
    print(
        f"{row.case.group:<7}{row.case.name:<22}{errors.body_rms:7.2f}{errors.extremity_rms:7.2f}"
        f"{errors.seen_median:7.2f}{errors.height:8.1f}{row.fit_s:7.2f}{row.whole_s:7.2f}"
        f"  {verdict.status:<7}{_words(part)} {rms:.1f}",
        flush=True,
    )
    for reason in verdict.reasons:
        print(f"{'':<31}{reason}")


def peers_of(row: Row, model: BodyModel, scan: Preprocessed) -> list[PeerRow]:
    """The paper's method and nricp_amberg on a cloud that was fitted already."""
    assert row.case.body is not None
    found = []
    for name, peer in (
        ("paper", lambda: fit_body(model, scan, method="paper").vertices),
        ("nricp_amberg", lambda: nricp(model, scan)),
    ):
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


def print_summary(rows: dict[str, list[Row]]) -> None:
    print(f"\n{'':<24}{'mean':>8}{'p95':>8}{'worst':>8}")
    for group, found in rows.items():
        for words, values in (
            ("body, mm", [row.errors.body_rms for row in found]),
            ("hands, feet, mm", [row.errors.extremity_rms for row in found]),
            ("seen, mm", [row.errors.seen_median for row in found]),
            ("height, mm", [abs(row.errors.height) for row in found]),
            ("fit, s", [row.fit_s for row in found]),
            ("whole, s", [row.whole_s for row in found]),
        ):
            print(
                f"{group:<8}{words:<16}{np.mean(values):8.2f}{np.quantile(values, 0.95):8.2f}"
                f"{np.max(values):8.2f}"
            )


def print_worst_parts(rows: dict[str, list[Row]]) -> None:
    """Where errors sit: each part's rms over a group's cases, and the case where it is worst."""
    print("\nworst parts, rms in mm over the group's cases, and in which case it is worst")
    for group, found in rows.items():
        names = sorted({name for row in found for name in row.errors.by_part})
        table = {
            name: [row.errors.by_part.get(name, 0.0) for row in found] for name in names
        }  # fmt: skip
        order = sorted(names, key=lambda name: -float(np.mean(np.square(table[name]))))
        for name in order[:4]:
            worst = int(np.argmax(table[name]))
            print(
                f"{group:<8}{_words(name):<20}{np.sqrt(np.mean(np.square(table[name]))):7.2f}"
                f"{table[name][worst]:8.2f}  {found[worst].case.name}"
            )


def bad_input(model: BodyModel, cases: Iterable[Case], body: Mesh, folder: Path) -> int:
    """What becomes of each; returns how many became a confident body."""
    print("\nbad input: an error or a rescan that says why")
    confident = 0
    for case in cases:
        out = folder / "out" / _folder(case, folder).name
        out.mkdir(parents=True)
        try:
            found = reconstruct_bundle(_folder(case, folder), out, model=model)
            confident += _print_outcome(case.name, found.status, found.reasons)
        except BoothError as error:
            _print_outcome(case.name, "error", (str(error),))
    for name, cloud in bad_clouds(body):
        try:
            verdict = fit_body(model, Preprocessed(cloud, (), ())).verdict
            confident += _print_outcome(name, verdict.status, verdict.reasons)
        except BoothError as error:
            _print_outcome(name, "error", (str(error),))
    return confident


def _print_outcome(name: str, status: str, reasons: Sequence[str]) -> bool:
    print(f"{name:<22}{status:<8}{reasons[0] if reasons else ''}", flush=True)
    for reason in reasons[1:3]:
        print(f"{'':<30}{reason}")
    if len(reasons) > 3:
        print(f"{'':<30}and {len(reasons) - 3} more")
    return status == "ok"


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
done = subprocess.run([sys.executable, "-m", "workers.job_process"], stdout=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, done.returncode)
"""


def run_worker(bundle: Path, out: Path, threads: int | None) -> WorkerRun:
    """A worker's process from its start to its end, as the pool runs it."""
    out.mkdir(parents=True)
    order = {"bundle": str(bundle), "out": str(out), "method": "joint", "volume": asdict(Volume())}
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
    runs = {None: run_worker(bundle, folder / "worker", None)}
    print(f"\na worker's process: peak {runs[None].peak_mb:.0f} MB")
    for threads in _THREADS:
        runs[threads] = run_worker(bundle, folder / f"worker-{threads}", threads)
        print(f"{threads} threads: mesh.ply {runs[threads].mesh_sha256[:16]}", flush=True)
    return runs[None].peak_mb, len({run.mesh_sha256 for run in runs.values()})


def bars_of(
    rows: dict[str, list[Row]],
    peers: Sequence[PeerRow],
    confident: int,
    peak_mb: float,
    meshes: int,
) -> list[Bar]:
    """Everything that the product promises of its fit."""
    family, other = rows.get("family", []), rows.get("other", [])
    hard, plain = rows.get("hard", []), [*family, *other]
    timed = [*plain, *hard]

    def mean(values: Sequence[float]) -> float | None:
        return float(np.mean(values)) if values else None

    def most(values: Sequence[float]) -> float | None:
        return max(values, default=None)

    def share(values: Sequence[float], level: float) -> float | None:
        return float(np.quantile(values, level)) if values else None

    seen = [row.errors.seen_median for row in plain]
    median_s = share([row.whole_s for row in timed], 0.5)
    bars = [
        Bar("training family: mean rms", mean([row.errors.body_rms for row in family]), 2.0),
        Bar("training family: worst body's rms", most([r.errors.body_rms for r in family]), 3.5),
        Bar("training family: hands and feet, mean rms",
            mean([row.errors.extremity_rms for row in family]), 5.0),
        Bar("training family: hands and feet, worst body's rms",
            most([row.errors.extremity_rms for row in family]), 5.0),
        Bar("training family: height, worst", most([abs(r.errors.height) for r in family]), 4.0),
        Bar("other bodies: mean rms", mean([row.errors.body_rms for row in other]), 2.5),
        Bar("other bodies: worst rms", most([row.errors.body_rms for row in other]), 4.0),
        Bar("where a camera saw the surface: mean body's median", mean(seen), 1.0),
        Bar("where a camera saw the surface: worst body's median", most(seen), 1.0),
        Bar("hard set: parts lost (over 15 mm rms) and not named",
            float(sum(len(row.lost_unnamed) for row in hard)) if hard else None, 0.0, ""),
        Bar("all sets: parts lost and not named",
            float(sum(len(row.lost_unnamed) for row in timed)) if timed else None, 0.0, ""),
        Bar("plain cases: false rescans",
            float(sum(row.fit.verdict.status != "ok" for row in plain)) if plain else None, 0.0,
            ""),
        Bar("bad input: confident bodies", float(confident), 0.0, ""),
        Bar("time, bundle to files: median", median_s, 1.0, "s"),
        Bar("time, bundle to files: p95", share([row.whole_s for row in timed], 0.95), 1.5, "s"),
        Bar("time, the fit itself: median", share([row.fit_s for row in timed], 0.5), 0.6, "s"),
        Bar("times faster than the paper's 60 s",
            _PAPERS_SECONDS / median_s if median_s else None, 40.0, "", at_least=True),
        Bar("memory of a worker", peak_mb, 800.0, "MB"),
        Bar("different meshes from 1, 2 and 4 threads", float(meshes), 1.0, ""),
    ]  # fmt: skip
    for name in sorted({peer.name for peer in peers}):
        theirs = [peer for peer in peers if peer.name == name]
        faster = min(peer.seconds / peer.ours.fit_s for peer in theirs)
        better = min(peer.errors.body_rms / peer.ours.errors.body_rms for peer in theirs)
        bars.append(Bar(f"{name}: times as long, at least", faster, 1.0, "", at_least=True))
        bars.append(Bar(f"{name}: times the error, at least", better, 1.0, "", at_least=True))
    return bars


def draw_worst(rows: dict[str, list[Row]], model: BodyModel, folder: Path) -> None:
    for group, found in rows.items():
        row = max(found, key=lambda row: row.errors.worst_part[1])
        part, rms = row.errors.worst_part
        assert row.case.body is not None
        title = (
            f"{group} {row.case.name}: {_words(part)} {rms:.1f} mm rms; red: 10 mm off; "
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
    parser.add_argument("--peers", type=int, default=2, help="cases to run the other methods on")
    parser.add_argument("--other-bodies", type=Path, help="folder of .npz of other families")
    parser.add_argument("--only", nargs="+", metavar="GROUP", help="family, other, hard, rig, bad")
    parser.add_argument("--pictures", type=Path, help="draw each group's worst case into a folder")
    arguments = parser.parse_args()
    model = warm_up()
    bodies = TestBodies()
    first = bodies.body(0)
    cases = [*family_cases(bodies, max(1, arguments.bodies))]
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
