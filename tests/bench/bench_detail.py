"""Error of small features after averaging and filtering: noses, collar bones, navels, knees.

    python tests/bench/bench_detail.py               # 12 held-out bodies, plain and sculpted
    python tests/bench/bench_detail.py --bodies 2    # a quick look

The error of each camera's filtered depth against the true surface, and the true relief itself, both
in the band of wavelengths from 10 to 40 mm (difference of Gaussians), within 6 cm of the features.
"gain" is the slope of the filtered on the true relief: 1 where all of it is left.
Zhou et al. 2013 regret that their filter removes features.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
from fit_cases import on_the_mark
from numpy.typing import NDArray
from surface_errors import ray_scene
from unlike_bodies import UnlikeBodies

from station.core.bundle import Bundle, read_bundle
from station.core.lens import rays
from station.core.rig import CameraCalibration
from station.simulation.scene import Mesh
from station.simulation.sensor import SimulatedBooth, render_bundle
from workers.cloud.average import average, random_sigma_m
from workers.cloud.preprocess import filtered
from workers.reconstruct.job import warm_up
from workers.scape.learn.database import body_database
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_FEATURES = {
    "nose, brow": ("glabella", "chin"),
    "collar bones": ("suprasternale",),
    "navel": ("waist_front",),
    "knees": ("knee_left", "knee_right"),
}
_RADIUS_M = 0.06
_BAND_M = (0.010, 0.040)
"""Wavelengths."""
_NEAR_M = 0.02
"""Readings farther from the true depth than this show something else."""
_SEED = 91


def mean_alone(depth: Image, typical_m: float) -> Image:  # noqa: ARG001
    return depth


def bilateral(space_px: float, diameter_px: int) -> Callable[[Image, float], Image]:
    """The usual filter with another reach."""

    def smooth(depth: Image, typical_m: float) -> Image:
        sigma = 2.5 * float(random_sigma_m(np.array(typical_m)))
        return np.asarray(cv2.bilateralFilter(depth, diameter_px, sigma, space_px), np.float32)

    return smooth


def by_noise(space_px: float, diameter_px: int, sigmas: float) -> Callable[[Image, float], Image]:
    """Bilateral in inverse depth, where the sensor's noise is the same at every range, with the
    noise that is left after ten frames."""

    def smooth(depth: Image, typical_m: float) -> Image:
        inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0.0)
        sigma = sigmas * float(random_sigma_m(np.array(typical_m))) / typical_m**2
        found = cv2.bilateralFilter(inverse, diameter_px, sigma, space_px)
        return np.divide(1.0, found, out=np.zeros_like(depth), where=depth > 0.0)

    return smooth


def guided(radius_px: int, sigmas: float) -> Callable[[Image, float], Image]:
    """The guided filter (He, Sun & Tang 2013), guided by the depth itself."""

    def smooth(depth: Image, typical_m: float) -> Image:
        epsilon = (sigmas * float(random_sigma_m(np.array(typical_m)))) ** 2
        # Missing readings are far away, so that no window mixes them with the person.
        filled = np.where(depth > 0.0, depth, typical_m + 1.0).astype(np.float32)
        return np.asarray(cv2.ximgproc.guidedFilter(filled, filled, radius_px, epsilon), np.float32)

    return smooth


def generalised_variation(weight: float, rounds: int = 150) -> Callable[[Image, float], Image]:
    """Total generalised variation of second order (Bredies, Kunisch & Pock 2010), which bends
    slopes freely and punishes changes of the slope; by the primal-dual method of Chambolle & Pock
    2011."""

    def smooth(depth: Image, typical_m: float) -> Image:
        rows, columns = (np.flatnonzero((depth > 0.0).any(axis=axis)) for axis in (1, 0))
        crop = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        sigma = float(random_sigma_m(np.array(typical_m)))
        data = (depth[crop] - typical_m) / sigma
        known = depth[crop] > 0.0
        joined = known[:, :-1] & known[:, 1:], known[:-1] & known[1:]
        u, v = np.where(known, data, 0.0), np.zeros((2, *data.shape))
        u_bar, v_bar, step = u, v, 1.0 / np.sqrt(12.0)
        p, q = np.zeros_like(v), np.zeros((4, *data.shape))
        for _ in range(rounds):
            p = _within(p + step * (_slopes(u_bar, joined) - v_bar), weight)
            bend = np.concatenate([_slopes(one, joined) for one in v_bar])
            q = _within(q + step * bend, 2.0 * weight)
            u_before, v_before = u, v
            u = (u + step * (_divergence(p, joined) + np.where(known, data, 0.0))) / (1.0 + step)
            lifted = np.stack([_divergence(q[i : i + 2], joined) for i in (0, 2)])
            v = v + step * (p + lifted)
            u_bar, v_bar = 2.0 * u - u_before, 2.0 * v - v_before
        found = depth.copy()
        found[crop] = np.where(known, typical_m + sigma * u, 0.0)
        return found

    return smooth


def _slopes(image: Array, joined: tuple[NDArray[np.bool_], NDArray[np.bool_]]) -> Array:
    """Forward differences (2, h, w), 0 across the border of what is known."""
    found = np.zeros((2, *image.shape))
    found[0, :, :-1] = np.where(joined[0], np.diff(image, axis=1), 0.0)
    found[1, :-1] = np.where(joined[1], np.diff(image, axis=0), 0.0)
    return found


def _divergence(field: Array, joined: tuple[NDArray[np.bool_], NDArray[np.bool_]]) -> Array:
    """Minus the adjoint of `_slopes`."""
    found = np.zeros(field.shape[1:])
    across = np.where(joined[0], field[0, :, :-1], 0.0)
    down = np.where(joined[1], field[1, :-1], 0.0)
    found[:, :-1] += across
    found[:, 1:] -= across
    found[:-1] += down
    found[1:] -= down
    return found


def _within(field: Array, radius: float) -> Array:
    """Each pixel's vector, shortened to a radius."""
    return np.asarray(field / np.maximum(1.0, np.linalg.norm(field, axis=0) / radius))


FILTERS: dict[str, Callable[[Image, float], Image]] = {
    "shipped": filtered,
    "mean of ten alone": mean_alone,
    "bilateral 1 px": bilateral(1.0, 5),
    "bilateral 1.5 px": bilateral(1.5, 5),
    "bilateral 3 px": bilateral(3.0, 11),
    "inverse depth 2 px, 1": by_noise(2.0, 7, 1.0),
    "inverse depth 2 px, 2.5": by_noise(2.0, 7, 2.5),
    "guided 2 px, 0.5": guided(2, 0.5),
    "guided 2 px, 1": guided(2, 1.0),
    "guided 3 px, 1": guided(3, 1.0),
    "generalised variation, 0.2": generalised_variation(0.2),
    "generalised variation, 0.5": generalised_variation(0.5),
}


@dataclass
class Sums:
    """Sums over pixels of the band's squares and products, mm^2."""

    count: int = 0
    error: float = 0.0
    relief: float = 0.0
    both: float = 0.0

    def add(self, found: Array, true: Array) -> None:
        self.count += len(true)
        self.error += float(np.square(found - true).sum())
        self.relief += float(np.square(true).sum())
        self.both += float(found @ true)


def band(depth: Array, mask: NDArray[np.bool_], metres_per_px: float) -> Array:
    """The wavelengths of the band in an image whose other pixels do not count."""
    short, long = (length / (2.0 * np.pi * metres_per_px) for length in _BAND_M)
    blurred = []
    for sigma in (short, long):
        weight = cv2.GaussianBlur(mask.astype(np.float64), (0, 0), sigma)
        total = cv2.GaussianBlur(np.where(mask, depth, 0.0), (0, 0), sigma)
        blurred.append(total / np.maximum(weight, 1e-6))
    return np.asarray(blurred[0] - blurred[1])


def true_depth(camera: CameraCalibration, body: Mesh) -> tuple[Array, Array]:
    """Depth (h, w) of the true surface, 0 for none, and its places (h, w, 3)."""
    scene = ray_scene(body.vertices, body.faces)
    pose = camera.world_from_camera
    directions = rays(camera) @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    packed = np.concatenate([origins, directions], axis=-1).astype(np.float32)
    away = scene.cast_rays(o3d.core.Tensor(packed))["t_hit"].numpy()
    depth = np.where(np.isfinite(away), away, 0.0).astype(np.float64)
    return depth, origins + depth[..., None] * directions


def compare(bundle: Bundle, body: Mesh, at: Array, sums: dict[str, Sums]) -> None:
    """Add one body's features, places `at` (n, 3), to the sums of all filters."""
    for name in bundle.frames:
        camera = bundle.rig.cameras[name]
        depth = average(bundle.depth_stack(name), bundle.depth_scale_m).depth_m
        depth = camera.depth_correction.apply(depth).astype(np.float32)
        true, places = true_depth(camera, body)
        away = np.linalg.norm(places[:, :, None] - at, axis=-1).min(axis=-1)
        feature = (true > 0.0) & (away < _RADIUS_M)
        if not feature.any():
            continue
        typical = float(np.median(true[feature]))
        person = np.where(np.abs(depth - true) < 0.5, depth, 0.0).astype(np.float32)
        pitch_m = typical / camera.K[0, 0]
        for words, smooth in FILTERS.items():
            found = smooth(person.copy(), typical)
            mask = (person > 0.0) & (true > 0.0) & (np.abs(found - true) < _NEAR_M)
            inner = cv2.erode(mask.astype(np.uint8), np.ones((7, 7))).astype(bool) & feature
            relief = 1e3 * band(true, mask, pitch_m)[inner]
            sums[words].add(1e3 * band(found.astype(np.float64), mask, pitch_m)[inner], relief)


def bodies(model: BodyModel, count: int) -> list[Mesh]:
    """Bodies that no model has seen, none of the test split: half of them plain, half sculpted."""
    database = body_database()
    shapes = database.sample("validation", (count + 1) // 2, _SEED)
    poses = 0.3 * database.sample_poses("validation", len(shapes), _SEED)
    plain = [Mesh(v, database.faces) for v in database.vertices(shapes, poses)]
    sculpted = [one.mesh for one in UnlikeBodies(model, "development").bodies(count // 2)]
    return [on_the_mark(mesh.vertices, mesh.faces) for mesh in (*plain, *sculpted)]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bodies", type=int, default=12)
    parser.add_argument("--sway", type=float, default=0.001, help="amplitude at the head, metres")
    arguments = parser.parse_args()
    model = warm_up()
    table = {feature: {name: Sums() for name in FILTERS} for feature in _FEATURES}
    with tempfile.TemporaryDirectory() as folder:
        for index, body in enumerate(bodies(model, arguments.bodies)):
            path = Path(folder) / f"{index:02d}"
            render_bundle(body, path, SimulatedBooth(seed=index, sway_m=arguments.sway))
            bundle = read_bundle(path)
            for feature, landmarks in _FEATURES.items():
                at = body.vertices[[model.landmarks[name] for name in landmarks]]
                compare(bundle, body, at, table[feature])
            print(f"  body {index + 1} of {arguments.bodies}", flush=True)
    print("\nband of 10 to 40 mm: error rms in mm, gain")
    print(f"{'':<26}" + "".join(f"{feature:>18}" for feature in _FEATURES))
    line = "".join(
        f"{np.sqrt(sums['shipped'].relief / sums['shipped'].count):12.3f}{'':6}"
        for sums in table.values()
    )
    print(f"{'true relief, rms':<26}{line}")
    for name in FILTERS:
        cells = (sums[name] for sums in table.values())
        line = "".join(
            f"{np.sqrt(one.error / one.count):12.3f}{one.both / one.relief:6.2f}" for one in cells
        )
        print(f"{name:<26}{line}")


if __name__ == "__main__":
    main()
