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
        ("a=" + "[" * 5000, "is not TOML: a number or brackets in brackets"),
        (
            _CAMERA + "[workers]\ncount = " + "9" * 5000,
            "is not TOML: a number or brackets in brackets",
        ),
        (_CAMERA + "colour = true", "unknown key cameras.0.colour; allowed here: name, driver"),
        (_CAMERA + "[sync]\ntolerence_s = 1", "unknown key sync.tolerence_s; allowed here: tol"),
        (_CAMERA + "[sync]\ntolerance_s = -1", "sync.tolerance_s: must be greater than 0"),
        (_CAMERA + "[sync]\ntolerance_s = nan", "sync.tolerance_s"),
        (_CAMERA + "[workers]\nmethod = 'magic'", "'joint' or 'paper'"),
        (_CAMERA + "[volume]\nmin_m = [1, 1, 1]\nmax_m = [0, 2, 2]", "max_m must exceed min_m"),
        (_CAMERA + _CAMERA, "the camera name front is used twice"),
        (_CAMERA + "[calibrate]\nball_radius_m = 0.06", "not found reliably beyond 2.4 m"),
        (_CAMERA.replace("front", "../front", 1), "letters, digits"),
        (_CAMERA.replace("front", "-front", 1), "does not begin with '-'"),
        (_CAMERA.replace("front", 41 * "a", 1), "1 to 40 letters"),
        (
            _CAMERA.replace('"recorded"', '"kinect9"'),
            "no driver 'kinect9'; installed: freenect, recorded, virtual",
        ),
        (_CAMERA.replace("recording =", "serial ="), "cameras.0.recording is missing"),
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
