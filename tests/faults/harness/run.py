"""`make test-faults`, `make soak`: inject faults, print the table, end with 1 if one is missed."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from clocks import property_rows
from disk import disk_rows
from fuzz import intake_rows, message_rows
from fuzz_files import file_rows
from processes import (
    full_disk_rows,
    job_rows,
    kill_rows,
    make_booth,
    memory_slopes,
    stop_rows,
)
from running_station import STATION, Station
from table import Row

BODY = Path(__file__).parents[3] / "station/simulation/bodies/ann.npz"
_STOPPED = ("sync", "control", "capture back-lower", "workers")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true", help="as many as the demands say; hours")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kills", type=int, help="kill -9 so many times")
    parser.add_argument(
        "--only",
        choices=["disk", "fuzz", "clocks", "processes"],
        help="this part of the table alone",
    )
    parser.add_argument("--minutes", type=float, default=0.0, help="of soaking, after the faults")
    arguments = parser.parse_args()
    long = arguments.long
    rows: list[Row] = []

    def show(part: str, found: Callable[[], list[Row]]) -> None:
        began_s = time.monotonic()
        new = found()
        rows.extend(new)
        for row in new:
            print(row, flush=True)
        print(f"        ({part}: {time.monotonic() - began_s:.0f} s)", flush=True)

    if arguments.only in (None, "disk"):
        show("disk", lambda: disk_rows(every=1 if long else 25, real=long))
    if arguments.only in (None, "fuzz"):
        count = 1_000_000 if long else 10_000
        show("messages", lambda: message_rows(count, arguments.seed))
        show("intake", lambda: intake_rows(50_000 if long else 2_000, arguments.seed))
        show("files", lambda: _fuzzed_files(100_000 if long else 300, arguments.seed))
    if arguments.only in (None, "clocks"):
        count = 10_000 if long else 200
        show("clocks", lambda: property_rows(count, arguments.seed))
    if arguments.only in (None, "processes"):
        with _station() as station:
            kills = arguments.kills or (200 if long else 2)
            show("kills", lambda: kill_rows(station, kills, arguments.seed))
            show("stops", lambda: stop_rows(station, list(_STOPPED if long else _STOPPED[:1])))
            if long:
                show("jobs", lambda: job_rows(station))
                show("disk full", lambda: full_disk_rows(station))
            if arguments.minutes:
                show("soak", lambda: memory_slopes(station, 60.0 * arguments.minutes))
    missed = [row for row in rows if not row.met]
    print(f"{len(rows) - len(missed)} met, {len(missed)} missed")
    return 1 if any(long or not row.timed for row in missed) else 0


def _fuzzed_files(count: int, seed: int) -> list[Row]:
    from station.simulation.scene import load_mesh
    from station.simulation.sensor import render_bundle

    with tempfile.TemporaryDirectory() as name:
        bundle = render_bundle(load_mesh(BODY), Path(name) / "scan", frames=2)
        return file_rows(bundle, count, seed)


@contextmanager
def _station() -> Iterator[Station]:
    with tempfile.TemporaryDirectory() as name:
        station = Station(make_booth(Path(name), STATION, BODY))
        try:
            station.command("start")
            yield station
        finally:
            station.close()


if __name__ == "__main__":
    sys.exit(main())
