"""The fit on a body that the model was not trained on, seen through the simulated sensors."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from station.core.bundle import read_bundle
from station.core.errors import InputError
from station.core.geometry import so3_exp
from station.simulation.scene import Mesh, load_mesh
from station.simulation.sensor import render_bundle
from workers.cloud.cloud_file import read_cloud
from workers.cloud.observed import PointCloud, Preprocessed
from workers.cloud.outwards import oriented
from workers.cloud.preprocess import preprocess
from workers.measure.body import measure_body
from workers.reconstruct.job import reconstruct_bundle
from workers.scape.fit.fit import FitResult, fit_body, sampling_of
from workers.scape.fit.initial import starting_states
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.surface.intersections import self_intersections, turned_over

BODIES = Path(__file__).parents[2] / "station/simulation/bodies"


@pytest.fixture(scope="module")
def fitted(model: BodyModel, bundle: Path) -> FitResult:
    return fit_body(model, preprocess(read_bundle(bundle)))


def _distance_to(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    return scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()


def _extremities(model: BodyModel) -> np.ndarray:
    """Mask (P,) of hands and feet."""
    names = np.array(model.part_names)[model.part_of_vertex]
    return np.array([n.startswith(("hand", "thumb", "fingers", "foot")) for n in names])


def test_the_cloud_lies_on_the_body(bundle: Path) -> None:
    cloud = preprocess(read_bundle(bundle)).cloud
    body = np.load(BODIES / "ben.npz")
    away = _distance_to(body["vertices"], body["faces"], cloud.points)
    assert np.sqrt(np.mean(away**2)) < 0.002


def test_the_fit_lies_on_the_body(model: BodyModel, fitted: FitResult) -> None:
    truth = np.load(BODIES / "ben.npz")["vertices"]
    away = _distance_to(fitted.vertices, model.faces, truth)
    assert np.sqrt(np.mean(away[~_extremities(model)] ** 2)) < 0.003
    assert abs(np.ptp(fitted.vertices[:, 2]) - np.ptp(truth[:, 2])) < 0.004


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_fingers_are_as_long_as_they_are(
    model: BodyModel, fitted: FitResult, side: str
) -> None:
    """Their tips give no readings; they came out a centimetre short."""
    truth = np.load(BODIES / "ben.npz")["vertices"]
    line = [model.landmarks[f"{name}_{side}"] for name in ("knuckle", "finger_joint", "fingertip")]
    found, true = (
        np.linalg.norm(np.diff(body[line], axis=0), axis=1).sum()
        for body in (fitted.vertices, truth)
    )
    assert abs(found - true) < 0.005


def test_the_mesh_is_watertight_and_not_folded(model: BodyModel, fitted: FitResult) -> None:
    edges = np.sort(model.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 2).all()
    assert np.isfinite(fitted.vertices).all()
    assert self_intersections(fitted.vertices, model.faces) == 0
    assert not turned_over(fitted.vertices, model.vertices(fitted.state), model.faces).any()


def test_same_input_same_output(model: BodyModel, bundle: Path, fitted: FitResult) -> None:
    again = fit_body(model, preprocess(read_bundle(bundle)))
    assert again.vertices.tobytes() == fitted.vertices.tobytes()


def test_a_body_is_found_from_the_eighth_start(
    model: BodyModel, bundle: Path, fitted: FitResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the first five, arms of three of 928 sound clouds were lost."""
    start = next(
        iter(
            starting_states(
                model, sampling_of(model).body.first(250), *2 * [fitted.cloud.points[::100]]
            )
        )
    )
    lost = replace(start, rotations=so3_exp(np.array([0.0, 0.0, 0.5 * np.pi])) @ start.rotations)
    monkeypatch.setattr("workers.scape.fit.fit.starting_states", lambda *_: [lost] * 7 + [start])
    assert fit_body(model, preprocess(read_bundle(bundle))).verdict.status == "ok"


def test_the_mesh_is_the_same_whatever_the_thread_count(bundle: Path, tmp_path: Path) -> None:
    meshes = []
    for threads in ("1", "4"):
        out = tmp_path / threads
        variables = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
        subprocess.run(
            [sys.executable, "-m", "workers.cli", "fit", str(bundle), "--out", str(out), "--quiet"],
            env={**os.environ, **dict.fromkeys(variables, threads)},
            check=True,
            timeout=120,
        )
        meshes.append((out / "mesh.ply").read_bytes())
    assert meshes[0] == meshes[1]


def test_an_error_beside_the_fit_is_not_lost(
    model: BodyModel, bundle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Patches are searched in a thread of their own."""

    def broken(*_: object) -> None:
        raise InputError("no patches")

    monkeypatch.setattr("workers.scape.fit.fit.unmatched_patches", broken)
    with pytest.raises(InputError, match="no patches"):
        fit_body(model, preprocess(read_bundle(bundle)))


def test_a_file_that_cannot_be_written_leaves_no_result(
    model: BodyModel, bundle: Path, tmp_path: Path
) -> None:
    """Files are written in a thread of their own."""
    (tmp_path / "mesh.obj").mkdir()
    with pytest.raises(OSError, match=r"mesh\.obj"):
        reconstruct_bundle(bundle, tmp_path, model=model)
    assert not (tmp_path / "result.json").exists()


def test_the_steps_of_all_stages_are_counted(model: BodyModel, bundle: Path) -> None:
    """result.json told those of the last stage."""
    told: list[str] = []
    scan = preprocess(read_bundle(bundle))
    fit = fit_body(model, scan, observer=lambda stage, _: told.append(stage))
    assert fit.iterations == told.count("correspondences")


def test_one_thread_of_blas_filters_too(
    model: BodyModel, bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two waited for each other busily, and took a tenth of the processor time of a scan."""

    def refused(*_: object) -> None:
        blas = [library for library in threadpool_info() if library["user_api"] == "blas"]
        raise InputError(f"threads: {sorted({library['num_threads'] for library in blas})}")

    monkeypatch.setattr("workers.reconstruct.job.preprocess", refused)
    with threadpool_limits(2, "blas"), pytest.raises(InputError, match=r"threads: \[1\]"):
        reconstruct_bundle(bundle, tmp_path, model=model)


@pytest.mark.parametrize("turn_deg", [180.0, -80.0])
def test_a_person_may_face_any_way(model: BodyModel, bundle: Path, turn_deg: float) -> None:
    """Scanners have fronts of their own, and people misunderstand where to look."""
    cloud = preprocess(read_bundle(bundle)).cloud
    turn = so3_exp([0.0, 0.0, np.radians(turn_deg)])
    turned = replace(cloud, points=cloud.points @ turn.T, normals=cloud.normals @ turn.T)
    fit = fit_body(model, Preprocessed(turned, (), ()))
    truth = np.load(BODIES / "ben.npz")["vertices"] @ turn.T
    away = _distance_to(fit.vertices, model.faces, truth)
    assert np.sqrt(np.mean(away**2)) < 0.004
    assert fit.verdict.status == "ok"


def test_a_cloud_without_normals_and_with_gaps_is_fitted(
    model: BodyModel, bundle: Path, tmp_path: Path
) -> None:
    """Front and back cameras see two sheets; which of their sides is out only their distance says,
    and below a foot the floor.
    """
    seen = preprocess(read_bundle(bundle)).cloud
    bare = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(seen.points))
    o3d.io.write_point_cloud(tmp_path / "bare.ply", bare)
    cloud = read_cloud(tmp_path / "bare.ply", "z")
    assert np.mean(np.einsum("ni,ni->n", cloud.normals, seen.normals) > 0.0) > 0.95
    ahead = np.where(seen.normals[:, 1] < 0.0, 1.0, -1.0)[:, None]
    outwards = oriented(seen.points, ahead * seen.normals)
    assert np.mean(np.einsum("ni,ni->n", outwards, seen.normals) > 0.0) > 0.95
    fit = fit_body(model, Preprocessed(cloud, (), ()))
    truth = np.load(BODIES / "ben.npz")["vertices"] - cloud.origin_m
    away = _distance_to(fit.vertices, model.faces, truth)
    assert np.sqrt(np.mean(away**2)) < 0.003
    for side in ("left", "right"):
        foot = model.part_of_vertex == model.part_names.index(f"foot_{side}")
        assert np.sqrt(np.mean(away[foot] ** 2)) < 0.004
    assert fit.verdict.status == "ok"


@pytest.mark.parametrize("side", ["back", "left"])
def test_half_a_body_has_no_rows_that_look_sound(model: BodyModel, bundle: Path, side: str) -> None:
    """Rows that need the other half are blank, and a scan again is asked."""
    seen = preprocess(read_bundle(bundle)).cloud
    front = np.char.startswith(np.array(seen.camera_names), "front")[seen.camera]
    kept = front if side == "back" else seen.points[:, 0] < 0.0
    chosen = {
        name: getattr(seen, name)[kept] for name in ("points", "normals", "sigma_m", "camera")
    }
    fit = fit_body(model, Preprocessed(replace(seen, **chosen), (), ()))
    assert fit.verdict.status == "rescan"
    assert side in " ".join(fit.verdict.reasons)
    missing = fit.verdict.missing_parts
    rows = measure_body(model, fit.overlapping, fit.vertex_sigma_m, fit.vertex_seen).rows
    girths = [row for row in rows if row.name.endswith(("waist_girth", "hip_girth", "chest_girth"))]
    assert len(girths) >= 3
    assert all(row.parts & missing for row in girths)


def test_the_paper_method_gives_a_body_too(model: BodyModel, bundle: Path) -> None:
    result = fit_body(model, preprocess(read_bundle(bundle)), method="paper")
    truth = np.load(BODIES / "ben.npz")["vertices"]
    assert np.sqrt(np.mean(_distance_to(result.vertices, model.faces, truth) ** 2)) < 0.09


def test_half_a_body_is_no_confident_one(model: BodyModel) -> None:
    """Every part of it is half seen, so the parts alone would not tell."""
    normals = vertex_normals(model.mean, model.faces)
    front = normals[:, 1] < 0.0
    count = int(front.sum())
    cloud = PointCloud(
        model.mean[front],
        normals[front],
        np.full(count, 1e-3),
        np.zeros(count, np.int16),
        ("cloud",),
    )
    verdict = fit_body(model, Preprocessed(cloud, (), ())).verdict
    assert verdict.status == "rescan"
    assert "nothing of the person's back was seen" in verdict.reasons


@pytest.mark.parametrize("cut_m", [0.04, 0.08, 0.2])
def test_legs_without_feet_do_not_end_on_the_floor(model: BodyModel, cut_m: float) -> None:
    """The fit pressed them onto it: heights were too small by all that was missing, with "ok"."""
    normals = vertex_normals(model.mean, model.faces)
    kept = model.mean[:, 2] > cut_m
    points, count = model.mean[kept] - (0.0, 0.0, cut_m), int(kept.sum())
    cloud = PointCloud(
        points, normals[kept], np.full(count, 1e-3), np.zeros(count, np.int16), ("cloud",)
    )
    fit = fit_body(model, Preprocessed(cloud, (), ()))
    assert fit.verdict.status == "rescan"
    assert any("toes of the" in reason for reason in fit.verdict.reasons)
    measured = measure_body(model, fit.overlapping, fit.vertex_sigma_m, fit.vertex_seen)
    blank = {row.name for row in measured.rows if row.parts & fit.verdict.missing_parts}
    ends_below = {"height", "crotch_height", "outside_leg_length_left", "calf_girth_right"}
    assert ends_below <= blank
    assert blank.isdisjoint({"waist_girth", "chest_girth", "head_girth", "upper_arm_girth_left"})


@pytest.mark.parametrize(
    ("cut_m", "below_m", "words"),
    [
        (0.015, 0.0, r"the feet end \d+ mm below the lowest points of the cloud"),
        (0.02, 0.0, r"the feet end \d+ mm below the lowest points of the cloud"),
        (0.0, 0.015, r"the feet end 1[3-5] mm above the floor of the cloud"),
        (0.0, 0.3, r"the feet end (29|30)\d mm above the floor of the cloud"),
    ],
)
def test_lowest_points_that_are_no_soles_do_not_pass_for_them(
    model: BodyModel, cut_m: float, below_m: float, words: str
) -> None:
    """Heights were off by as much, to +-1.3 mm, with "ok"."""
    normals = vertex_normals(model.mean, model.faces)
    kept = model.mean[:, 2] > cut_m
    points = np.concatenate([model.mean[kept], [[0.0, 0.0, cut_m - below_m]]])
    points -= (0.0, 0.0, points[:, 2].min())
    directions = np.concatenate([normals[kept], [[0.0, 0.0, -1.0]]])
    count = len(points)
    cloud = PointCloud(
        points, directions, np.full(count, 1e-3), np.zeros(count, np.int16), ("cloud",)
    )
    fit = fit_body(model, Preprocessed(cloud, (), ()))
    assert any(re.match(words, reason) for reason in fit.verdict.reasons)
    rows = measure_body(model, fit.overlapping, fit.vertex_sigma_m, fit.vertex_seen).rows
    blank = {row.name for row in rows if row.parts & fit.verdict.missing_parts}
    assert {"height", "crotch_height", "outside_leg_length_left"} <= blank
    assert blank.isdisjoint({"waist_girth", "chest_girth"})


@pytest.mark.parametrize("cut_m", [0.14, 0.2])
def test_a_head_that_was_cut_off_is_no_dark_hair(model: BodyModel, cut_m: float) -> None:
    """Heights of what is left were up to 44 mm off, to +-22 mm, with "ok"."""
    normals = vertex_normals(model.mean, model.faces)
    kept = model.mean[:, 2] < model.mean[:, 2].max() - cut_m
    count = int(kept.sum())
    cloud = PointCloud(
        model.mean[kept], normals[kept], np.full(count, 1e-3), np.zeros(count, np.int16), ("cloud",)
    )
    fit = fit_body(model, Preprocessed(cloud, (), ()))
    assert fit.verdict.reasons == ("the top of the head was not seen: scan the person up to it",)
    rows = measure_body(model, fit.overlapping, fit.vertex_sigma_m, fit.vertex_seen).rows
    (height,) = [row for row in rows if row.name == "height"]
    assert height.parts & fit.verdict.missing_parts


@pytest.mark.parametrize("name", ["ann", "ben", "cleo"])
def test_dark_hair_leaves_the_face_in_its_place(
    model: BodyModel, tmp_path: Path, name: str
) -> None:
    """The scan was to be taken again, although the next would show no more of the head."""
    body = load_mesh(BODIES / f"{name}.npz")
    head = model.part_of_vertex == model.part_names.index("head")
    low, high = model.mean[head, 2].min(), model.mean[head, 2].max()
    behind = model.mean[:, 1] > np.median(model.mean[head, 1])
    hair = head & ((model.mean[:, 2] > low + 0.7 * (high - low)) | behind)
    dark = Mesh(body.vertices, body.faces, hair[body.faces].all(axis=1))
    seen = preprocess(read_bundle(render_bundle(dark, tmp_path / "scan")))
    found = fit_body(model, seen)
    assert found.verdict.status == "ok"
    assert fit_body(model, Preprocessed(seen.cloud, (), ())).verdict.status == "ok"
    off = (found.vertices - body.vertices)[head & ~hair].mean(axis=0)
    assert np.abs(off).max() < 0.012
    assert abs(found.vertices[:, 2].max() - body.vertices[:, 2].max()) < 1.96 * found.crown_sigma_m
