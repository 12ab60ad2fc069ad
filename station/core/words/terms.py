"""Names of measurements, in two languages and SeamlyMe's, and of parts of the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Language = Literal["en", "zh"]
Side = Literal["", "left", "right"]


@dataclass(frozen=True, slots=True)
class Term:
    """One measurement, whatever its side."""

    en: str
    zh: str
    seamly: str = ""
    """SeamlyMe's own name of it; empty where it has none."""

    def words(self, language: Language) -> str:
        return self.zh if language == "zh" else self.en


SIDES: dict[Side, tuple[str, str]] = {
    "": ("", ""),
    "left": ("left", "左"),
    "right": ("right", "右"),
}

TERMS = {
    "height": Term("Height", "身高", "height"),
    "nape_to_floor": Term("Nape to floor", "颈椎点高", "height_neck_back"),
    "chin_height": Term("Chin height", "下巴高"),
    "shoulder_height": Term("Shoulder height", "肩高", "height_shoulder_tip"),
    "bust_height": Term("Bust height", "胸高", "height_bustpoint"),
    "waist_height": Term("Waist height", "腰高", "height_waist_front"),
    "hip_height": Term("Hip height", "臀高", "height_hip"),
    "crotch_height": Term("Inside leg", "会阴高", "leg_crotch_to_floor"),
    "knee_height": Term("Knee height", "膝高", "height_knee"),
    "head_girth": Term("Head girth", "头围", "head_circ"),
    "neck_girth": Term("Neck girth", "颈围", "neck_mid_circ"),
    "neck_base_girth": Term("Neck base girth", "颈根围", "neck_circ"),
    "chest_girth": Term("Chest or bust girth", "胸围", "bust_circ"),
    "high_bust_girth": Term("High bust girth", "上胸围", "highbust_circ"),
    "underbust_girth": Term("Underbust girth", "下胸围", "lowbust_circ"),
    "waist_girth": Term("Waist girth", "腰围", "waist_circ"),
    "trouser_waist_girth": Term("Trouser waist girth", "裤腰围"),
    "belly_girth": Term("Belly girth", "腹围"),
    "trunk_girth": Term("Trunk girth", "躯干围"),
    "high_hip_girth": Term("High hip girth", "上臀围", "highhip_circ"),
    "hip_girth": Term("Hip girth", "臀围", "hip_circ"),
    "chest_breadth": Term("Chest breadth", "胸宽", "width_bust"),
    "chest_depth": Term("Chest depth", "胸厚"),
    "waist_breadth": Term("Waist breadth", "腰宽", "width_waist"),
    "waist_depth": Term("Waist depth", "腰厚"),
    "hip_breadth": Term("Hip breadth", "臀宽", "width_hip"),
    "hip_depth": Term("Hip depth", "臀厚"),
    "shoulder_width": Term("Shoulder width", "肩宽", "width_shoulder"),
    "across_back_shoulder_width": Term("Shoulders across the back", "总肩宽", "shoulder_width_b"),
    "across_back_width": Term("Back width", "后背宽", "across_back_b"),
    "across_front_width": Term("Chest width", "前胸宽", "across_chest_f"),
    "across_back_skin_width": Term("Back width along the skin", "后背宽（沿体表）"),
    "across_front_skin_width": Term("Chest width along the skin", "前胸宽（沿体表）"),
    "bust_point_width": Term("Between the bust points", "胸点间距", "bustpoint_to_bustpoint"),
    "back_waist_length": Term("Back waist length", "背长", "neck_back_to_waist_b"),
    "front_waist_length": Term("Front waist length", "前中长", "neck_front_to_waist_f"),
    "body_rise": Term("Body rise", "股上长"),
    "crotch_length": Term("Crotch length", "裆长", "crotch_length"),
    "crotch_length_front": Term("Crotch length, front", "前裆长", "crotch_length_f"),
    "crotch_length_back": Term("Crotch length, back", "后裆长", "crotch_length_b"),
    "head_length": Term("Head length", "头长", "head_depth"),
    "upper_arm_girth": Term("Upper arm girth", "上臂围", "arm_upper_circ"),
    "elbow_girth": Term("Elbow girth", "肘围", "arm_elbow_circ"),
    "forearm_girth": Term("Forearm girth", "前臂围", "arm_lower_circ"),
    "wrist_girth": Term("Wrist girth", "腕围", "arm_wrist_circ"),
    "arm_length": Term("Arm length", "臂长", "arm_shoulder_tip_to_wrist"),
    "upper_arm_length": Term("Upper arm length", "上臂长", "arm_shoulder_tip_to_elbow"),
    "forearm_length": Term("Forearm length", "前臂长", "arm_elbow_to_wrist"),
    "sleeve_length": Term("Sleeve length from nape", "连肩袖长"),
    "hand_length": Term("Hand length", "手长", "hand_length"),
    "shoulder_length": Term("Shoulder length", "小肩长", "shoulder_length"),
    "shoulder_drop": Term("Shoulder drop", "落肩"),
    "armscye_girth": Term("Armscye girth", "臂根围", "armscye_circ"),
    "armscye_depth": Term("Armscye depth", "袖窿深"),
    "hand_girth": Term("Hand girth", "掌围", "hand_palm_circ"),
    "neck_shoulder_to_waist_front": Term("Neck side to waist, front", "颈肩点至前腰"),
    "neck_shoulder_to_waist_back": Term("Neck side to waist, back", "颈肩点至后腰"),
    "neck_to_bust_length": Term("Neck side to bust point", "颈肩点至胸点", "neck_side_to_bust_f"),
    "thigh_girth": Term("Thigh girth", "大腿围", "leg_thigh_upper_circ"),
    "mid_thigh_girth": Term("Mid-thigh girth", "大腿中围", "leg_thigh_mid_circ"),
    "knee_girth": Term("Knee girth", "膝围", "leg_knee_circ"),
    "calf_girth": Term("Calf girth", "小腿围", "leg_calf_circ"),
    "ankle_girth": Term("Ankle girth", "踝围", "leg_ankle_high_circ"),
    "outside_leg_length": Term("Outside leg", "外侧腿长", "leg_waist_side_to_floor"),
    "waist_to_hip_length": Term("Waist to hip", "腰至臀长"),
    "lower_leg_length": Term("Lower leg length", "小腿长"),
    "foot_length": Term("Foot length", "足长", "foot_length"),
    "foot_breadth": Term("Foot breadth", "足宽", "foot_width"),
}
"""SeamlyMe's names have no sides; a measurement of its own is one that means the same line."""


VERDICTS: dict[str, tuple[str, str]] = {
    "ok": ("usable", "合格"),
    "rescan": ("scan again", "请重新扫描"),
}


def verdict_words(verdict: str, language: Language = "en") -> str:
    """A result's verdict as an operator reads it; what is none stays as it is."""
    english, chinese = VERDICTS.get(verdict, (verdict, verdict))
    return chinese if language == "zh" else english


def split_side(name: str) -> tuple[str, Side]:
    """A row's name without its side, and the side: wrist_girth_left -> (wrist_girth, left)."""
    stem, _, last = name.rpartition("_")
    if last == "left":
        return stem, "left"
    if last == "right":
        return stem, "right"
    return name, ""


def plain_name(name: str, language: Language = "en", *, with_side: bool = True) -> str:
    """A row's name as a tailor reads it; a name that is not in the table is spelt out."""
    stem, side = split_side(name)
    term = TERMS.get(stem)
    words = term.words(language) if term else stem.replace("_", " ").capitalize()
    if not side or not with_side:
        return words
    english, chinese = SIDES[side]
    return f"{chinese}{words}" if language == "zh" else f"{words}, {english}"


def part_in_words(part: str) -> str:
    """A part of the body as a verdict's reasons name it: forearm_left -> left forearm."""
    stem, side = split_side(part)
    return f"{side} {stem.replace('_', ' ')}" if side else part
