"""`make test-faults`, `make soak`: inject faults, print the table, end with 1 if one is missed."""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from booth import Booth, Scans, whole_booth
from clocks import property_rows
from disk import disk_rows
from fuzz import intake_rows, message_rows
from fuzz_files import file_rows
from jobs import job_rows
from kills import kill_rows
from purge import purge_rows
from scarcity import scarcity_rows
from sensors import sensor_rows
from soak import soak_rows
from station_disk import errno_rows, small_disk_rows, stall_rows
from stops import stop_rows
from table import Row
from wall_clock import wall_clock_rows

BODY = Path(__file__).parents[3] / "station/simulation/bodies/ann.npz"


@dataclass(frozen=True, slots=True)
class Extent:
    """Extent of the table."""

    long: bool
    seed: int
    scans: int
    """Scans of the soak."""
    kills: int
    quick: bool
    """The soak's jobs only read the bundle: the processes that live on do the same."""


PARTS: dict[str, Callable[[Extent], list[Row]]] = {
    "disk": lambda e: disk_rows(every=1 if e.long else 60, real=e.long),
    "messages": lambda e: message_rows(1_000_000 if e.long else 10_000, e.seed),
    "intake": lambda e: intake_rows(50_000 if e.long else 2_000, e.seed),
    "files": lambda e: _fuzzed_files(100_000 if e.long else 300, e.seed),
    "clocks": lambda e: property_rows(10_000 if e.long else 200, e.seed),
    "kills": lambda e: _on_a_booth(lambda b, s: kill_rows(b, s, e.kills, e.seed)),
    "stops": lambda _: _on_a_booth(stop_rows),
    "kills-and-stops": lambda e: _on_a_booth(
        lambda b, s: [*stop_rows(b, s, ("sync",)), *kill_rows(b, s, 2, e.seed)], job="quick"
    ),
    "sensors": lambda e: sensor_rows(5, e.seed),
    "wall-clock": lambda _: wall_clock_rows(),
    "jobs": lambda _: job_rows(),
    "purge": lambda _: purge_rows(),
    "small-disk": lambda _: small_disk_rows(),
    "stalls": lambda e: stall_rows(80, e.seed),
    "errnos": lambda _: errno_rows(),
    "scarcity": lambda _: scarcity_rows(),
    "soak": lambda e: soak_rows(e.scans, "quick" if e.quick else ""),
}
SHORT = ("kills-and-stops", "disk", "files", "messages", "intake", "clocks")
LONG = tuple(part for part in PARTS if part != "kills-and-stops")
_SIDE_BY_SIDE = 3
"""Parts of the short form at a time: one of them waits most of its time for a booth."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true", help="as many as the demands say; hours")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=PARTS, help="these parts of the table alone")
    parser.add_argument("--scans", type=int, default=1440, help="of the soak")
    parser.add_argument("--kills", type=int, default=200, help="of the long form")
    parser.add_argument("--quick", action="store_true", help="a soak whose jobs fit no body")
    arguments = parser.parse_args()
    extent = Extent(
        arguments.long, arguments.seed, arguments.scans, arguments.kills, arguments.quick
    )
    rows: list[Row] = []
    # Limits in seconds are those of a machine that does nothing else.
    workers = 1 if extent.long else _SIDE_BY_SIDE
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        parts = arguments.only or (LONG if extent.long else SHORT)
        for done in [pool.submit(_part, part, extent) for part in parts]:
            rows.extend(done.result())
    missed = [row for row in rows if not row.met]
    print(f"{len(rows) - len(missed)} met, {len(missed)} missed")
    return 1 if any(extent.long or not row.timed for row in missed) else 0


def _part(name: str, extent: Extent) -> list[Row]:
    """A part of the table, printed when it is done."""
    began_s = time.monotonic()
    rows = PARTS[name](extent)
    lines = [*map(str, rows), f"        ({name}: {time.monotonic() - began_s:.0f} s)"]
    print("\n".join(lines), flush=True)
    return rows


def _on_a_booth(rows: Callable[[Booth, Scans], list[Row]], job: str = "") -> list[Row]:
    with (
        tempfile.TemporaryDirectory() as name,
        whole_booth(Path(name), job=job) as (booth, scans),
    ):
        return rows(booth, scans)


def _fuzzed_files(count: int, seed: int) -> list[Row]:
    from station.simulation.scene import load_mesh
    from station.simulation.sensor import render_bundle

    with tempfile.TemporaryDirectory() as name:
        bundle = render_bundle(load_mesh(BODY), Path(name) / "scan", frames=2)
        return file_rows(bundle, count, seed)


if __name__ == "__main__":
    sys.exit(main())
