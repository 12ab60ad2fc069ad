"""The result folder: everything in it, and result.json with the hash of each file."""

from __future__ import annotations

import hashlib
import json
import platform
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from station import __version__
from workers.cloud.observed import PointCloud
from workers.export.gltf import avatar_glb, mesh_glb
from workers.export.meshes import obj_mesh, ply_cloud, ply_mesh
from workers.export.preview import preview
from workers.export.stopwatch import Stopwatch
from workers.measure.body import Content, MeasuredBody
from workers.scape.fit.fit import FitResult
from workers.scape.model.body_model import BodyModel

STANDARD_POSE_FILE = "measurements-standard.json"
_LIBRARIES = ("numpy", "scipy", "opencv-contrib-python-headless", "cholespy")


def write_result(
    folder: Path,
    model: BodyModel,
    fit: FitResult,
    cloud: PointCloud,
    measured: MeasuredBody,
    standing: MeasuredBody,
    scan_id: str,
    method: str,
    watch: Stopwatch,
) -> None:
    """Write a result's files into an existing folder; publishing it is the caller's.

    Args:
        measured: the body as scanned.
        standing: the same body in the standard pose.
    """
    with watch.step("export"):
        faces = model.faces
        # Drawing leaves the interpreter's lock alone: it goes on beside the other files.
        with ThreadPoolExecutor(1) as beside:
            forward = -fit.state.rotations[0][:, 1]
            heading_rad = float(np.arctan2(forward[0], -forward[1]))
            picture = beside.submit(
                preview, fit.vertices, faces, measured.rows, fit.verdict, heading_rad
            )
            files = {
                "mesh.ply": ply_mesh(fit.vertices, faces),
                "mesh.obj": obj_mesh(fit.vertices, model),
                "mesh.glb": mesh_glb(fit.vertices, faces, measured.rows),
                "avatar.glb": avatar_glb(model, fit.vertices, fit.state),
                "cloud.ply": ply_cloud(cloud.points, cloud.normals),
                "measurements.json": _json(measurements_document(scan_id, measured)),
                STANDARD_POSE_FILE: _json(measurements_document(scan_id, standing)),
                "preview.png": picture.result(),
            }
        for name, content in files.items():
            (folder / name).write_bytes(content)
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    seconds = {**watch.seconds, "total": watch.total_s()}
    document = result_document(model, fit, cloud.origin_m, scan_id, method, seconds, hashes)
    (folder / "result.json").write_bytes(_json(document))


def measurements_document(scan_id: str, measured: MeasuredBody) -> dict[str, Any]:
    """measurements.json, format "booth-measurements", version 1.

    Rows are lengths. Volume and surface have units of their own and stand beside the rows.
    """

    def content(found: Content) -> dict[str, Any]:
        return {"value": found.value, "interval95": list(found.interval95)}

    return {
        "format": "booth-measurements",
        "version": 1,
        "scan_id": scan_id,
        "pose": measured.pose,
        "measurements": [
            {
                "name": row.name,
                "standard": row.standard,
                "value_m": row.value_m,
                "interval95_m": list(row.interval95_m),
                "path": np.round(row.path, 5).tolist(),
                "closed": row.closed,
            }
            for row in measured.rows
        ],
        "volume_m3": content(measured.volume_m3),
        "surface_m2": content(measured.surface_m2),
    }


def result_document(
    model: BodyModel,
    fit: FitResult,
    origin_m: tuple[float, float, float],
    scan_id: str,
    method: str,
    seconds: dict[str, float],
    hashes: dict[str, str],
) -> dict[str, Any]:
    """result.json, format "booth-result", version 1."""
    twists = model.relative_twists(fit.state.rotations)
    return {
        "format": "booth-result",
        "version": 1,
        "scan_id": scan_id,
        "status": fit.verdict.status,
        "reasons": list(fit.verdict.reasons),
        "notes": list(fit.verdict.notes),
        "method": method,
        "model": {"name": model.name, "sha256": model.sha256},
        "shape": fit.state.beta.tolist(),
        "pose": dict(zip(model.part_names, twists.tolist(), strict=True)),
        "translation": fit.state.translation.tolist(),
        "origin_m": list(origin_m),
        "quality": {
            "point_to_surface_rms_m": fit.point_to_surface_rms_m,
            "coverage": fit.coverage,
            "correspondences": fit.correspondences,
            "parts": {
                part.name: {
                    "coverage": part.coverage,
                    "residual_rms_m": part.residual_rms_m
                    if np.isfinite(part.residual_rms_m)
                    else None,
                }
                for part in fit.parts
            },
            "camera_shifts_m": fit.camera_shifts_m,
        },
        "iterations": fit.iterations,
        "seconds": seconds,
        "versions": {
            "body-booth": __version__,
            "python": platform.python_version(),
            **_library_versions(),
        },
        "files": hashes,
    }


@lru_cache(maxsize=1)
def _library_versions() -> dict[str, str]:
    """They cannot change while the program runs."""
    return {name: metadata.version(name) for name in _LIBRARIES}


def _json(document: dict[str, Any]) -> bytes:
    """An entry a line, a table's row a line: people can read it, and it is quick to write."""
    entries = ",\n".join(f" {_compact(key)}: {_lines(value)}" for key, value in document.items())
    return f"{{\n{entries}\n}}\n".encode()


def _lines(value: Any) -> str:
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n  " + ",\n  ".join(_compact(row) for row in value) + "\n ]"
    if isinstance(value, dict) and value:
        rows = (f"{_compact(key)}: {_compact(row)}" for key, row in value.items())
        return "{\n  " + ",\n  ".join(rows) + "\n }"
    return _compact(value)


def _compact(value: Any) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False)
