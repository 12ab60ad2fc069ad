"""Verdicts on good scans, which must not be taken again, and on bad ones, which must be named.

    python tests/bench/bench_verdict.py               # 60 good and 60 bad scans
    python tests/bench/bench_verdict.py --bodies 2    # 2 + 1 good, 3 bad

Good scans are those of bench_measure: held-out bodies and, half as many, sculpted ones before
sensors that err otherwise than the fit assumes. Each of the other bodies is scanned badly three
times: in a pose whose turns are twice those that were drawn for it, with a limb that gives no
reading, and a step off the mark. A limb is lost where the mean distance of its
vertices from their true places is more than 5 cm, and named where the verdict calls its part
missing; its rows are then blank. An eighth of the good bodies are scanned again with hair of four
kinds: a bun, a beard and thick hair are no reasons to scan again, a ponytail on the neck is. As
many of both families are scanned in six loose garments, which a reason or a remark has to tell.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from clothes import EASES_M, with_clothes
from fit_cases import TestBodies
from hair import VERDICTS, with_hair
from measured_scans import Studio
from numpy.typing import NDArray
from room import first_with_room
from unlike_bodies import UnlikeBodies
from unlike_sensor import render_unlike

from station.core.bundle import read_bundle
from station.core.errors import BoothError
from station.simulation.scene import Mesh
from station.simulation.sensor import SimulatedBooth, render_bundle
from workers.cloud.preprocess import preprocess
from workers.reconstruct.job import warm_up
from workers.scape.fit.fit import fit_body
from workers.scape.learn.database import BodyDatabase
from workers.scape.model.body_model import HAND, BodyModel
from workers.scape.verdict.verdict import Verdict

Array = NDArray[np.float64]

_SEED = 41
_FARTHER = 2.0
_POSES = 120
_LOST_M = 0.05
_STEPS_M = (0.3, 0.6)
_DARK = (
    ("forearm", "hand", "thumb", "fingers"), ("upper_arm", "forearm", "hand", "thumb", "fingers"),
    ("shin", "foot"), ("thigh", "shin", "foot"), ("foot",),
)  # fmt: skip
"""Parts that give no reading, in turn on the left and on the right."""
_CLOTHING = "clothing"
"""A word of all reasons and remarks on it."""
_LIMBS = ("upper_arm", "forearm", "hand", "thigh", "shin", "foot")


@dataclass(frozen=True, slots=True)
class BadScan:
    """A body in the database's topology, and the triangles that the cameras can read."""

    name: str
    body: Array
    dark: NDArray[np.bool_] | None = None


def bad_scans(model: BodyModel, database: BodyDatabase, count: int) -> Iterator[BadScan]:
    """Three of each of the first so many bodies."""
    shapes = database.sample("test", count, _SEED)
    poses = database.sample_poses("test", _POSES, _SEED)
    names = np.array(model.part_names)[model.part_of_vertex]
    for index in range(count):
        one = shapes.take(np.array([index]))
        neutral = database.vertices(one)[0]

        def posed(factor: float, start: int) -> Array:
            turned = factor * np.roll(poses, -start, axis=0)
            bodies = (database.vertices(one, pose[None])[0] for pose in turned)  # noqa: B023
            body = first_with_room(neutral, bodies, database.faces)  # noqa: B023
            middle = 0.5 * (body.min(axis=0) + body.max(axis=0))
            return np.asarray(body - (middle[0], middle[1], body[:, 2].min()))

        usual = posed(1.0, index)
        yield BadScan(f"{index:02d} far pose", posed(_FARTHER, _POSES // 2 + index))
        side = ("left", "right")[index % 2]
        parts = [f"{part}_{side}" for part in _DARK[index % len(_DARK)]]
        dark = np.asarray(np.isin(names, parts)[database.faces].all(axis=1))
        yield BadScan(f"{index:02d} no {parts[0]}", usual, dark)
        rng = np.random.default_rng((_SEED, index))
        angle, step_m = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*_STEPS_M)
        aside = step_m * np.array([np.cos(angle), np.sin(angle), 0.0])
        yield BadScan(f"{index:02d} {step_m:.2f} m off", usual + aside)


def lost_limbs(model: BodyModel, found: Array, truth: Array) -> dict[str, float]:
    """Limbs far from their true places, with the mean distance in metres."""
    away = np.linalg.norm(found - truth, axis=1)
    names = np.array(model.part_names)[model.part_of_vertex]
    means = {
        f"{limb}_{side}": float(away[names == f"{limb}_{side}"].mean())
        for limb in _LIMBS
        for side in ("left", "right")
    }
    return {name: mean for name, mean in means.items() if mean > _LOST_M}


def is_named(verdict: Verdict, limb: str) -> bool:
    """Whether a verdict of "rescan" calls a limb missing."""
    stem, _, side = limb.rpartition("_")
    wanted = {f"{part}_{side}" for part in (HAND if stem == "hand" else (stem,))}
    return verdict.status == "rescan" and wanted <= verdict.missing_parts


def false_rescans(studio: Studio, bodies: int) -> tuple[int, int, int]:
    """Good scans, those of them that the product asks to take again, and those of bare people that
    it takes for dressed ones."""
    scans, wrong, dressed = 0, 0, 0
    for good in (studio.population("test", bodies), studio.unlike("test", bodies // 2)):
        for scan in good:
            scans += 1
            verdict = scan.fit.verdict
            words = "; ".join((*verdict.reasons, *verdict.notes))
            wrong += verdict.status != "ok"
            dressed += _CLOTHING in words
            print(f"  {scan.name} {words or 'ok'}", flush=True)
    return scans, wrong, dressed


def _rendered(mesh: Mesh, stem: Path, seed: int, *, unlike: bool = False) -> Path:
    """The bundle of a scan, rendered if it was not before."""
    digest = hashlib.sha256(mesh.vertices.tobytes()).hexdigest()[:12]
    bundle = stem.with_name(f"{stem.name}-{digest}")
    if not bundle.exists():
        render = render_unlike if unlike else render_bundle
        render(mesh, bundle, SimulatedBooth(seed=seed))
    return bundle


def unnamed_losses(model: BodyModel, bodies: int, folder: Path) -> tuple[int, int, int, int]:
    """Bad scans, those with lost limbs, those with one that is not named, and rescans."""
    database = BodyDatabase()
    scans = losses = unnamed = rescans = 0
    for scan in bad_scans(model, database, bodies):
        mesh = Mesh(scan.body, database.faces, scan.dark)
        bundle = _rendered(mesh, folder / f"bad-{scan.name.replace(' ', '-')}", 900 + scans)
        scans += 1
        try:
            fit = fit_body(model, preprocess(read_bundle(bundle)))
        except BoothError as error:
            rescans += 1
            print(f"  {scan.name}: error: {error}", flush=True)
            continue
        lost = lost_limbs(model, fit.overlapping, scan.body)
        quiet = [limb for limb in lost if not is_named(fit.verdict, limb)]
        losses += bool(lost)
        unnamed += bool(quiet)
        rescans += fit.verdict.status == "rescan"
        words = ", ".join(
            f"{limb} {1e3 * lost[limb]:.0f} mm{' NOT NAMED' if limb in quiet else ''}"
            for limb in lost
        )
        reasons = "; ".join(fit.verdict.reasons) or "ok"
        print(f"  {scan.name}: {words or 'nothing lost'} | {reasons}", flush=True)
    return scans, losses, unnamed, rescans


def hair_misjudged(model: BodyModel, bodies: int, folder: Path) -> tuple[int, int]:
    """Scans of heads with hair, and those of them with another verdict than they should have."""
    scans, wrong = 0, 0
    for index, usual in enumerate(TestBodies().body(index) for index in range(bodies)):
        for kind, expected in VERDICTS.items():
            haired = with_hair(model, usual, kind)
            bundle = _rendered(haired, folder / f"hair-{kind}-{index:02d}", 700 + index)
            verdict = fit_body(model, preprocess(read_bundle(bundle))).verdict
            scans += 1
            wrong += verdict.status != expected
            words = "; ".join((*verdict.reasons, *verdict.notes)) or "ok"
            told = "" if verdict.status == expected else "NOT AS IT SHOULD BE: "
            print(f"  {index:02d} {kind}: {told}{words}", flush=True)
    return scans, wrong


def clothes_untold(model: BodyModel, bodies: int, folder: Path) -> tuple[int, int, int]:
    """Scans of dressed bodies, those that are to be taken again, and those of whose clothes neither
    a reason nor a remark tells."""
    scans = rescans = untold = 0
    usual, unlike = TestBodies(), UnlikeBodies(model, "test")
    wearers = [("family", index, usual.body(index)) for index in range(bodies)]
    wearers += [("unlike", index, unlike.body(index).mesh) for index in range(bodies)]
    for family, index, body in wearers:
        for number, kind in enumerate(EASES_M):
            rng = np.random.default_rng((_SEED, family == "unlike", index, number))
            dressed, ease_m = with_clothes(model, body, kind, rng)
            stem = folder / f"clothes-{family}-{kind}-{index:02d}"
            bundle = _rendered(dressed, stem, 700 + index, unlike=family == "unlike")
            verdict = fit_body(model, preprocess(read_bundle(bundle))).verdict
            words = "; ".join((*verdict.reasons, *verdict.notes))
            told = _CLOTHING in words
            scans += 1
            rescans += verdict.status == "rescan"
            untold += not told
            print(
                f"  {family} {index:02d} {kind}, {100 * ease_m:.0f} cm wider: "
                f"{'' if told else 'NOT TOLD: '}{verdict.status}: {words}",
                flush=True,
            )
    return scans, rescans, untold


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--bodies",
        type=int,
        default=40,
        help="scanned well; half as many sculpted ones too, and half as many badly, three times",
    )
    parser.add_argument("--scans", type=Path, help="keep what is rendered here, and use it again")
    arguments = parser.parse_args()
    model = warm_up()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.scans or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        good, wrong, bare = false_rescans(Studio(model, folder), arguments.bodies)
        bad, losses, unnamed, rescans = unnamed_losses(model, (arguments.bodies + 1) // 2, folder)
        hair, misjudged = hair_misjudged(model, (arguments.bodies + 7) // 8, folder)
        dressed, again, untold = clothes_untold(model, (arguments.bodies + 7) // 8, folder)
    print(f"\nfalse rescans: {wrong} of {good} good scans (bar 0): {_word(wrong)}")
    print(
        f"limbs lost in {losses} of {bad} bad scans, {rescans} of which are to be taken again; "
        f"not named in {unnamed} (bar 0): {_word(unnamed)}"
    )
    print(
        f"heads with hair: {misjudged} of {hair} judged otherwise than they should be (bar 0): "
        f"{_word(misjudged)}"
    )
    print(
        f"loose clothes: not told in {untold} of {dressed} scans (bar 0): {_word(untold)}; "
        f"{again} are to be taken again; told in {bare} of {good} scans of bare people (bar 0): "
        f"{_word(bare)}"
    )


def _word(count: int) -> str:
    return "MISSED" if count else "met"


if __name__ == "__main__":
    main()
