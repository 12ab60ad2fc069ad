"""Result folder: its files, and result.json with the hash of each."""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from station import version
from station.core.words.tables import FILES
from workers.export.gltf import avatar_glb, mesh_glb
from workers.export.meshes import obj_mesh, ply_cloud, ply_mesh
from workers.export.origin import Origin
from workers.export.preview import preview, views_of
from workers.export.stopwatch import Stopwatch
from workers.measure.body import Content, MeasuredBody, Measurement
from workers.measure.differences import side_differences
from workers.scape.fit.fit import FitResult
from workers.scape.model.body_model import BodyModel
from workers.scape.verdict.verdict import Verdict

_LIBRARIES = ("numpy", "scipy", "opencv-contrib-python-headless", "cholespy")


def surface_files(
    model: BodyModel, fit: FitResult, measured: MeasuredBody, origin: Origin
) -> dict[str, bytes]:
    """Files of meshes and points, by name."""
    about, comments = _about(fit, origin), _comments(fit, origin)
    cloud, rows = fit.cloud, _shown_rows(measured, fit.verdict)
    return {
        "mesh.ply": ply_mesh(fit.vertices, model.faces, comments),
        "mesh.obj": obj_mesh(fit.vertices, model, comments),
        "mesh.glb": mesh_glb(fit.vertices, model.faces, rows, about),
        "avatar.glb": avatar_glb(model, fit.vertices, fit.state, about),
        "cloud.ply": ply_cloud(cloud.points, cloud.normals, comments),
    }


def picture_file(model: BodyModel, fit: FitResult, measured: MeasuredBody, origin: Origin) -> bytes:
    """The preview of a body as scanned.

    OpenCV reads its fonts once in each thread, which takes 20 ms: call this in a thread that stays.
    """
    forward = -fit.state.rotations[0][:, 1]
    heading_rad = float(np.arctan2(forward[0], -forward[1]))
    texts = {**origin.to_json(), "verdict": fit.verdict.status}
    views = views_of(fit.vertices, model.faces, heading_rad)
    return preview(views, _shown_rows(measured, fit.verdict), fit.verdict, texts)


def write_result(
    folder: Path,
    model: BodyModel,
    fit: FitResult,
    surface: Mapping[str, bytes],
    picture: bytes,
    measured: MeasuredBody,
    standing: MeasuredBody,
    origin: Origin,
    method: str,
    watch: Stopwatch,
) -> None:
    """Write a result's files into an existing folder, which the caller publishes.

    Args:
        surface: result of `surface_files`.
        picture: result of `picture_file`.
        measured: the body as scanned.
        standing: the same body in the standard pose.
    """
    # What is ready is written and hashed while the rest is made.
    with watch.step("export"), ThreadPoolExecutor(1) as beside:
        hashes = {
            name: beside.submit(_stored, folder / name, content)
            for name, content in {**surface, "preview.png": picture}.items()
        }
        for body in (measured, standing):
            name = FILES[body.pose]
            table = _json(measurements_document(origin, body, fit.verdict))
            hashes[name] = beside.submit(_stored, folder / name, table)
    seconds = {**watch.seconds, "total": watch.total_s()}
    of_files = {name: found.result() for name, found in hashes.items()}
    document = result_document(model, fit, origin, method, seconds, of_files)
    (folder / "result.json").write_bytes(_json(document))


def _stored(path: Path, content: bytes) -> str:
    """Write a file; returns its SHA-256."""
    path.write_bytes(content)
    return hashlib.sha256(content).hexdigest()


def _about(fit: FitResult, origin: Origin) -> dict[str, Any]:
    """Extras of the glTF files."""
    return {**origin.to_json(), "verdict": verdict_document(fit.verdict)}


def _comments(fit: FitResult, origin: Origin) -> list[str]:
    """Comments of the PLY and OBJ files."""
    return [*origin.comments(), f"verdict {fit.verdict.status}"]


def verdict_document(verdict: Verdict) -> dict[str, Any]:
    """Verdict as it stands in the result, the tables and the glTF files."""
    return {
        "status": verdict.status,
        "reasons": list(verdict.reasons),
        "notes": list(verdict.notes),
    }


def _shown_rows(measured: MeasuredBody, verdict: Verdict) -> list[Measurement]:
    """Rows that have a value."""
    return [row for row in measured.rows if not _is_blank(row, verdict.missing_parts)]


def _is_blank(row: Measurement, missing: frozenset[str]) -> bool:
    """Whether a row has no value: it lies on a missing part, or the body has no such line."""
    return bool(row.parts & missing) or math.isnan(row.value_m)


def measurements_document(
    origin: Origin, measured: MeasuredBody, verdict: Verdict | None = None
) -> dict[str, Any]:
    """measurements.json, format "booth-measurements", version 1.

    Rows are lengths; volume and surface, which have other units, stand beside them. Rows on parts
    that are missing in the scan, or that this body does not have, have no value.

    Args:
        verdict: None for a mesh that was not fitted to a scan.
    """
    missing = frozenset[str]() if verdict is None else verdict.missing_parts

    def content(found: Content) -> dict[str, Any]:
        return {"value": found.value, "interval95": list(found.interval95)}

    def entry(row: Measurement) -> dict[str, Any]:
        blank = _is_blank(row, missing)
        return {
            "name": row.name,
            "standard": row.standard,
            "value_m": None if blank else row.value_m,
            "interval95_m": None if blank else list(row.interval95_m),
            "basis": None if blank else row.basis,
            "path": np.round(row.path, 5).tolist(),
            "closed": row.closed,
        }

    return {
        "format": "booth-measurements",
        "version": 1,
        **origin.to_json(),
        **({} if verdict is None else {"verdict": verdict_document(verdict)}),
        "pose": measured.pose,
        "measurements": [entry(row) for row in measured.rows],
        "differences": [
            {
                "name": found.name,
                "value_m": found.value_m,
                "interval95_m": list(found.interval95_m),
            }
            for found in side_differences([r for r in measured.rows if not _is_blank(r, missing)])
        ],
        "volume_m3": content(measured.volume_m3),
        "surface_m2": content(measured.surface_m2),
    }


def result_document(
    model: BodyModel,
    fit: FitResult,
    origin: Origin,
    method: str,
    seconds: dict[str, float],
    hashes: dict[str, str],
) -> dict[str, Any]:
    """result.json, format "booth-result", version 1."""
    twists = model.relative_twists(fit.state.rotations)
    return {
        "format": "booth-result",
        "version": 1,
        **origin.to_json(),
        **verdict_document(fit.verdict),
        "method": method,
        "model": {"name": model.name, "sha256": model.sha256},
        "shape": fit.state.beta.tolist(),
        "pose": dict(zip(model.part_names, twists.tolist(), strict=True)),
        "translation": fit.state.translation.tolist(),
        "origin_m": list(fit.cloud.origin_m),
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
        "versions": _versions(),
        "files": hashes,
    }


@lru_cache(maxsize=1)
def _versions() -> dict[str, str]:
    """Versions of the programs and libraries, which do not change while they run."""
    libraries = {name: metadata.version(name) for name in _LIBRARIES}
    return {"body-booth": version(), "python": platform.python_version(), **libraries}


def _json(document: dict[str, Any]) -> bytes:
    """JSON with one line per entry and per row of a table: readable, and fast to write."""
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
