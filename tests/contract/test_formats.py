"""Documents on disk against the schemas that ship; the result folder as a reader sees it."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pygltflib as gltf
import pytest
import trimesh

from station.core.bundle import read_bundle
from workers.cloud.preprocess import preprocess
from workers.reconstruct.job import reconstruct_bundle, reconstruct_cloud
from workers.scape.model.body_model import load_model

README = Path(__file__).parents[2] / "README.md"
SHA = "0" * 64
SCHEMAS = {
    "result": "workers.export",
    "measurements": "workers.export",
    "bundle": "station.core",
    "calibration": "station.core",
}
IDENTITY = np.eye(4).tolist()
CAMERA = {
    "serial": "A00362",
    "model": "kinect-v1",
    "width": 640,
    "height": 480,
    "K": [[585.0, 0, 319.5], [0, 585.0, 239.5], [0, 0, 1]],
    "distortion": [0, 0, 0, 0, 0],
    "depth_correction": {"model": "inverse-depth-poly", "coefficients": [0.001, 0.998]},
    "world_from_camera": IDENTITY,
    "covariance": None,
}
FRAME = {
    "file": "depth/front-upper/000.png",
    "device_ticks": 123456789,
    "tick_hz": 60000000,
    "host_time_s": 1234.567,
    "sequence": 4711,
}
DOCUMENTED: dict[str, dict[str, Any]] = {
    "calibration": {
        "format": "booth-calibration",
        "version": 1,
        "created": "2026-11-21T10:00:00Z",
        "reference": "front-upper",
        "cameras": {
            "front-upper": CAMERA,
            "back-upper": {**CAMERA, "depth_correction": {"model": "none"}},
        },
        "residual_rms_m": 0.0017,
    },
    "bundle": {
        "format": "booth-bundle",
        "version": 1,
        "scan_id": "20261121T100000Z-7f3a",
        "created": "2026-11-21T10:00:00Z",
        "label": "Order 7",
        "depth_scale_m": 0.001,
        "cameras": {"front-upper": {"frames": [FRAME]}},
        "sync": {"spread_s_max": 0.012},
    },
    "measurements": {
        "format": "booth-measurements",
        "version": 1,
        "scan_id": "20261121T100000Z-7f3a",
        "pose": "as-scanned",
        "measurements": [
            {
                "name": "waist_girth",
                "standard": "ISO 8559-1:2017 5.3.10",
                "value_m": 0.842,
                "interval95_m": [0.834, 0.850],
                "path": [[0.1, 0.2, 1.1], [0.2, 0.1, 1.1], [0.1, 0.1, 1.1]],
                "closed": True,
            }
        ],
    },
    "result": {
        "format": "booth-result",
        "version": 1,
        "scan_id": "20261121T100000Z-7f3a",
        "status": "ok",
        "reasons": [],
        "model": {"name": "booth-scape", "sha256": SHA},
        "shape": [0.1, -1.2],
        "pose": {"pelvis": [0.0, 0.1, 0.0]},
        "translation": [0.0, 0.0, 0.95],
        "quality": {
            "point_to_surface_rms_m": 0.0021,
            "coverage": 0.83,
            "correspondences": 9123,
        },
        "iterations": 10,
        "seconds": {
            "load": 0.1,
            "preprocess": 0.1,
            "icp": 0.3,
            "optimise": 0.2,
            "measure": 0.1,
            "export": 0.1,
            "total": 0.9,
        },
        "files": {
            "mesh.ply": SHA,
            "mesh.obj": SHA,
            "mesh.glb": SHA,
            "cloud.ply": SHA,
            "measurements.json": SHA,
            "preview.png": SHA,
        },
    },
}
"""The smallest documents that the formats allow."""


def _validator(name: str) -> jsonschema.Draft202012Validator:
    text = resources.files(SCHEMAS[name]).joinpath(f"schemas/{name}.schema.json").read_text()
    schema = json.loads(text)
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("name", sorted(SCHEMAS))
def test_what_is_documented_is_valid(name: str) -> None:
    _validator(name).validate(DOCUMENTED[name])


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("result", {"version": 2}),
        ("result", {"status": "perhaps"}),
        ("result", {"status": "rescan"}),
        ("result", {"reasons": ["the cameras saw only 5 % of the left forearm"]}),
        ("result", {"label": 7}),
        ("measurements", {"verdict": {"status": "perhaps", "reasons": []}}),
        ("measurements", {"verdict": {"status": "ok", "reasons": [], "notes": "hair"}}),
        ("result", {"files": {"mesh.ply": SHA}}),
        ("result", {"translation": [0.0, 0.0]}),
        ("measurements", {"pose": "sitting"}),
        ("measurements", {"measurements": []}),
        ("measurements", {"measurements": [{"name": "waist_girth", "value_m": 0.8}]}),
        ("bundle", {"depth_scale_m": 0}),
        ("bundle", {"cameras": {"front": {"frames": [{**FRAME, "sequence": -1}]}}}),
        ("calibration", {"cameras": {}}),
        ("calibration", {"cameras": {"front": {**CAMERA, "K": [[1, 2], [3, 4]]}}}),
        ("calibration", {"cameras": {"front": {**CAMERA, "covariance": [[1.0]]}}}),
    ],
)
def test_what_is_wrong_is_refused(name: str, change: dict[str, Any]) -> None:
    with pytest.raises(jsonschema.ValidationError):
        _validator(name).validate({**DOCUMENTED[name], **change})


@pytest.fixture(scope="module")
def result(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("result")
    reconstruct_bundle(bundle, folder)
    return folder


def _read(path: Path) -> dict[str, Any]:
    document = json.loads(path.read_text())
    assert isinstance(document, dict)
    return document


def test_a_bundle_follows_its_schemas(bundle: Path) -> None:
    _validator("bundle").validate(_read(bundle / "bundle.json"))
    _validator("calibration").validate(_read(bundle / "calibration.json"))


def test_a_result_follows_its_schemas(result: Path) -> None:
    whole = _read(result / "result.json")
    _validator("result").validate(whole)
    origin = {key: whole[key] for key in ("scan_id", "label", "created", "booth", "calibration")}
    for path in result.glob("measurements*.json"):
        document = _read(path)
        _validator("measurements").validate(document)
        assert list(document)[2:8] == [*origin, "verdict"]
        assert origin.items() <= document.items()
        assert document["verdict"]["status"] == whole["status"]
        assert {row["basis"] for row in document["measurements"]} <= {"seen", "partly", "inferred"}
        for row in document["measurements"]:
            low, high = row["interval95_m"]
            assert low <= row["value_m"] <= high, row["name"]


def test_a_bare_clouds_result_follows_its_schemas_too(bundle: Path, tmp_path: Path) -> None:
    """It once lacked the seconds of a step that clouds do not need."""
    reconstruct_cloud(preprocess(read_bundle(bundle)).cloud, "a cloud", tmp_path)
    _validator("result").validate(_read(tmp_path / "result.json"))


def test_every_file_is_named_with_its_hash(result: Path) -> None:
    document = _read(result / "result.json")
    there = {path.name for path in result.iterdir()} - {"result.json"}
    assert set(document["files"]) == there
    table = README.read_text().partition("\nA **result** holds:\n")[2].partition("\n\nWorld")[0]
    named = [cell for row in table.split("\n") for cell in row.split("|")[1:2]]
    assert set(re.findall(r"`([^`]+)`", "".join(named))) == {*there, "result.json"}
    for name, digest in document["files"].items():
        assert hashlib.sha256((result / name).read_bytes()).hexdigest() == digest


def test_all_meshes_are_one_closed_body(result: Path) -> None:
    faces = load_model().faces
    ply = trimesh.load_mesh(result / "mesh.ply", process=False)
    assert ply.is_watertight
    assert ply.is_winding_consistent
    assert ply.volume > 0.03
    assert np.array_equal(ply.faces, faces)
    obj = trimesh.load_mesh(result / "mesh.obj", process=False, maintain_order=True)
    assert obj.is_watertight
    assert np.array_equal(obj.faces, faces)
    assert np.abs(obj.vertices - ply.vertices).max() < 1e-6
    for name in ("mesh.glb", "avatar.glb"):
        glb = trimesh.load_scene(result / name).geometry["body"]
        upright = glb.vertices @ np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
        assert np.abs(upright - ply.vertices).max() < 1e-6
    cloud = trimesh.load(result / "cloud.ply")
    assert len(cloud.vertices) > 10_000


def test_every_export_says_whose_it_is(bundle: Path, tmp_path: Path) -> None:
    """A label is a customer's text: it stays on its line."""
    manifest = _read(bundle / "bundle.json")
    copy = tmp_path / "bundle"
    shutil.copytree(bundle, copy)
    label = "Größe 7\nend_header\u0007"
    (copy / "bundle.json").write_text(json.dumps({**manifest, "label": label, "booth": "Nord"}))
    out = tmp_path / "out"
    out.mkdir()
    reconstruct_bundle(copy, out)
    quoted = json.dumps(label).encode()
    for name in ("mesh.ply", "mesh.obj", "cloud.ply"):
        lines = (out / name).read_bytes()[:2000].splitlines()
        assert any(line.endswith(b"label " + quoted) for line in lines), name
        assert any(
            line.endswith(b"created " + json.dumps(manifest["created"]).encode()) for line in lines
        )
    for name in ("mesh.glb", "avatar.glb"):
        extras = gltf.GLTF2().load(out / name).asset.extras
        assert (extras["label"], extras["booth"]) == (label, "Nord")
        assert extras["verdict"]["status"] == "ok"
    assert _read(out / "result.json")["label"] == label
    assert trimesh.load_mesh(out / "mesh.ply", process=False).is_watertight
