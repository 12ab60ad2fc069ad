"""Does every scan notice a camera that moved, tell how, and leave those alone that did not?

Booths, sensors, people and clutter are those of `drift_world`: none errs as the check assumes.
Every scan is rendered and drawn anew. Cameras stand still, moved within the tolerance, by exactly
the limit, or by up to 20 mm and 1 degree in random directions. A scan is refused by the rule of
`DriftWatch`: after an alarm that waits for confirmation, another scan is taken on the same day.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from drift_world import (
    CHECK_FRAMES,
    ROOMS,
    SCAN_FRAMES,
    SCENES,
    Array,
    DriftBooth,
    Scene,
    direction,
    random_move,
)
from moves import move_in
from numpy.typing import NDArray
from scipy.stats import beta, chi2

from station.calibration.drift.watch import Doubts
from station.calibration.moves.motion import (
    LEVER_M,
    MOVED_M,
    MOVED_RAD,
    QUIET_M,
    QUIET_RAD,
    CameraMove,
)
from station.calibration.moves.reference import DriftReference

FALSE_ALARMS_BAR, COVERAGE_BAR = 1e-3, 0.95
SCALE = np.array([LEVER_M] * 3 + [1.0] * 3)
_AGAIN = 5_000
_BLIND_M = 0.02
"""A wall hides shifts along itself at least of this size."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One camera in one scan."""

    booth: int
    scan: int
    scene: Scene
    true: Array
    """(6,): the move."""
    move: CameraMove
    named: bool
    """The scan is refused, or the next one if it has to confirm the alarm."""

    @property
    def seen_size(self) -> float:
        """The true move without the directions that the estimate calls unseen, as a multiple of the
        limit; the larger of shift and turn."""
        size = self.true * SCALE
        for unseen in self.move.unseen():
            size = size - (unseen @ size) * unseen
        return float(max(np.linalg.norm(size[:3]), np.linalg.norm(size[3:])) / MOVED_M)

    @property
    def chi2(self) -> float:
        off = self.move.xi - self.true
        return float(off @ np.linalg.solve(self.move.stated, off))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=1000, help="in which nothing moved")
    parser.add_argument("--small", type=int, default=100, help="scans of moves in the tolerance")
    parser.add_argument("--moves", type=int, default=100, help="scans of larger moves")
    parser.add_argument("--limits", type=int, default=60, help="scans of moves by the limit")
    parser.add_argument("--first-booth", type=int, default=100)
    parser.add_argument("--booths", type=int, default=6)
    arguments = parser.parse_args()
    numbers = range(arguments.first_booth, arguments.first_booth + arguments.booths)
    groups: dict[str, list[Trial]] = {name: [] for name in _MOVES}
    wanted = (arguments.scans, arguments.small, arguments.moves, arguments.limits)
    for number in numbers:
        booth = DriftBooth(number, ROOMS[number % len(ROOMS)])
        for (name, draw), count in zip(_MOVES.items(), wanted, strict=True):
            own = list(trials(booth, -(-count // arguments.booths), draw))
            alarms = sum(trial.move.moved for trial in own)
            named = sum(trial.named for trial in own)
            groups[name] += own
            print(f"{number} {name}: {alarms} alarms, {named} named, {len(own)} views", flush=True)
    _false_alarms(groups["still"], groups["small"])
    _detection(groups["random"], groups["limit"])
    _sizes([trial for group in groups.values() for trial in group])
    _blindness(arguments.first_booth)


def _limit(rng: np.random.Generator) -> Array:
    shift = MOVED_M * direction(rng)
    turn = MOVED_RAD * direction(rng)
    return np.concatenate([turn, 0.0 * shift] if rng.random() < 0.5 else [0.0 * turn, shift])


_MOVES: dict[str, Callable[[np.random.Generator], Array]] = {
    "still": lambda rng: np.zeros(6),  # noqa: ARG005
    "small": lambda rng: random_move(rng, (QUIET_M, QUIET_RAD)),
    "random": random_move,
    "limit": _limit,
}


def trials(
    booth: DriftBooth, scans: int, draw: Callable[[np.random.Generator], Array]
) -> Iterator[Trial]:
    """Each camera in each of so many scans."""
    references = {
        name: DriftReference.prepare(sensor.camera, sensor.stored)
        for name, sensor in booth.sensors.items()
    }
    kind = list(_MOVES.values()).index(draw)
    for scan in range(scans):
        scene = booth.scenes[scan % len(booth.scenes)]
        rng = np.random.default_rng((booth.seed, kind, scan, 25))
        visit = booth.visit(scene, 10_000 * kind + scan)
        frames = CHECK_FRAMES if "empty" in scene else SCAN_FRAMES
        for name, sensor in booth.sensors.items():
            true = draw(rng)
            taken = sensor.frames(visit, true, frames)
            move, doubts = move_in(references[name], taken), Doubts()
            named = doubts.confirmed(move)
            if (move.moved or move.lost) and not named:
                then = booth.scenes[(scan + 1) % len(booth.scenes)]
                again = booth.visit(then, visit.seed + _AGAIN, visit.day)
                taken = sensor.frames(again, true, frames)
                named = doubts.confirmed(move_in(references[name], taken))
            yield Trial(booth.seed, scan, scene, true, move, named)


def _false_alarms(still: list[Trial], small: list[Trial]) -> None:
    print("\nNothing moved, or no farther than 2 mm and 0.15 degrees")
    print(f"  {'':<20}{'views':>7}{'alarms':>8}{'nearest':>9}{'lost':>6}{'chi2/6, median':>16}")
    for scene in SCENES:
        for name, group in (("still", still), ("small", small)):
            mine = [trial for trial in group if trial.scene == scene]
            if not mine:
                continue
            alarms = [trial.move.alarm() for trial in mine if not trial.move.lost]
            print(
                f"  {scene + ', ' + name:<25}{len(mine):>5}{sum(t.move.moved for t in mine):>6}"
                f"{max(alarms):>9.2f}{sum(t.move.lost for t in mine):>6}"
                f"{np.median([t.chi2 for t in mine]) / 6:>12.2f}"
            )
    for name, group in (("still", still), ("small", small)):
        scans = {(trial.booth, trial.scan) for trial in group}
        named = {(trial.booth, trial.scan) for trial in group if trial.named}
        # Clopper and Pearson 1934, one-sided.
        bound = float(beta.ppf(0.95, len(named) + 1, max(1, len(scans) - len(named))))
        share = len(named) / max(1, len(scans))
        doubted = sum(trial.move.moved and not trial.move.certain for trial in group)
        verdict = "missed" if share >= FALSE_ALARMS_BAR else "not shown by so few scans"
        if bound < FALSE_ALARMS_BAR:
            verdict = "met"
        print(
            f"  {name}: scans refused for nothing: {len(named)} of {len(scans)} ({share:.4f}), at "
            f"95 % confidence below {bound:.4f}   (bar: < {FALSE_ALARMS_BAR:g}; "
            f"{verdict}); {doubted} views alarmed for one scan to confirm"
        )


def _detection(moved: list[Trial], limit: list[Trial]) -> None:
    print("\nMoves: share that is named, against the size in seen directions (1 = 5 mm or 0.3 deg)")
    edges = (0.0, 0.4, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 5.0)
    group = [*moved, *limit]
    sizes = np.array([trial.seen_size for trial in group])
    named = np.array([trial.named for trial in group])
    bins = list(pairwise(edges))
    print("  size " + "".join(f"{low:>5g}-{high:<4g}" for low, high in bins))
    rates = (_rate(named, (sizes >= low) & (sizes < high)) for low, high in bins)
    print("  named" + "".join(rates))
    certain = sizes >= 1.0
    whole = np.array(
        [
            max(np.linalg.norm(t.true[:3]) / MOVED_RAD, np.linalg.norm(t.true[3:]) / MOVED_M)
            for t in group
        ]
    )
    seen = np.mean(certain[whole >= 1.0])
    print(
        f"  at or beyond the limit in seen directions: {named[certain].sum()} of {certain.sum()} "
        f"named   (bar: all; {'met' if named[certain].all() else 'missed'}); "
        f"{100 * seen:.0f} % of all moves beyond the limit are such"
    )
    first = np.array([trial.move.certain for trial in group])
    print(
        f"  of all moves at or beyond the limit {100 * named[whole >= 1].mean():.0f} % are named, "
        f"{100 * first[whole >= 1].mean():.0f} % by the first scan; of those in seen directions "
        f"{100 * first[certain].mean():.0f} %"
    )


def _rate(named: NDArray[np.bool_], among: NDArray[np.bool_]) -> str:
    count = int(among.sum())
    return f"{100 * named[among].mean():>6.0f} % " if count else f"{'-':>8} "


def _sizes(group: list[Trial]) -> None:
    limit = float(chi2.ppf(0.99, 6))
    print("\nStated sizes and directions")
    for scene in SCENES:
        mine = [t for t in group if t.scene == scene and not t.move.lost]
        if not mine:
            continue
        inside = np.mean([t.chi2 < limit for t in mine])
        errors = 1e3 * np.array([(t.move.xi - t.true) * SCALE for t in mine])
        known = 1e3 * np.array([_known_error(t) for t in mine])
        print(
            f"  {scene:<18} inside their 99 % covariance: {100 * inside:.1f} %; rms error "
            f"{_rms(errors[:, :3]) / 1e3 / LEVER_M * 180 / np.pi:.3f} deg, "
            f"{_rms(errors[:, 3:]):.2f} mm; of the components told: {_rms(known):.2f} mm"
        )
    inside = np.mean([t.chi2 < limit for t in group if not t.move.lost])
    verdict = "met" if inside >= COVERAGE_BAR else "missed"
    print(f"  all: {100 * inside:.1f} %   (bar: >= 95 %; {verdict})")
    angles = [a for t in group if t.move.moved and (a := _angle(t)) is not None]
    if angles:
        print(
            f"  angle between told and true move, of those named: median {np.median(angles):.0f}, "
            f"95th percentile {np.quantile(angles, 0.95):.0f}, worst {max(angles):.0f} degrees"
        )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(values**2, axis=-1))))


def _told(trial: Trial, xi: Array) -> Array:
    """Components of a move (6,) that are told, rotations times the lever."""
    return CameraMove("", xi, trial.move.stated, 1.0).known() * SCALE


def _known_error(trial: Trial) -> Array:
    return _told(trial, trial.move.xi - trial.true)


def _angle(trial: Trial) -> float | None:
    told, true = _told(trial, trial.move.xi), _told(trial, trial.true)
    if np.linalg.norm(true) < MOVED_M / 2.0:
        return None
    cosine = told @ true / max(1e-12, float(np.linalg.norm(told) * np.linalg.norm(true)))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _blindness(seed: int) -> None:
    """Before one bare wall shifts along it and turns about its normal cannot be seen."""
    booth = DriftBooth(seed, "one wall")
    print("\nOne bare wall: directions called unseen, and what moves along the wall are told as")
    for name, sensor in booth.sensors.items():
        reference = DriftReference.prepare(sensor.camera, sensor.stored)
        normal = np.array([0.0, 1.0, 0.0]) @ sensor.camera.world_from_camera[:3, :3]
        along = np.cross(normal, [0.0, 1.0, 0.0])
        xi = np.concatenate([np.zeros(3), _BLIND_M * along / np.linalg.norm(along)])
        frames = sensor.frames(booth.visit("empty", 0), xi, CHECK_FRAMES)
        move = move_in(reference, frames)
        unseen = np.array(move.unseen()).reshape(-1, 6)
        blind = np.linalg.norm(unseen[:, 3:] @ (xi[3:] / _BLIND_M)) > 0.95
        print(
            f"  {name:<12} {'; '.join(move.unseen_words())}: "
            f"{'met' if blind and not move.moved else 'missed'}"
        )


if __name__ == "__main__":
    main()
