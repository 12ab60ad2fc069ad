"""Sensors that are silent, slow, frozen, stuck, unplugged, swapped, or whose clocks err."""

from __future__ import annotations

import random
import tempfile
import threading
import time
import zlib
from functools import partial
from itertools import pairwise
from pathlib import Path

from booth import Booth, Scans, running_booth, until
from table import Row

from station.core.bundle import read_bundle

_NAMED_S, _AGAIN_S = 2.0, 10.0
_FAULTS = ("silent", "half", "frozen", "stuck", "unplugged", "swapped")
_CLOCKS = ("drift 500", "drift -500", "reset")
_WATCHED_S = 2.0
_REPORTED_S = 0.6
"""Delay after which sync's reports hold no count from before the fault."""


def sensor_rows(rounds: int, seed: int) -> list[Row]:
    """Each fault so many times, on random cameras; then in the middle of scans."""
    rng = random.Random(seed)
    with (
        tempfile.TemporaryDirectory() as name,
        running_booth(Path(name), job="quick") as (booth, scans),
    ):
        rows = [_fault(booth, scans, fault, rounds, rng) for fault in _FAULTS]
        rows.append(_within_scans(booth, scans, 4 * rounds, rng))
        rows += [_clock(booth, scans, fault, rng) for fault in _CLOCKS]
        scans.settle()
        rows.append(scans.row("scans before, while and after sensors err"))
    return rows


def _order(booth: Booth, camera: str, fault: str) -> None:
    """A swapped sensor is unplugged first, and another one takes its place."""
    if fault == "swapped":
        booth.order_sensor(camera, "unplugged")
        until(partial(_in_state, booth, camera, "lost"))
        fault = "swapped V00009999"
    booth.order_sensor(camera, fault)


def _in_state(booth: Booth, camera: str, state: str) -> bool:
    return bool(booth.report(f"capture {camera}").get("state") == state)


def _named(booth: Booth, camera: str) -> bool:
    return any(camera in problem for problem in booth.problems())


def _mend(booth: Booth, camera: str, fault: str) -> float:
    """End a fault; seconds until frames come and nothing is wrong."""
    if fault == "swapped":
        booth.order_sensor(camera, "unplugged")
        until(partial(_in_state, booth, camera, "lost"))
    booth.order_sensor(camera, "")
    before = booth.framesets()
    return until(lambda: booth.well() and booth.framesets() > before)


def _fault(booth: Booth, scans: Scans, fault: str, rounds: int, rng: random.Random) -> Row:
    named_s, again_s, used, taken = list[float](), list[float](), 0, 0
    for _ in range(rounds):
        camera = rng.choice(booth.cameras)
        booth.wait(booth.well, f"the booth is whole before a sensor is {fault}")
        _order(booth, camera, fault)
        if fault == "swapped":
            until(partial(_in_state, booth, camera, "streaming"))
        named_s.append(until(partial(_named, booth, camera)))
        time.sleep(_REPORTED_S)
        before = booth.framesets()
        scan_id = scans.take()
        taken += scans.accepted(scan_id) or camera not in scans.told[scan_id][1]
        time.sleep(_WATCHED_S)
        # The frames of a swapped sensor are whole; it is the scan that is refused.
        used += 0 if fault == "swapped" else booth.framesets() - before
        again_s.append(_mend(booth, camera, fault))
    return Row(
        f"a sensor that is {fault}, {rounds} times",
        f"named in {_NAMED_S:g} s, in no set, again in {_AGAIN_S:g} s",
        f"named {max(named_s):.1f} s, {used} sets, {taken} scans taken, again {max(again_s):.1f} s",
        max(named_s) <= _NAMED_S and not used and not taken and max(again_s) <= _AGAIN_S,
        timed=True,
    )


def _within_scans(booth: Booth, scans: Scans, count: int, rng: random.Random) -> Row:
    """A sensor that freezes, sticks or goes silent while a scan is taken."""
    wrong = accepted = 0
    for _ in range(count):
        camera, fault = rng.choice(booth.cameras), rng.choice(("frozen", "stuck", "silent"))
        booth.wait(booth.well, f"the booth is whole before a sensor is {fault}")
        found: list[str] = []
        taking = threading.Thread(target=lambda found=found: found.append(scans.take()))
        taking.start()
        time.sleep(rng.uniform(0.0, 0.7))
        booth.order_sensor(camera, fault)
        taking.join()
        booth.order_sensor(camera, "")
        if scans.accepted(found[0]):
            accepted += 1
            scans.settle()
            wrong += _repeats(booth.spool / "done" / found[0])
    return Row(
        f"sensors that err within a scan, {count} times",
        "no frame twice in an accepted scan",
        f"{accepted} accepted, {wrong} with a frame twice",
        wrong == 0,
    )


def _repeats(folder: Path) -> bool:
    """Whether a bundle holds a picture, or a stamp, twice in a row."""
    bundle = read_bundle(folder)
    for camera, frames in bundle.frames.items():
        pictures = [zlib.crc32(bundle.read_frame(camera, frame).tobytes()) for frame in frames]
        stamps = [frame.device_ticks for frame in frames]
        if any(a == b for a, b in (*pairwise(pictures), *pairwise(stamps))):
            return True
    return False


def _clock(booth: Booth, scans: Scans, fault: str, rng: random.Random) -> Row:
    """Device clocks that run wrong from now on, or start over; each wraps at its opening, too."""
    cameras = rng.sample(booth.cameras, 2)
    booth.wait(booth.well, "the booth is whole before a clock errs")
    for camera in cameras:
        booth.order_sensor(camera, fault)
    before = booth.framesets()
    back_s = until(lambda: booth.framesets() > before + 30)
    good = [scans.accepted(scans.take()) for _ in range(5)]
    for camera in cameras:
        booth.order_sensor(camera, "")
    return Row(
        f"two device clocks: {fault}",
        f"sets again in {_AGAIN_S:g} s, scans taken",
        f"30 sets after {back_s:.1f} s, {sum(good)} of {len(good)} scans",
        back_s <= _AGAIN_S and all(good),
    )
