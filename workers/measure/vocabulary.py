"""Words of the table of measurements: standards, groups of parts, straight distances.

Clauses of ISO 8559-1:2017 (clothing) and ISO 7250-1:2017 (body) are given where public sources name
them: the contents of ISO 8559-1 in its free preview, and measuring guides that quote its clauses. A
row that follows a standard whose clause could not be confirmed names the standard alone; a row that
differs from its standard names none.
"""

from __future__ import annotations

from workers.measure.kinds import Definition, Leg, Route

TRUNK = ("pelvis", "abdomen", "chest")
HIPS = (*TRUNK, "thigh_left", "thigh_right")
COLLAR = ("shoulder_left", "shoulder_right")
"""Parts between the neck and the arms, without upper arms, which may be raised above them."""
SHOULDERS = ("neck", "chest", *COLLAR, "upper_arm_left", "upper_arm_right")
NECK_FOOT = ("cervicale", "side_neck_left", "suprasternale", "side_neck_right")
"""Landmarks around the foot of the neck, clockwise from above."""
YOKE = tuple(part for part in SHOULDERS if part != "neck")
"""Parts below the seventh neck vertebra, without a neck that may lean to one side."""
FLANK = (*HIPS, "shin_left", "shin_right")

CLOTHES = "ISO 8559-1:2017"
BODY = "ISO 7250-1:2017"


def distance(name: str, words: str, landmarks: tuple[str, ...], standard: str = "") -> Definition:
    """A row that is measured straight from landmark to landmark."""
    straight: tuple[Leg, ...] = tuple("straight" for _ in landmarks[1:])
    return Definition(name, words, "distance", Route(landmarks, straight), standard)
