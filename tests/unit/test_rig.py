import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from station.core.depth.correction import DepthCorrection
from station.core.depth.field import DepthField
from station.core.errors import CalibrationError, FormatError
from station.core.geometry import se3_exp
from station.core.rig import CameraCalibration, PredictedError, Rig


def make_rig() -> Rig:
    camera = CameraCalibration(
        name="front-upper",
        serial="A001",
        model="kinect-v1",
        width=640,
        height=480,
        K=np.array([[585.0, 0.0, 320.0], [0.0, 585.0, 240.0], [0.0, 0.0, 1.0]]),
        distortion=np.zeros(5),
        depth_correction=DepthCorrection((0.001, 0.99)),
        world_from_camera=se3_exp([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]),
        covariance=np.eye(6) * 1e-6,
    )
    return Rig("2026-11-21T10:00:00Z", "front-upper", {camera.name: camera}, 0.0017)


def test_round_trip_is_exact(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    make_rig().save(path)
    found, expected = Rig.load(path).cameras["front-upper"], make_rig().cameras["front-upper"]
    assert np.array_equal(found.world_from_camera, expected.world_from_camera)
    assert found.covariance is not None
    assert found.covariance[0, 0] == 1e-6
    assert found.depth_correction == expected.depth_correction


def test_a_serial_number_that_is_not_known_is_empty(tmp_path: Path) -> None:
    """It was "None"."""
    path = tmp_path / "calibration.json"
    make_rig().save(path)
    document = json.loads(path.read_text())
    document["cameras"]["front-upper"]["serial"] = None
    path.write_text(json.dumps(document))
    assert Rig.load(path).cameras["front-upper"].serial == ""


def test_corrections_and_predicted_errors_are_read_again(tmp_path: Path) -> None:
    """The calibration's own errors have to reach the measurements' intervals."""
    control = np.random.default_rng(3).normal(0.0, 1e-3, (3, 4, 5))
    field = DepthField((0.4, 0.7, 1.0), control)
    gradient = DepthCorrection((0.01, 1.0), (0.02, -0.03))
    correction = DepthCorrection((0.0, 1.0), (0.0, 0.0), field)
    rig = make_rig()
    upper = replace(rig.cameras["front-upper"], depth_correction=correction)
    lower = replace(upper, name="front-lower", depth_correction=gradient)
    predicted = PredictedError(2e-3, 1e-3, 5e-4, 1e-3)
    path = tmp_path / "calibration.json"
    cameras = {camera.name: camera for camera in (upper, lower)}
    replace(rig, cameras=cameras, predicted=predicted).save(path)
    found = Rig.load(path)
    assert found.predicted == predicted
    assert found.cameras[lower.name].depth_correction == gradient
    depth = np.full((12, 16), 1.6, np.float32)
    again = found.cameras[upper.name].depth_correction
    assert np.array_equal(again.apply(depth), correction.apply(depth))


def _set(*keys: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        for key in keys[:-1]:
            document = document[key]
        document[keys[-1]] = value

    return change


_CAMERA = ("cameras", "front-upper")
_PREDICTED = PredictedError(2e-3, 1e-3, 5e-4, 1e-3).to_json()
_WRONG_K = [
    (0, 1, 300.0, "K must have the form [[fx, 0, cx]"),
    (1, 0, 300.0, "K must have the form [[fx, 0, cx]"),
    (2, 0, 1.0, "K must have the form [[fx, 0, cx]"),
    (2, 2, 5.0, "K must have the form [[fx, 0, cx]"),
    (0, 0, 60.0, "fx and fy within a factor of 3"),
    (1, 1, 1e-9, "beyond 1 pixel"),
    (0, 2, 1e9, "less than an image's size away"),
    (1, 2, -481.0, "less than an image's size away"),
]


def _k(row: int, column: int, value: float) -> list[list[float]]:
    K = make_rig().cameras["front-upper"].K.copy()
    K[row, column] = value
    return [[float(number) for number in numbers] for numbers in K]


def _afar(distance_m: float) -> list[list[float]]:
    pose = np.eye(4)
    pose[1, 3] = distance_m
    return [[float(number) for number in numbers] for numbers in pose]


def _correction(coefficients: object) -> Callable[[dict[str, Any]], None]:
    return _set(
        *_CAMERA,
        "depth_correction",
        value={"model": "inverse-depth-poly", "coefficients": coefficients},
    )


def _field(
    knots: list[float] | None = None, rows: int = 3, control: float = 0.0
) -> Callable[[dict[str, Any]], None]:
    knots = knots or [0.5, 1.0]
    fields = {
        "model": "inverse-depth-field",
        "coefficients": [0.0, 1.0],
        "inverse_depth_per_m": knots,
        "control_per_m": np.full((len(knots), rows, 3), control).tolist(),
    }
    return _set(*_CAMERA, "depth_correction", value=fields)


def _nested(depth: int) -> list[Any]:
    return [_nested(depth - 1)] if depth else []


def _named(name: str) -> Callable[[dict[str, Any]], None]:
    return lambda document: document["cameras"].update({name: document["cameras"]["front-upper"]})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_set(*_CAMERA, "K", value=[[1, 0], [0, 1]]), "K must be (3, 3)"),
        (_set(*_CAMERA, "K", value=np.zeros((3, 3)).tolist()), "positive focal lengths"),
        (_set(*_CAMERA, "world_from_camera", value=np.ones((4, 4)).tolist()), "not a rigid"),
        (
            _set(*_CAMERA, "world_from_camera", value=np.diag([1, 1, -1, 1]).tolist()),
            "not a rigid",
        ),
        (_set(*_CAMERA, "depth_correction", value={"model": "spline"}), "'spline' is unknown"),
        (_set(*_CAMERA, "distortion", value=[0, 0, 0, 0, None]), "distortion must be"),
        *((_set(*_CAMERA, "K", value=_k(i, j, value)), words) for i, j, value, words in _WRONG_K),
        (_set(*_CAMERA, "distortion", value=[0, 0, 0, 0, -1e4]), "distortion must lie within"),
        (_set(*_CAMERA, "width", value=640.5), "width and height must be whole numbers"),
        (_set(*_CAMERA, "height", value="480"), "width and height must be whole numbers"),
        (_set(*_CAMERA, "world_from_camera", value=_afar(101.0)), "within 100 m"),
        (_correction([0.0, -1.0]), "must leave readings between 0.5 and 4 m"),
        (_correction([0.0]), "must leave readings between 0.5 and 4 m"),
        (_correction([1e-9] * 17), "needs 1 to 16 finite coefficients"),
        (_correction([]), "needs 1 to 16 finite coefficients"),
        # What Python says of these names neither the camera nor the field.
        (_set(*_CAMERA, "K", value=[[1, 2], [3]]), "camera front-upper: K must be (3, 3)"),
        (_set(*_CAMERA, "K", value=[["585", 0, 320], [0, 585, 240], [0, 0, 1]]), "K must be"),
        (_set(*_CAMERA, "K", value=_nested(900)), "camera front-upper: K must be (3, 3)"),
        (_set(*_CAMERA, "width", value=None), "front-upper: width and height must be whole"),
        (_set(*_CAMERA, "serial", value=7), "front-upper: serial is 7, not text"),
        (_set(*_CAMERA, "model", value="\ud800"), "front-upper: model has characters that no file"),
        (_set(*_CAMERA, "depth_correction", value=None), "front-upper: depth_correction must be"),
        (
            _set(*_CAMERA, value={"serial": "A001"}),
            "camera front-upper: the field 'world_from_camera' is missing",
        ),
        (_set(*_CAMERA, value="A001"), "camera front-upper: it must have named fields"),
        (_correction("01"), "needs 1 to 16 finite coefficients"),
        (_field(knots=[1.0, 0.5]), "inverse_depth_per_m must be two or more increasing"),
        (_field(rows=65), "control_per_m must have"),
        (_field(control=1e300), "numbers within 100 of 0"),
        (_set("residual_rms_m", value="2 mm"), 'residual_rms_m is "2 mm", not a number'),
        (_set("reference", value=[]), "reference is a list, not text"),
        *(
            (_named(name), "its name must be one of a folder")
            for name in ("../x", "", "a\\b", "\n")
        ),
        (_set("reference", value="nobody"), "reference 'nobody' is none of its cameras (front"),
        (_set("residual_rms_m", value=float("nan")), "residual_rms_m must be finite"),
        (_set("residual_rms_m", value=-1.0), "residual_rms_m must be finite"),
        (_set("predicted", value={**_PREDICTED, "girth_sigma_m": 2.0}), "girth_sigma_m must lie"),
        (_set("predicted", value={**_PREDICTED, "tilt_sigma_rad": 4.0}), "tilt_sigma_rad must lie"),
        (_set("predicted", value={**_PREDICTED, "normal_rms_m": -1.0}), "normal_rms_m must lie"),
        (_set("cameras", value={}), "no camera"),
        (_set("cameras", value=[1]), "cameras must be named"),
        (lambda document: document.pop("reference"), "'reference' is missing"),
    ],
)
def test_an_unusable_calibration_is_named(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], words: str
) -> None:
    document = make_rig().to_json()
    change(document)
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(document))
    with pytest.raises(FormatError) as raised:
        Rig.load(path)
    assert words in str(raised.value)
    assert str(path) in str(raised.value)


def test_an_unknown_camera_is_named_with_the_known_ones() -> None:
    with pytest.raises(CalibrationError, match=r"camera left .*it has: front-upper"):
        make_rig().camera("left")
