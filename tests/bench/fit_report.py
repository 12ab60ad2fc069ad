"""Tables that bench_fit prints: cases, and the bars, each met or missed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from fit_cases import Case
from surface_errors import SurfaceErrors

from station.core.words.terms import part_in_words
from workers.scape.fit.fit import FitResult

_LOST_MM = 15.0
_PAPERS_SECONDS = 60.0


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
            or not any(part_in_words(name) in reason for reason in verdict.reasons)
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
    """A limit that the product promises to keep."""

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
        f"  {verdict.status:<7}{part_in_words(part)} {rms:.1f}",
        flush=True,
    )
    for reason in verdict.reasons:
        print(f"{'':<31}{reason}")


def print_summary(rows: dict[str, list[Row]]) -> None:
    print(f"\n{'':<24}{'mean':>8}{'p95':>8}{'worst':>8}")
    for group, found in rows.items():
        for words, values in (
            ("body, mm", [row.errors.body_rms for row in found]),
            ("hands, feet, mm", [row.errors.extremity_rms for row in found]),
            ("seen, mm", [row.errors.seen_rms for row in found]),
            ("unseen, mm", [row.errors.unseen_rms for row in found]),
            ("unexplained, %", [row.errors.unexplained for row in found]),
            ("height, mm", [abs(row.errors.height) for row in found]),
            ("fit, s", [row.fit_s for row in found]),
            ("whole, s", [row.whole_s for row in found]),
        ):
            print(
                f"{group:<8}{words:<16}{np.mean(values):8.2f}{np.quantile(values, 0.95):8.2f}"
                f"{np.max(values):8.2f}"
            )


def print_worst_parts(rows: dict[str, list[Row]]) -> None:
    """Print each part's rms over a group's cases, and the case where it is worst."""
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
                f"{group:<8}{part_in_words(name):<20}{np.sqrt(np.mean(np.square(table[name]))):7.2f}"
                f"{table[name][worst]:8.2f}  {found[worst].case.name}"
            )


def print_outcome(name: str, status: str, reasons: Sequence[str]) -> bool:
    print(f"{name:<22}{status:<8}{reasons[0] if reasons else ''}", flush=True)
    for reason in reasons[1:3]:
        print(f"{'':<30}{reason}")
    if len(reasons) > 3:
        print(f"{'':<30}and {len(reasons) - 3} more")
    return status == "ok"


def bars_of(
    rows: dict[str, list[Row]],
    peers: Sequence[PeerRow],
    confident: int,
    peak_mb: float,
    meshes: int,
) -> list[Bar]:
    """Everything that the product promises of its fit."""
    family, unlike, other = (rows.get(group, []) for group in ("family", "unlike", "other"))
    hard, plain = rows.get("hard", []), [*family, *unlike, *other]
    timed = [*plain, *hard]

    def mean(values: Sequence[float]) -> float | None:
        return float(np.mean(values)) if values else None

    def most(values: Sequence[float]) -> float | None:
        return max(values, default=None)

    def share(values: Sequence[float], level: float) -> float | None:
        return float(np.quantile(values, level)) if values else None

    seen = [row.errors.seen_median for row in [*family, *other]]
    median_s = share([row.whole_s for row in timed], 0.5)
    bars = [
        *_surface_bars("family", family, (0.75, 1.0), 0.65, (0.03, 0.2)),
        *_surface_bars("unlike", unlike, (1.7, 2.3), 1.0, (0.15, 0.4)),
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
        Bar("time, bundle to files: median", median_s, 0.7, "s"),
        Bar("time, bundle to files: p95", share([row.whole_s for row in timed], 0.95), 1.5, "s"),
        Bar("time, the fit itself: median", share([row.fit_s for row in timed], 0.5), 0.5, "s"),
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


def _surface_bars(
    name: str,
    rows: Sequence[Row],
    body: tuple[float, float],
    seen: float,
    unexplained: tuple[float, float],
) -> list[Bar]:
    """Bars of a set of bodies: rms (mean, worst), where seen, and unexplained points."""
    if not rows:
        return []
    body_mm = [row.errors.body_rms for row in rows]
    seen_mm = [row.errors.seen_rms for row in rows]
    share = [row.errors.unexplained for row in rows]
    return [
        Bar(f"{name}: body, mean rms", float(np.mean(body_mm)), body[0]),
        Bar(f"{name}: body, worst rms", max(body_mm), body[1]),
        Bar(f"{name}: seen skin, mean rms", float(np.mean(seen_mm)), seen),
        Bar(f"{name}: unexplained points, mean", float(np.mean(share)), unexplained[0], "%"),
        Bar(f"{name}: unexplained points, worst", max(share), unexplained[1], "%"),
    ]
