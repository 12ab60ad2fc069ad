"""Reconstruction of one scan, from the bundle to the result folder, in the paper's steps.

Zhou, Pan, Tong, Liu & Pan, "Fast 3D Human Body Reconstruction from Kinects" (2013): merge and
filter the depth images, fit the SCAPE model to them, measure the body.
"""

from __future__ import annotations

import atexit
import gc
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from station.core.bundle import read_bundle
from station.core.config import Volume
from station.core.rig import PredictedError
from workers.cloud.bare import floor_sigma_m, roughness, several_people
from workers.cloud.observed import PointCloud, Preprocessed
from workers.cloud.preprocess import preprocess
from workers.cloud.preprocess import warm_up as compile_preprocessing
from workers.export.meshes import obj_mesh
from workers.export.origin import Origin
from workers.export.preview import preview, views_of
from workers.export.result import picture_file, surface_files, write_result
from workers.export.stopwatch import Stopwatch
from workers.measure.body import MeasuredBody, measure_body, measure_standing
from workers.measure.scan_errors import ScanErrors, cover_sigma_m
from workers.scape.evidence.cameras import CameraCorrections
from workers.scape.fit.fit import (
    Method,
    OverlappingFit,
    fit_body,
    fit_overlapping,
    separate_limbs,
)
from workers.scape.fit.observer import Observer, unobserved
from workers.scape.model.blas import single_threaded_blas
from workers.scape.model.body_model import BodyModel, load_model
from workers.scape.model.deformation import vertex_normals
from workers.scape.model.skeleton import joint_positions
from workers.scape.surface.contours import warm_up as compile_contours
from workers.scape.surface.uncertainty import hidden_head_sigma
from workers.scape.verdict.unmatched import patch_sigma_m

Progress = Callable[[str, float], None]
"""Called with the step's name and the share of it that is done, 0 to 1."""


@dataclass(frozen=True, slots=True)
class JobSummary:
    """Verdict of a result for the operator."""

    status: str
    """"ok" or "rescan"."""
    reasons: tuple[str, ...]
    notes: tuple[str, ...] = ()
    evidence: Mapping[str, Any] | None = None
    """Document of format "booth-camera-evidence" of a scan that is "ok"."""


def warm_up() -> BodyModel:
    """Load and compile everything that the first job needs.

    What was loaded is no garbage: looking through it again takes 70 ms in every other scan, so
    collections leave it out from then on.
    """
    model = load_model()
    compile_preprocessing()
    compile_contours()
    cloud = _mean_cloud(model)
    fit = fit_body(model, Preprocessed(cloud, (), ()))
    # A bare cloud has no cameras that could be off.
    CameraCorrections(np.zeros((1, 3)), np.eye(6)[None], np.ones((1, 6))).corrected(cloud)
    joint_positions(model, model.mean, model.neutral_state().rotations)
    obj_mesh(model.mean, model)
    measured = measure_body(model, model.mean, vertex_seen=fit.vertex_seen)
    preview(views_of(model.mean, model.faces), measured.rows, fit.verdict)
    gc.collect()
    gc.freeze()
    # At its end the interpreter frees everything, so that no library reports leaks.
    atexit.register(gc.unfreeze)
    return model


def _mean_cloud(model: BodyModel) -> PointCloud:
    """Cloud of the mean body's vertices."""
    count = model.vertex_count
    return PointCloud(
        model.mean,
        vertex_normals(model.mean, model.faces),
        np.full(count, 1e-3),
        np.zeros(count, np.int16),
        ("mean",),
    )


def reconstruct_bundle(
    bundle_folder: Path,
    out_folder: Path,
    *,
    method: Method = "joint",
    model: BodyModel | None = None,
    volume: Volume | None = None,
    progress: Progress = lambda step, share: None,  # noqa: ARG005
    observer: Observer = unobserved,
) -> JobSummary:
    """Reconstruct a scan bundle into a folder that exists and is empty.

    Raises:
        BoothError: the bundle cannot be used; one line says why.
    """
    watch = Stopwatch()
    progress("loading", 0.0)
    with watch.step("load"):
        bundle = read_bundle(bundle_folder)
        model = model or load_model()
    progress("filtering", 0.0)
    with single_threaded_blas():
        with watch.step("preprocess"):
            scan = preprocess(bundle, volume)
        return _fitted(
            model, scan, Origin.of_bundle(bundle), method, out_folder, watch, progress, observer
        )


def reconstruct_cloud(
    cloud: PointCloud,
    scan_id: str,
    out_folder: Path,
    *,
    method: Method = "joint",
    model: BodyModel | None = None,
    progress: Progress = lambda step, share: None,  # noqa: ARG005
    observer: Observer = unobserved,
) -> JobSummary:
    """Reconstruct a bare cloud, from any scanner."""
    watch = Stopwatch()
    with watch.step("load"):
        model = model or load_model()
    with single_threaded_blas():
        with watch.step("preprocess"):
            scan = Preprocessed(cloud, (), (*several_people(cloud), *roughness(cloud)))
        return _fitted(model, scan, Origin(scan_id), method, out_folder, watch, progress, observer)


def _fitted(
    model: BodyModel,
    scan: Preprocessed,
    origin: Origin,
    method: Method,
    out_folder: Path,
    watch: Stopwatch,
    progress: Progress,
    observer: Observer,
) -> JobSummary:
    """Fit, measure and write."""
    overlapping = fit_overlapping(model, scan, method, progress, observer)
    progress("measuring", 0.0)
    # Measuring does not depend on how limbs are separated.
    with ThreadPoolExecutor(1) as beside:
        measuring, standing = _measuring(beside, model, overlapping, scan.predicted, watch)
        fit = separate_limbs(model, overlapping, scan.findings, observer)
        watch.seconds.update(fit.seconds)
        measured = measuring.result()
        filing = beside.submit(surface_files, model, fit, measured, origin)
        with watch.step("export"):
            picture = picture_file(model, fit, measured, origin)
        surface = filing.result()
    progress("writing", 0.0)
    write_result(
        out_folder, model, fit, surface, picture, measured, standing.result(), origin, method,
        watch,
    )  # fmt: skip
    progress("done", 1.0)
    evidence = None
    if overlapping.evidence is not None and fit.verdict.status == "ok":
        evidence = overlapping.evidence.document(
            [view.calibration for view in scan.views], origin.calibration
        )
    return JobSummary(fit.verdict.status, fit.verdict.reasons, fit.verdict.notes, evidence)


def _measuring(
    beside: ThreadPoolExecutor,
    model: BodyModel,
    fit: OverlappingFit,
    predicted: PredictedError | None,
    watch: Stopwatch,
) -> tuple[Future[MeasuredBody], Future[MeasuredBody]]:
    """Start to measure the body as scanned, then in the standard standing pose."""
    sigma_m, seen = fit.surface.sigma_m, fit.surface.seen

    errors = beside.submit(scan_errors, model, fit, predicted)

    def as_scanned() -> MeasuredBody:
        with watch.step("measure"):
            return measure_body(model, fit.vertices, sigma_m, seen, errors.result())

    def upright() -> MeasuredBody:
        with watch.step("measure"):
            return measure_standing(model, fit.vertices, fit.state, sigma_m, seen, errors.result())

    return beside.submit(as_scanned), beside.submit(upright)


def scan_errors(
    model: BodyModel, fit: OverlappingFit, predicted: PredictedError | None
) -> ScanErrors:
    """Errors that one scan adds to those of ordinary scans.

    Args:
        predicted: errors of the calibration; None if it does not say.
    """
    skin = np.hypot(
        patch_sigma_m(model, fit.patches.result()),
        hidden_head_sigma(model, fit.surface.seen, fit.crown_sigma_m),
    )
    covers = [(sign.covered, sign.thickness_m) for sign in fit.clothing.result()]
    covers.append((("head",), fit.head_cover_m))
    errors = ScanErrors(
        crown_sigma_m=fit.crown_sigma_m,
        excess_noise_m=fit.cloud.excess_noise_m,
        skin_sigma_m=skin,
        cover_sigma_m=cover_sigma_m(model, covers),
    )
    if predicted is None:
        return replace(errors, height_sigma_m=floor_sigma_m(fit.cloud))
    return replace(
        errors, height_sigma_m=predicted.height_sigma_m, girth_sigma_m=predicted.girth_sigma_m
    )
