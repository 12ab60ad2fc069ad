"""Intervals of measurements."""

import json
from importlib.resources import files

import numpy as np
import pytest

from workers.measure.body import measure_body
from workers.measure.intervals import (
    SHIPPED,
    ErrorModel,
    RowErrors,
    learned,
)
from workers.measure.scan_errors import ScanErrors, cover_sigma_m
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_areas, vertex_normals


def test_the_intervals_belong_to_the_model(model: BodyModel) -> None:
    """A model learned anew was once shipped with the intervals of the one before."""
    document = json.loads(files("workers.measure").joinpath(SHIPPED).read_text("utf-8"))
    assert document["made_of"]["model_sha256"] == model.sha256


def test_intervals_hold_what_they_promise() -> None:
    """Ordinary scans by a constant, strange ones by what they show: 95 of 100 held in either."""
    rng = np.random.default_rng(0)

    def draw(count: int, strangeness: float) -> RowErrors:
        sigmas = strangeness * rng.uniform(0.5e-3, 3e-3, count)
        errors = 2e-3 + np.hypot(1e-3, 4.0 * sigmas) * rng.standard_normal(count)
        return RowErrors(errors, sigmas, np.zeros(count))

    found = learned(draw(400, 0.05), draw(200, 1.0), draw(400, 0.05))
    assert found.bias == pytest.approx(2e-3, abs=6e-4)
    for strangeness in (0.05, 1.0):
        scans = draw(4000, strangeness)
        pairs = zip(scans.errors, scans.sigmas, strict=True)
        ends = np.array([found.interval(1.0 + e, s) for e, s in pairs])
        held = (ends[:, 0] <= 1.0) & (ends[:, 1] >= 1.0)
        assert 0.92 < held.mean() < 0.985
        width = ends[:, 1] - ends[:, 0]
        assert (width.mean() > 0.01) == (strangeness == 1.0)


def test_chance_does_not_pass_for_a_systematic_error() -> None:
    errors = RowErrors(np.tile([1e-3, -1.1e-3, 2e-3, -1.9e-3], 10), np.zeros(40), np.zeros(40))
    found = learned(errors, errors, errors)
    assert found.bias == found.gain == found.noise_gain == 0.0


def test_noise_that_stays_widens_the_rows_that_it_was_seen_to_spoil() -> None:
    rng = np.random.default_rng(0)

    def draw(count: int, noise_m: float) -> RowErrors:
        noises = np.full(count, noise_m)
        errors = np.hypot(1e-3, 2.0 * noises) * rng.standard_normal(count)
        return RowErrors(errors, np.zeros(count), noises)

    found = learned(draw(400, 0.0), draw(200, 0.0), draw(200, 2.6e-3))
    for noise_m in (0.0, 1.3e-3, 2.6e-3):
        ends = np.array([found.interval(1.0 + e, 0.0, noise_m) for e in draw(4000, noise_m).errors])
        held = (ends[:, 0] <= 1.0) & (ends[:, 1] >= 1.0)
        assert 0.92 < held.mean() < 0.985


def test_what_a_scan_says_of_itself_widens_the_rows_it_concerns(model: BodyModel) -> None:
    sigma, seen = np.full(model.vertex_count, 3e-4), np.ones(model.vertex_count, bool)
    usual, doubtful = (
        {
            row.name: row.interval95_m
            for row in measure_body(model, model.mean, sigma, seen, errors).rows
        }
        for errors in (ScanErrors(), ScanErrors(girth_sigma_m=0.004, crown_sigma_m=0.008))
    )
    assert doubtful["height"][1] - doubtful["height"][0] > 0.031
    assert doubtful["knee_height"] == usual["knee_height"]
    assert doubtful["waist_girth"][1] > usual["waist_girth"][1] + 0.0005


def test_the_calibrations_own_errors_widen_volume_and_surface(model: BodyModel) -> None:
    """A girth of a metre that is 2 pi mm too long: the skin is 1 mm outside."""
    sigma, seen = np.full(model.vertex_count, 3e-4), np.ones(model.vertex_count, bool)
    said = ScanErrors(girth_sigma_m=2.0 * np.pi * 1e-3)
    usual, doubtful = (
        measure_body(model, model.mean, sigma, seen, errors) for errors in (ScanErrors(), said)
    )
    thicker = model.mean + 1e-3 * vertex_normals(model.mean, model.faces)
    moved = measure_body(model, thicker)
    for name in ("volume_m3", "surface_m2"):
        before, after = getattr(usual, name), getattr(doubtful, name)
        half = [0.5 * (one.interval95[1] - one.interval95[0]) for one in (before, after)]
        added = np.sqrt(half[1] ** 2 - half[0] ** 2) / 1.96
        assert added == pytest.approx(getattr(moved, name).value - before.value, rel=0.35), name


def test_hair_around_a_head_widens_what_it_makes_larger(model: BodyModel) -> None:
    """Two centimetres: 2 pi of them to the head's girth, one to the stature, none to the waist."""
    sigma = np.zeros(model.vertex_count)
    covered = ScanErrors(cover_sigma_m=cover_sigma_m(model, [(("head",), 0.02)]))
    usual, wider = (
        {
            row.name: 0.5 * float(np.diff(row.interval95_m)[0])
            for row in measure_body(model, model.mean, sigma, None, errors).rows
        }
        for errors in (ScanErrors(), covered)
    )
    added = {name: float(np.sqrt(wider[name] ** 2 - usual[name] ** 2)) for name in usual}
    assert added["head_girth"] == pytest.approx(2.0 * np.pi * 0.02, rel=0.05)
    assert added["height"] == pytest.approx(0.02, rel=0.05)
    assert added["waist_girth"] == 0.0


def test_the_thickest_cover_counts_and_widens_both_contents(model: BodyModel) -> None:
    """One sign of clothing replaced another that may hide the same parts."""
    hips, whole = ("pelvis", "thigh_left"), model.part_names
    sigma = cover_sigma_m(model, [(hips, 0.03), (hips, 0.02), (("head",), 0.0)])
    assert sigma is not None
    assert sigma.max() == pytest.approx(0.03 / 1.96)
    assert cover_sigma_m(model, [(hips, 0.0)]) is None
    areas = vertex_areas(model.mean, model.faces)
    skin, cover = (
        errors.of_contents(0.07, areas, 1.75)
        for errors in (
            ScanErrors(girth_sigma_m=2.0 * np.pi * 1e-3),
            ScanErrors(cover_sigma_m=cover_sigma_m(model, [(whole, 1.96e-3)])),
        )
    )
    assert (cover.volume, cover.surface) == pytest.approx((skin.volume, skin.surface))


def test_an_interval_holds_its_value() -> None:
    low, high = ErrorModel(bias=-8e-3, constant=5e-3, gain=0.0, noise_gain=0.0).interval(0.4, 0.0)
    assert low == 0.4
    assert high == pytest.approx(0.413)


def test_noisy_readings_get_wider_intervals(model: BodyModel) -> None:
    """Some rows hardly: in volumes and in the height of the bust, noise averages out."""
    sigma = np.zeros(model.vertex_count)
    usual, noisy = (
        [float(np.diff(row.interval95_m)[0]) for row in body.rows]
        for body in (
            measure_body(model, model.mean, sigma, None, ScanErrors(excess_noise_m=noise_m))
            for noise_m in (0.0, 2.6e-3)
        )
    )
    growth = np.array(noisy) / np.array(usual)
    assert growth.min() > 1.0 - 1e-9
    assert np.median(growth) > 1.1


@pytest.mark.parametrize("sigma", [(np.nan, 0.0), (0.0, np.nan)])
def test_an_unknown_error_is_not_told_as_none(sigma: tuple[float, float]) -> None:
    found = ErrorModel(bias=0.0, constant=5e-3, gain=1.0, noise_gain=1.0).interval(0.9, *sigma)
    assert np.isnan(found).all()


def test_a_poorly_seen_body_gets_wider_intervals(model: BodyModel) -> None:
    sharp = measure_body(model, model.mean, np.full(model.vertex_count, 3e-4))
    blurred = measure_body(model, model.mean, np.full(model.vertex_count, 4e-3))
    widths = [
        np.mean([row.interval95_m[1] - row.interval95_m[0] for row in body.rows])
        for body in (sharp, blurred)
    ]
    assert widths[1] > 1.1 * widths[0]
