import codecs
import re
from pathlib import Path

import pytest

from station.core.config_file import load_config
from station.core.errors import ConfigError

_CAMERA = """
[[cameras]]
name = "front"
driver = "recorded"
recording = "recordings/front"
"""


def _load(tmp_path: Path, text: str) -> object:
    path = tmp_path / "booth.toml"
    path.write_text(text)
    return load_config(path)


def test_relative_paths_belong_to_the_file(tmp_path: Path) -> None:
    """A station started by systemd has another working folder than the operator's shell."""
    path = tmp_path / "booth.toml"
    path.write_text(_CAMERA)
    config = load_config(path)
    assert config.camera("front").model_dump()["recording"] == tmp_path / "recordings/front"
    assert config.spool.folder == tmp_path / "spool"
    assert config.calibration == tmp_path / "calibration.json"
    assert config.runtime.folder == tmp_path / "run"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "cameras is missing"),
        ("cameras = 3", "cameras"),
        ("[[cameras]", "is not TOML"),
        ("a=" + "[" * 5000, "is not TOML: it has brackets in brackets"),
        (_CAMERA + "[workers]\ncount = " + "9" * 5000, "is not TOML: it has a number of thousands"),
        (_CAMERA + "[spool]\n[spool]", "is not TOML: Cannot declare spool twice (at line 7"),
        (_CAMERA + "[sync]\nlive_hz = 2,5", "(live_hz = 2,5: write a point, 1.8)"),
        (
            _CAMERA + "[sync]\nlive_hz = '2.5'",
            'live_hz: must be a number, without quotes (found "2',
        ),
        (
            _CAMERA + "[workers]\ncount = true",
            "must be a whole number, without quotes (found true)",
        ),
        (_CAMERA + "[drift]\nrefuse_scans = 1", "must be true or false, without quotes (found 1)"),
        (_CAMERA + "[spool]\nfolder = 3", "spool.folder: must be a path in quotes (found 3)"),
        (_CAMERA + '[spool]\nfolder = "a\\u0000"', "spool.folder: must be a path without control"),
        (_CAMERA + '[runtime]\nfolder = "D:\\temp"', "runtime.folder: must be a path without"),
        ("spool = 3\n" + _CAMERA, "spool: must be a section with keys of its own (found 3)"),
        ("name = 3\n" + _CAMERA, "name: must be a text in quotes (found 3)"),
        (f"name = '{61 * 'a'}'\n" + _CAMERA, "name: must have at most 60 characters"),
        (_CAMERA + "[volume]\nmin_m = 3", "volume.min_m: must be a list in brackets (found 3)"),
        (_CAMERA + "[volume]\nmin_m = [1, 2, 3, 4]", "min_m: must have at most 3 values (found [1"),
        (_CAMERA + "[deliver]\nname = 'o'", "deliver: there can be several; write [[deliver]]"),
        (_CAMERA + "colour = true", "unknown key cameras[1].colour; allowed here: name, driver"),
        (_CAMERA + "[sync]\ntolerence_s = 1", "unknown key sync.tolerence_s; allowed here: tol"),
        (_CAMERA + "[sync]\ntolerance_s = -1", "sync.tolerance_s: must be greater than 0"),
        (_CAMERA + "[sync]\ntolerance_s = nan", "sync.tolerance_s"),
        (_CAMERA + "[workers]\nmethod = 'magic'", "'joint' or 'paper'"),
        (_CAMERA + "[volume]\nmin_m = [1, 1, 1]\nmax_m = [0, 2, 2]", "max_m must exceed min_m"),
        (_CAMERA + _CAMERA, "the camera name front is used twice"),
        (_CAMERA + '[calibrate]\nfront = ["{x}"]', "calibrate names {x}, which is not a camera"),
        (_CAMERA + "[calibrate]\nwaving_s = 15", "calibrate.waving_s: must be at least 16 s: in"),
        (_CAMERA + "[calibrate]\nwaving_s = nan", "calibrate.waving_s"),
        (_CAMERA + "[calibrate]\nball_radius_m = 0.06", "not found reliably beyond 2.4 m"),
        (_CAMERA + "[calibrate]\nball_radius_m = 0.2", "radius, which is half its diameter"),
        (_CAMERA.replace("front", "../front", 1), "letters, digits"),
        (_CAMERA.replace("front", "-front", 1), "does not begin with '-'"),
        (_CAMERA.replace("front", 41 * "a", 1), "1 to 40 letters"),
        (
            _CAMERA.replace('"recorded"', '"kinect9"'),
            "no driver 'kinect9'; installed: freenect, recorded, virtual",
        ),
        (_CAMERA.replace("recording =", "serial ="), "cameras[1].recording is missing"),
        ("version = 2\n" + _CAMERA, "version"),
    ],
)
def test_an_impossible_value_names_the_file_and_the_key(
    tmp_path: Path, text: str, words: str
) -> None:
    with pytest.raises(ConfigError) as raised:
        _load(tmp_path, text)
    assert words in str(raised.value)
    assert "booth.toml" in str(raised.value)
    assert "\n" not in str(raised.value)
    assert not re.search("Input|parse|valid|Tuple|class|Path|codec|\\(found {", str(raised.value))


@pytest.mark.parametrize("mark", [b"", codecs.BOM_UTF8])
def test_a_file_of_any_editor_is_read(tmp_path: Path, mark: bytes) -> None:
    path = tmp_path / "booth.toml"
    path.write_bytes(mark + _CAMERA.replace("\n", "\r\n").encode())
    assert load_config(path).camera("front")


def test_a_file_in_another_encoding_is_told_so(tmp_path: Path) -> None:
    path = tmp_path / "booth.toml"
    path.write_bytes(_CAMERA.encode("utf-16"))
    with pytest.raises(ConfigError, match=r"booth\.toml is not text in UTF-8; save it as UTF-8"):
        load_config(path)


def test_a_missing_file_says_what_writes_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"station setup"):
        load_config(tmp_path / "booth.toml")


def test_an_unknown_camera_is_named(tmp_path: Path) -> None:
    path = tmp_path / "booth.toml"
    path.write_text(_CAMERA)
    with pytest.raises(ConfigError, match="camera rear is not in the configuration"):
        load_config(path).camera("rear")


def test_the_example_is_a_booth() -> None:
    example = Path(__file__).parents[2] / "deploy/booth.example.toml"
    config = load_config(example)
    assert len(config.cameras) == 4
    assert config.volume.max_m == (0.95, 0.75, 2.2)


def test_a_folder_may_have_spaces_of_any_script(tmp_path: Path) -> None:
    path = tmp_path / "booth.toml"
    path.write_text(_CAMERA + '[spool]\nfolder = "\u6d4b\u91cf\u3000\u4e00"\n')
    assert load_config(path).spool.folder.name == "\u6d4b\u91cf\u3000\u4e00"
