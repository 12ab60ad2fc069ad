"""Reasons, remedies and refusals that reach the page exist in Chinese, whoever words them."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from spoken import SPOKEN

from station.archive.phrases import PHRASES, in_language, untranslated
from station.calibration.detect.coverage import Coverage
from station.calibration.guide.steps import _rest_line, _wave_line
from station.calibration.moves.motion import move_words
from station.core.words.terms import part_in_words
from station.simulation.scene import default_rig
from workers.scape.model.body_model import load_model

ROOT = Path(__file__).parents[2]
SPEAKERS = (
    "workers/scape/verdict/verdict.py", "workers/scape/verdict/seen_words.py",
    "workers/scape/verdict/posture.py", "workers/scape/verdict/clothes.py",
    "workers/cloud/preprocess.py", "workers/cloud/floor_level.py",
    "workers/reconstruct/job_handle.py", "workers/reconstruct/pool.py",
    "station/booth/collection.py", "station/booth/scan_writer.py", "station/booth/frame_check.py",
    "station/booth/session.py", "station/booth/sync.py", "station/booth/control.py",
    "station/booth/health.py",
    "station/booth/deletion.py", "station/booth/retention.py",
    "station/core/spool.py", "station/messaging/transport.py",
    "station/core/depth/intrinsics.py", "station/archive/records.py",
    "station/calibration/moves/motion.py", "station/calibration/drift/watch.py",
    "station/calibration/moves/depths.py",
    "station/calibration/drift/people.py",
    "station/calibration/guide/attempt.py", "station/calibration/guide/procedure.py",
    "station/calibration/guide/raised_ball.py",
    "station/calibration/guide/steps.py",
    "station/calibration/guide/feed.py", "station/calibration/guide/recorded_clock.py",
    "station/calibration/guide/recordings.py",
    "station/calibration/guide/session.py",
    "station/calibration/guide/seen.py",
    "station/calibration/guide/store.py", "station/calibration/solve/refusals.py",
    "station/calibration/solve/resting_ball.py",
    "station/calibration/solve/solution.py", "station/calibration/solve/solving.py",
    "station/calibration/solve/first_problem.py", "station/calibration/solve/advice.py",
    "station/calibration/solve/acceptance.py",
    "station/calibration/solve/warming.py", "station/calibration/solve/world.py",
    "station/calibration/solve/predicted.py", "station/calibration/detect/coverage.py",
    "station/sensors/freenect.py", "station/sensors/identity.py", "station/sensors/recorded.py",
    "station/sensors/recording.py",
    "station/console/live/watch.py", "station/console/live/countdown.py",
    "station/console/live/tasks.py", "station/console/live/guided.py",
    "station/console/api/booth.py", "station/console/api/scans.py",
    "station/console/security/gate.py", "station/handover/targets.py",
    "station/handover/deliver_cli.py",
)  # fmt: skip
"""Modules whose sentences an operator reads on the page."""
NOT_SHOWN = re.compile(
    r"(sync|control) does not know the command|a (sync|control) process is already running|"
    r"default-src|a WebSocket|belongs to another user|the driver freenect needs|up or down|"
    r"there is nobody to hand|turning left|^scan %s|"
    r"forward or back|waits for the disk|^yes or no$|^folder =|^7, but 7: 7$|"
    r"down to the soles|floor of the cloud"
)
"""Sentences of programs to programs, or in the terminal: of `station run`, `station check` and the
fit of a bare cloud."""
WORD = re.compile(r"(?<![\w./-])[a-z]{2,}(?![\w./-])")
COMMANDS = re.compile(r"(sudo )?(station|systemctl) [a-z -]+|\(.*?\)")
_SILENT_CALLS = ("log.", "_log.", "click.", "Field", "Query", "audit.note")
_MIN_WORDS = 3
_GAP, _GAPS = "7", re.compile(r"\{\w+\}")
_BACK = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -0.009])
"""A move of a camera."""


def _template(node: ast.AST) -> str | None:
    """A string with a sample in each gap; None for what is no string."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        parts = node.values
        return "".join(str(p.value) if isinstance(p, ast.Constant) else _GAP for p in parts)
    if isinstance(node, ast.BinOp) and (begun := _template(node.left) or "").endswith(" "):
        return begun + _GAP
    return None


def _templates(path: Path) -> Iterator[str]:
    """The strings of a module that may be told to somebody."""
    tree = ast.parse(path.read_text())
    passed: set[int] = set()
    for node in ast.walk(tree):
        silent = isinstance(node, ast.Call) and any(
            part in ast.unparse(node.func) for part in _SILENT_CALLS
        )
        if silent or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
            passed.update(id(inner) for inner in ast.walk(node))
        elif isinstance(node, ast.JoinedStr):
            passed.update(id(part) for part in node.values if isinstance(part, ast.Constant))
    for node in ast.walk(tree):
        text = _template(node) if id(node) not in passed else None
        if text is not None:
            yield text


def _is_sentence(text: str) -> bool:
    return len(text.split()) >= _MIN_WORDS and text == text.strip()


def _sentences(path: Path) -> list[str]:
    """Whatever in a module may be told to somebody."""
    found = [text for text in _templates(path) if _is_sentence(text)]
    return [text for text in found if not NOT_SHOWN.search(text)]


def _ends_of_sentences(path: Path) -> list[str]:
    """Words that are put before or behind a sentence."""
    found = [text for text in _templates(path) if text != text.strip()]
    return [text.strip(" \n;:,") for text in found if len(WORD.findall(text)) >= _MIN_WORDS]


def _short_choices(path: Path) -> Iterator[str]:
    """A word or two that may stand where a sentence does."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.IfExp):
            texts = [_template(node.body) or "", _template(node.orelse) or ""]
            if any(map(_is_sentence, texts)):
                yield from (text for text in texts if not _is_sentence(text))


@pytest.mark.parametrize("name", SPEAKERS)
def test_every_sentence_is_in_the_table(name: str) -> None:
    found = _sentences(ROOT / name)
    missing = [p for text in found for p in untranslated(text) if re.search("[a-z]{2}", p)]
    assert missing == [], f"not in {PHRASES.name}; add them with their Chinese"


def _words_of_both() -> set[str]:
    """Words that the Chinese sentences have, too: names of commands, files and settings."""
    table: dict[str, str] = json.loads(PHRASES.read_text())
    return {word for chinese in table.values() for word in WORD.findall(_GAPS.sub("", chinese))}


@pytest.mark.parametrize("name", SPEAKERS)
def test_no_part_of_a_sentence_stays_english(name: str) -> None:
    """Words before a colon were taken for a name: "the ball", and whole sentences."""
    left = {
        text: set(WORD.findall(COMMANDS.sub("", in_language(text, "zh")))) - _words_of_both()
        for text in (*_sentences(ROOT / name), *_short_choices(ROOT / name))
    }
    assert {text: words for text, words in left.items() if words} == {}


@pytest.mark.parametrize("name", SPEAKERS)
def test_what_is_put_at_the_end_of_a_sentence_is_in_the_table(name: str) -> None:
    """It became a part of a gap."""
    known = [_GAPS.sub(_GAP, english) for english in json.loads(PHRASES.read_text())]
    ends = _ends_of_sentences(ROOT / name)
    assert [end for end in ends if not any(end in sentence for sentence in known)] == []


def test_every_part_of_the_body_has_a_chinese_name() -> None:
    parts = {part_in_words(name) for name in load_model().part_names}
    named = [part for part in parts if not untranslated(part)]
    assert {"left forearm", "right foot", "chest", "head"} <= set(named)
    assert [p for p in parts if untranslated(p) and not re.search("thumb|finger|palm", p)] == []


def test_gaps_of_both_languages_are_the_same() -> None:
    for english, chinese in json.loads(PHRASES.read_text()).items():
        assert sorted(re.findall(r"\{\w+\}", english)) == sorted(re.findall(r"\{\w+\}", chinese))
        assert re.search("[\u4e00-\u9fff（：]", chinese)


def test_no_sentence_has_two_translations() -> None:
    """The later one held: a person's back was "backward", as a camera moves."""
    english = [one for one, _ in json.loads(PHRASES.read_text(), object_pairs_hook=list)]
    assert len(english) == len(set(english))
    assert in_language("the cameras saw only 9 % of the person's back", "zh") == (
        "相机只看到人体背面的 9 %"
    )
    moved = f"camera a has moved since it was calibrated: {move_words(_BACK)}"
    assert in_language(moved, "zh") == "相机 a 自校准以来移动了：约 9 毫米（主要向后）"


def test_sentences_are_said_in_chinese() -> None:
    assert in_language(SPOKEN[0], "en") == SPOKEN[0]
    assert in_language(SPOKEN[0], "zh") == "相机只看到左前臂的 12 %"
    assert in_language(SPOKEN[1], "zh") == "相机 back-upper：它的时间戳停住不动；请拔下传感器再插上"
    assert in_language(SPOKEN[2], "zh").startswith(
        "相机 a 没有图像（a 没有发送图像；正在重新打开）；"
    )
    assert in_language(SPOKEN[4], "zh") == "what nobody ever said；请重新扫描"
    assert in_language(SPOKEN[5], "zh") == (
        "按此校准，高度误差可达 9.1 毫米，而限值为 5.0 毫米"
        "（calibrate.height_limit_m）：请多挥一会儿球"
    )


def test_what_follows_a_colon_is_said_in_chinese_too() -> None:
    for text in SPOKEN[8:]:
        assert not re.search(
            "[a-z]{3,} [a-z]{3,} [a-z]{3,}",
            re.sub(r"\(.*?\)|station calibrate \S+", "", in_language(text, "zh")),
        )


def test_parts_of_a_calibrations_sentences_are_said_in_chinese() -> None:
    """Advice, frames that wait, and what is said of the camera that is the reference."""
    covered = Coverage(default_rig().cameras, "front-upper", 0.1)
    assert in_language(_wave_line(covered, 12.0, 6), "zh") == (
        "已覆盖   0 %，12 秒：把球放在 front-lower 前（已清楚看到 0 次，共需 120 次）"
    )
    # A camera was named that had seen the ball in frames that nobody had looked at.
    assert in_language(_wave_line(covered, 12.0, 351), "zh") == (
        "已覆盖   0 %，12 秒：还有 351 帧待处理"
    )
    assert in_language(_rest_line(["front", "back"]), "zh") == "看到静止的球：front, back"
    assert in_language(_rest_line([]), "zh") == "还没有看到静止的球"
    assert in_language("front: reference; off by 1.1 mm in 22 tests", "zh") == (
        "front：参考相机；22 次检验中偏差 1.1 毫米"
    )


def test_names_stay_as_they_are() -> None:
    """Also those that are words of the table."""
    assert in_language(SPOKEN[6], "zh") == "相机 front 没有图像；请检查它的电缆"
    assert in_language(SPOKEN[7], "zh") == "没有标签为 head 的扫描"
