"""Verdict on a fit, from the residuals and the coverage of each part of the body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from station.core.words.terms import part_in_words
from workers.cloud.observed import OFF_FLOOR, TWO_PEOPLE, Finding
from workers.scape.model.body_model import FLOOR, HAND, BodyModel
from workers.scape.verdict.clothes import (
    Clothing,
    clothing_reasons,
    clothing_remarks,
    is_worn,
)
from workers.scape.verdict.hair import Hair
from workers.scape.verdict.seen import TRUNK, PartReport, named_parts
from workers.scape.verdict.seen_words import little_seen, many_hardly_seen
from workers.scape.verdict.unmatched import ELSEWHERE_M, Patch

Array = NDArray[np.float64]

_MIN_COVERAGE = 0.22
"""Least share of a part's area that cameras must have seen; four cameras see 0.5 to 0.9 of it."""
_HALF_COVERAGE = 0.6
"""Coverage below which a part cannot be measured when half the person, or the part that follows, is
missing: of one half alone cameras see up to a half of it."""
_LIMBS = ("left", "right")
_MIN_EXTREMITY_COVERAGE = 0.10
"""The same for hands, feet, shoulders and the neck, which hide behind other parts, and for the
head, of which dark hair hides all but the face."""
_LOST_PATCH_M2 = 0.0040
"""Least area of a patch of the scan farther than 15 mm from the surface that makes a scan unusable:
lost limbs leave 66 to 205 cm^2, folds and hair of sound scans of real people up to 11 cm^2."""
_MISMATCH_M = 0.005
"""Rms distance of a part's points from which nothing is measured there if the scan is to be taken
again anyhow: parts in their places have up to 4.2 mm, a third of those 5 cm off more than 5."""
_PARTS_NAMED = 6
"""Parts that the reasons name at most."""
_CAMERA_SHIFTS_M = (0.002, 0.004)
"""Corrections of a camera from which it is remarked, and from which the scan cannot be used.
Well-placed cameras are moved by tenths of a millimetre, one that is 5 mm off its calibration by
3 mm or more; the fit still corrects that."""
_STATURES_M = (1.30, 2.25)
"""Statures of adults, metres."""
_MAX_BETA = 6.0
"""Largest shape coefficient of the first components, in standard deviations of people."""
_JUDGED_COMPONENTS = 10
_OTHER_SIDE = 0.75
"""Share of the left side's coverage that the right side has at least, and the other way round: of
half a body alone it has 0.05 to 0.6, of sound scans 0.91 to 1."""
_EXTREMITIES = ("hand", "foot", "shoulder", "neck", "head")
_CHAINS = (("upper_arm", "forearm", "hand"), ("thigh", "shin", "foot"))
"""Parts of a limb, outwards."""
_FEET = frozenset({"foot_left", "foot_right"})
_UPRIGHT = ("head", "neck", "thigh", "shin", "foot")
"""Parts without which a body seems shorter."""
_SCATTER_M = 0.006
"""Rms distance of the readings from the surface that makes a scan unusable: 1.1 to 1.6 mm in 50
sound scans, up to 4.0 with the paper's surface, 12 where each point is 30 mm off."""
_NO_BODY = "too much of the scan does not match a body: nothing can be measured"
_REMEDIES = {
    "head": "tie up or cover hair that stands off the head",
    "foot_left": "take shoes off",
    "foot_right": "take shoes off",
}
"""Remedies by the part that does not match the scan."""
_NECK_HIDDEN = "hair or something worn hides the neck: tie hair up, take scarves and straps off"
_ON_ITS_HEAD = "if the cloud stands on its head, say which axis points up (--up)"
_NONE: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether to scan again, and the reasons in words for the operator."""

    status: str
    """"ok" or "rescan"."""
    reasons: tuple[str, ...]
    notes: tuple[str, ...] = ()
    """Remarks, which do not ask for another scan: on hair, on what may be clothing, and on cameras
    that moved a little."""
    missing: tuple[str, ...] = ()
    """Parts that were not seen or that do not match the scan: nothing can be measured there. A hand
    stands for its thumb and fingers; `FLOOR` is one of them."""

    @property
    def missing_parts(self) -> frozenset[str]:
        """Names of the model's parts that are missing."""
        names = set(self.missing)
        for part in self.missing:
            stem, _, side = part.rpartition("_")
            if stem == "hand":
                names.update(f"{member}_{side}" for member in HAND)
        return frozenset(names)


def judge(
    parts: Sequence[PartReport],
    sides: dict[str, float],
    findings: Sequence[Finding],
    lost: Mapping[str, str],
    stature_m: float,
    beta: Array,
    camera_shifts_m: dict[str, float],
    rms_m: float,
    misplaced: Mapping[str, str] = _NONE,
    remarks: Sequence[str] = (),
    clothing: Sequence[Clothing] = (),
) -> Verdict:
    """Decide whether to scan again.

    Args:
        sides: what `sides_seen` gives.
        findings: what preprocessing, `leaning` and `off_floor` noticed; each is a reason.
        lost: what `lost_parts` gives.
        beta: (B,), shape coefficients.
        camera_shifts_m: how far the fit moved each camera's points; empty for a bare cloud.
        rms_m: distance of the points from the surface.
        misplaced: what `head_turned`, `arms_inside`, `feet_cut_off` and `head_cut_off` give.
        remarks: on hair; told with a scan that can be used.
        clothing: its signs; where they are enough, it explains what does not match there.
    """
    cameras = bool(camera_shifts_m)
    unseen = _unseen_parts(parts, cameras=cameras)
    moved, of_cameras = _moved_cameras(camera_shifts_m)
    halves = _unseen_sides(sides, cameras=cameras)
    worn, doubtful = (clothing, ()) if is_worn(clothing, lost) else ((), clothing)
    hidden = [part for sign in worn for part in sign.covered]
    lost = {part: reason for part, reason in lost.items() if part not in hidden}
    everywhere = _limbs_lost(lost) > 1
    lost = {**misplaced, **lost}
    stature = _stature_of_nobody(stature_m)
    # A person without feet or head is short for that reason, which comes first.
    cut = stature_m < _STATURES_M[0] and any(part.startswith(_UPRIGHT) for part in (*lost, *unseen))
    reasons = [finding.message for finding in findings] + moved + ([] if cut else stature)
    reasons += [*_nobody(beta), *clothing_reasons(worn)]
    reasons += [_NO_BODY if cameras else f"{_NO_BODY}; {_ON_ITS_HEAD}"] if everywhere else []
    # What lies beside a body whose arm or head was not found may be that.
    told = [reason for part, reason in lost.items() if part or not misplaced]
    reasons += [*halves, *told[:_PARTS_NAMED]]
    if len(unseen) > _PARTS_NAMED:
        reasons.append(many_hardly_seen(len(unseen), len(parts), cameras=cameras))
    else:
        reasons += [reason for part, reason in unseen.items() if part not in misplaced]
    reasons += stature if cut else []
    if any(finding.code == TWO_PEOPLE for finding in findings):
        # What does not match a body, or does not look like one, comes of it.
        reasons = [finding.message for finding in findings]
    reasons = reasons or _scattered(rms_m, cameras=cameras)
    again = bool(reasons)
    notes = [*([] if again else remarks), *clothing_remarks(doubtful), *of_cameras]
    missing = _missing(
        parts, findings, lost, unseen, halves, cameras=cameras, again=again, everywhere=everywhere
    )
    missing = tuple(dict.fromkeys((*missing, *hidden)))
    return Verdict("rescan" if again else "ok", tuple(reasons), tuple(notes), missing)


def _nobody(beta: Array) -> list[str]:
    if not float(np.abs(beta[:_JUDGED_COMPONENTS]).max(initial=0.0)) > _MAX_BETA:
        return []
    return ["what stands in the booth does not look like a person"]


def _scattered(rms_m: float, *, cameras: bool) -> list[str]:
    if not rms_m > _SCATTER_M:  # where there are no readings it is not a number
        return []
    remedy = "run: station check" if cameras else "clean the cloud, or scan again"
    return [f"the readings lie {1e3 * rms_m:.0f} mm from the body; {remedy}"]


def _stature_of_nobody(stature_m: float) -> list[str]:
    low, high = _STATURES_M
    if low < stature_m < high:
        return []
    return [
        f"the person is {stature_m:.2f} m tall; only adults of {low:.2f} to {high:.2f} m can "
        "be measured"
    ]


def _unseen_sides(sides: Mapping[str, float], *, cameras: bool) -> list[str]:
    best = max((sides.get(f"{name} side", 0.0) for name in _LIMBS), default=0.0)
    return [
        little_seen(share, f"person's {side}", cameras=cameras)
        for side, share in sides.items()
        if share < _MIN_COVERAGE or (side.endswith("side") and share < _OTHER_SIDE * best)
    ]


def _unseen_parts(parts: Sequence[PartReport], *, cameras: bool) -> dict[str, str]:
    """Reasons by the part that was hardly seen."""
    reasons = {}
    for part in parts:
        extremity = part.name.startswith(_EXTREMITIES)
        if part.coverage < (_MIN_EXTREMITY_COVERAGE if extremity else _MIN_COVERAGE):
            reason = little_seen(part.coverage, part_in_words(part.name), cameras=cameras)
            if part.name == "head":
                reason += "; cover dark hair with a light cap"
            reasons[part.name] = reason
    return reasons


def _moved_cameras(shifts_m: Mapping[str, float]) -> tuple[list[str], list[str]]:
    """Reasons and remarks by how far the fit moved each camera's points."""
    noticed, unusable = _CAMERA_SHIFTS_M
    reasons: list[str] = []
    notes: list[str] = []
    for camera, shift in shifts_m.items():
        if shift > noticed:
            (reasons if shift > unusable else notes).append(
                f"camera {camera} has moved by {1e3 * shift:.0f} mm or more since the calibration; "
                "run: station check"
            )
    return reasons, notes


def hair_remarks(hair: Hair, cover_m: float) -> list[str]:
    """Remarks on hair beside the head, and on what covers it (`head_cover_m`)."""
    remarks = []
    if any(patch.area_m2 > _LOST_PATCH_M2 for patch in hair.on_head):
        remarks.append("hair or something worn that stands off the head is left out of the body")
    if cover_m > 0.0:
        remarks.append(
            f"hair or a cap covers the head, up to {1e3 * cover_m:.0f} mm thick: height and head "
            "are measured with it; cover hair with a close-fitting cap if they matter"
        )
    return remarks


def lost_parts(
    model: BodyModel, patches: Sequence[Patch], hair: Hair | None = None
) -> dict[str, str]:
    """Reasons by the part that a large patch of the scan belongs to; "" where it is none.

    Args:
        hair: those of the patches that are hair.
    """
    hair = hair or Hair()
    keys = {index: key for key, members in named_parts(model).items() for index in members}
    reasons: dict[str, str] = {}
    for patch in patches:
        if patch.area_m2 < _LOST_PATCH_M2 or patch in hair.on_head:
            continue
        if patch in hair.hanging:
            reasons.setdefault("neck", _NECK_HIDDEN)
            continue
        size = f"{1e4 * patch.area_m2:.0f} cm2"
        if patch.distance_m > ELSEWHERE_M:
            reasons.setdefault(
                "",
                f"{size} of the scan do not belong to the person: "
                "take other things out of the booth",
            )
            continue
        for index in patch.parts:
            part = keys[index]
            reason = (
                f"the {part_in_words(part)} does not match the scan ({size} of it lie "
                f"{1e3 * patch.distance_m:.0f} mm away)"
            )
            remedy = _REMEDIES.get(part)
            reasons.setdefault(part, f"{reason}; {remedy}" if remedy else reason)
    return reasons


def _limbs() -> list[list[str]]:
    """Parts of each limb, outwards."""
    return [[f"{part}_{side}" for part in chain] for chain in _CHAINS for side in _LIMBS]


def _limbs_lost(lost: Mapping[str, str]) -> int:
    """Number of limbs that do not match the scan: with two, a body was fitted to something else."""
    return sum(not lost.keys().isdisjoint(limb) for limb in _limbs())


def _missing(
    parts: Sequence[PartReport],
    findings: Sequence[Finding],
    lost: Mapping[str, str],
    unseen: Mapping[str, str],
    halves: Sequence[str],
    *,
    cameras: bool,
    again: bool,
    everywhere: bool,
) -> tuple[str, ...]:
    """Parts, and the floor, where nothing can be measured.

    Args:
        lost: reasons by the part that does not match the scan or was misplaced.
        unseen: what `_unseen_parts` gives.
        halves: what `_unseen_sides` gives.
        again: the scan is to be taken again.
        everywhere: the body was fitted to something else.
    """
    missing = [*(name for name in lost if name), *unseen]
    if again:
        missing += [part.name for part in parts if part.residual_rms_m > _MISMATCH_M]
    missing = _with_rest_of_limbs(missing, lost, parts)
    if not cameras and not _FEET.isdisjoint(missing):
        # Only feet show where the floor of a bare cloud is; legs without them were pressed to it.
        missing += [FLOOR, *(part for limb in _limbs() if limb[-1] in _FEET for part in limb[1:])]
    missing += [FLOOR for finding in findings if finding.code in OFF_FLOOR]
    if everywhere:
        missing += [part.name for part in parts]
    elif halves or any({f"upper_arm_{side}", f"thigh_{side}"} <= unseen.keys() for side in _LIMBS):
        missing += [
            part.name for part in parts if part.name in TRUNK or part.coverage < _HALF_COVERAGE
        ]
    return tuple(dict.fromkeys(missing))


def _with_rest_of_limbs(
    missing: Sequence[str], lost: Mapping[str, str], parts: Sequence[PartReport]
) -> list[str]:
    """Missing parts, what is farther out, and what is next to them and was hardly seen: nothing
    says how it points. All of a limb where its middle, or something beside the body, does not match
    the scan."""
    coverage = {part.name: part.coverage for part in parts}
    found = list(missing)
    for limb in _limbs():
        first = next((place for place, part in enumerate(limb) if part in missing), len(limb))
        if first == len(limb):
            continue
        while first > 0 and coverage.get(limb[first - 1], 1.0) < _HALF_COVERAGE:
            first -= 1
        found += limb if limb[1] in lost or "" in lost else limb[first:]
    return found
