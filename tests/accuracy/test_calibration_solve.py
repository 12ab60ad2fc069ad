"""The solution on detections drawn from the sensor's own noise: poses, honesty, refusals."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic_calibration as synthetic
from calibrated_booths import (
    FRONT,
    REFERENCE,
    normalised_square,
    pair_errors,
    reference_errors,
    solved,
)
from numpy.typing import NDArray
from scan_distortion import distortion

from station.calibration.detect.detections import FLOOR, BallDetection, Observations
from station.calibration.detect.step_names import BALL
from station.calibration.solve import solving
from station.calibration.solve.first_problem import first_problem, height_words
from station.calibration.solve.solution import Solution
from station.core.errors import CalibrationError
from station.core.geometry import invert, se3_exp, transform
from station.core.kinect_v1 import INDEPENDENT_HZ
from station.core.rig import Rig
from station.simulation import violations
from station.simulation.procedure import VirtualProcedure
from station.simulation.scene import load_mesh
from station.simulation.sensor import SimulatedBooth

BODY = Path(__file__).parents[2] / "station/simulation/bodies/ann.npz"
RATE_HZ = 9.0
"""Detections a second: enough for the sensors' fields, and quickly solved."""


@pytest.fixture(scope="module")
def procedure() -> VirtualProcedure:
    return VirtualProcedure(synthetic.booth(101))


class _OnABox(VirtualProcedure):
    """The ball on the floor to the left of the mark lies on a box."""

    def resting_m(self, step: str, time_s: float) -> NDArray[np.float64]:
        box_m = np.array([0.0, 0.0, 0.01 if step == "around-0" else 0.0])
        return super().resting_m(step, time_s) + box_m


@pytest.fixture(scope="module")
def seen(procedure: VirtualProcedure) -> Observations:
    return synthetic.observations(
        procedure, rate_hz=RATE_HZ, clock_error_s=0.002, boards=True, stands=True
    )


@pytest.fixture(scope="module")
def often_seen(procedure: VirtualProcedure) -> Observations:
    return synthetic.observations(procedure, rate_hz=INDEPENDENT_HZ)


@pytest.fixture(scope="module")
def solution(procedure: VirtualProcedure, seen: Observations) -> Solution:
    return solved(procedure.booth.rig, seen)


def test_a_bodys_cloud_is_right_to_tenths_of_a_millimetre(
    procedure: VirtualProcedure, solution: Solution
) -> None:
    twists = reference_errors(procedure.booth.rig, solution.world_poses)[0]
    assert np.linalg.norm(twists[:, 3:], axis=1).max() < 2.5e-3
    assert np.degrees(np.linalg.norm(twists[:, :3], axis=1)).max() < 0.1
    found = distortion(procedure.booth, solution.rig, load_mesh(BODY))
    assert found.normal_rms_mm < 0.15
    assert found.tilt_deg < 0.1
    assert abs(found.height_mm) < 2.0
    assert np.abs(found.girths_mm).mean() < 1.0
    predicted = solution.rig.predicted
    assert predicted is not None
    assert abs(found.height_mm) < 3e3 * predicted.height_sigma_m


def test_detections_tell_how_noisy_they_are(
    procedure: VirtualProcedure, seen: Observations, solution: Solution
) -> None:
    """A sensor that is twice as noisy as it claims is not believed, and priors are no noisier."""

    def boasting(ball: BallDetection) -> BallDetection:
        return replace(ball, patches=ball.patches * (1.0, 1.0, 1.0, 0.25))

    def boast(balls: Sequence[BallDetection]) -> list[BallDetection]:
        return [boasting(ball) for ball in balls]

    around = {place: boast(balls) for place, balls in seen.around.items()}
    boasted = replace(
        seen, balls=boast(seen.balls), mark=boast(seen.mark), front=boast(seen.front), around=around
    )
    doubted = solved(procedure.booth.rig, boasted)
    sigmas = [np.sqrt(np.diag(found.world_poses.covariance)) for found in (solution, doubted)]
    shares = sigmas[1] / sigmas[0]
    assert shares.max() < 1.1
    assert np.median(shares) > 0.75


def test_the_mark_is_the_origin_and_the_floor_is_zero(
    procedure: VirtualProcedure, solution: Solution
) -> None:
    for name, camera in procedure.booth.rig.cameras.items():
        pose = solution.rig.cameras[name].world_from_camera
        assert np.linalg.norm(pose[:3, 3] - camera.world_from_camera[:3, 3]) < 6e-3
    assert solution.world_poses.mark_height_m == pytest.approx(0.1, abs=2e-3)


def test_the_ball_shows_a_floor_that_no_camera_sees(
    procedure: VirtualProcedure, seen: Observations
) -> None:
    """A strip at the edge of one image leaned a booth by 0.2 degrees: 4 mm at a head."""
    solution = solved(
        procedure.booth.rig,
        replace(seen, planes=[plane for plane in seen.planes if plane.surface != FLOOR]),
    )
    for name, camera in procedure.booth.rig.cameras.items():
        ours = solution.rig.cameras[name].world_from_camera
        up, true_up = ours[2, :3], camera.world_from_camera[2, :3]
        assert np.degrees(np.arccos(min(float(up @ true_up), 1.0))) < 0.1
        assert abs(ours[2, 3] - camera.world_from_camera[2, 3]) < 4e-3
    # What balls on the floor show of its slope is limited by how far it may be bowed.
    assert solution.world_poses.slope_sigma_rad < np.radians(0.15)


def test_a_slope_that_is_hardly_known_is_refused() -> None:
    procedure = VirtualProcedure(synthetic.booth(101), around_m=((0.45, 0.0),))
    seen = replace(synthetic.observations(procedure), planes=())
    with pytest.raises(CalibrationError, match=r"slope is only known to within 0\.\d+ degrees"):
        solved(procedure.booth.rig, seen)


def test_a_sound_booth_has_sound_clocks() -> None:
    """Depth errors that are not yet corrected were taken for a clock that jumped by 90 ms."""
    procedure = VirtualProcedure(synthetic.booth(10))
    seen = synthetic.observations(procedure)
    assert solved(procedure.booth.rig, seen).held_out


def test_clock_offsets_are_found(procedure: VirtualProcedure, solution: Solution) -> None:
    late = {
        name: 0.002 * np.random.default_rng((101, index, 9)).standard_normal()
        for index, name in enumerate(procedure.booth.rig.cameras)
    }
    for name, offset in solution.clock_s.items():
        assert offset == pytest.approx(late[REFERENCE] - late[name], abs=5e-4)


def test_it_can_be_reported_and_read_again(
    solution: Solution, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("rig") / "calibration.json"
    solution.rig.save(path)
    found = Rig.load(path)
    for name, camera in solution.rig.cameras.items():
        ours = found.cameras[name].depth_correction.to_json()
        assert ours == camera.depth_correction.to_json()
        assert camera.covariance is not None
        assert np.linalg.eigvalsh(camera.covariance).min() > 0
    assert len(solution.summary()) >= 6
    assert set(solution.report["cameras"]) == set(solution.rig.cameras)
    assert 1e-4 < solution.rig.residual_rms_m < 4e-3


@pytest.mark.parametrize("fault", synthetic.FAULTS, ids=lambda fault: fault.name)
def test_what_spoils_it_is_refused_in_words(
    procedure: VirtualProcedure, seen: Observations, fault: synthetic.Fault
) -> None:
    with pytest.raises(CalibrationError) as raised:
        solved(procedure.booth.rig, fault.spoil(seen), fault.radius_m)
    assert fault.words in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_ball_taken_from_the_mark_too_soon_is_refused(
    procedure: VirtualProcedure, seen: Observations
) -> None:
    """Each camera saw it there in fewer frames than tell whether it rested."""
    short = [
        [ball for ball in seen.mark if ball.camera == name][:3]
        for name in procedure.booth.rig.cameras
    ]
    with pytest.raises(CalibrationError, match="no camera saw the ball rest on the mark; put it"):
        solved(procedure.booth.rig, replace(seen, mark=[ball for own in short for ball in own]))


def test_cameras_that_all_hang_low_are_refused() -> None:
    """Nobody would know how well heights are measured: none of them sees a crown."""
    booth = synthetic.booth(101)
    cameras = dict(booth.rig.cameras)
    for name in ("front", "back"):
        beside = se3_exp((0.0, 0.0, 0.0, 0.9, 0.1, 0.0))
        lower = cameras[f"{name}-lower"].world_from_camera @ beside
        cameras[f"{name}-upper"] = replace(cameras[f"{name}-upper"], world_from_camera=lower)
    low = replace(booth, rig=replace(booth.rig, cameras=cameras))
    seen = synthetic.observations(VirtualProcedure(low), rate_hz=RATE_HZ)
    with pytest.raises(CalibrationError, match=r"no camera sees 1\.75 m above the mark: turn a"):
        solved(low.rig, seen)


def test_other_round_things_do_no_harm(procedure: VirtualProcedure, seen: Observations) -> None:
    """The head of whoever waves the ball is found in its stead now and then.

    There is no second place here: the heading comes from the front cameras.
    """
    rng = np.random.default_rng(3)
    heads = [
        replace(ball, center_m=ball.center_m + rng.normal(0, 0.3, 3), radius_m=0.1)
        if rng.random() < 0.1
        else ball
        for ball in seen.balls
    ]
    solution = solved(procedure.booth.rig, replace(seen, balls=heads, front=()))
    twists = reference_errors(procedure.booth.rig, solution.world_poses)[0]
    assert np.linalg.norm(twists[:, 3:], axis=1).max() < 3e-3
    places = [solution.rig.cameras[name].world_from_camera[:3, 3] for name in FRONT]
    middle = np.mean(places, axis=0)
    assert abs(middle[0]) < 1e-6
    assert middle[1] < -1.0


def test_two_cameras_that_agree_on_a_head_do_no_harm(
    procedure: VirtualProcedure, often_seen: Observations
) -> None:
    """The path was bent by decimetres there, and what the others saw of the ball, taken from so
    far off, could read as another scale of the whole booth: 14 mm, said to be less than one."""
    heads = [
        ball
        for time_s in procedure.starts_s(BALL) + np.arange(5.0, 55.0)
        for ball in synthetic.detections(
            procedure, ("front-upper", "back-upper"), np.array([0.3, 0.4, 1.6]), time_s
        )
    ]
    assert len(heads) == 100
    solution = solved(procedure.booth.rig, replace(often_seen, balls=[*often_seen.balls, *heads]))
    twists = reference_errors(procedure.booth.rig, solution.world_poses)[0]
    assert np.linalg.norm(twists[:, 3:], axis=1).max() < 2.5e-3


def test_what_does_not_settle_is_refused(
    procedure: VirtualProcedure, seen: Observations, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solving, "_FINE_ITERATIONS", 1)
    with pytest.raises(CalibrationError, match="the cameras do not agree on where the ball was"):
        solved(procedure.booth.rig, seen)


@pytest.mark.parametrize("gap_s", [0.1, 0.2])
def test_a_head_that_is_seen_all_along_blames_no_sound_camera(
    procedure: VirtualProcedure, often_seen: Observations, gap_s: float
) -> None:
    """The solution was lost: it ended in a traceback, or called a sound camera a scattering one."""
    heads = [
        ball
        for time_s in procedure.starts_s(BALL) + np.arange(2.0, 58.0, gap_s)
        for ball in synthetic.detections(
            procedure,
            ("front-upper", "back-upper"),
            np.array([0.3, 0.4, 1.6]) + 0.05 * np.sin(time_s * np.array([1.0, 0.7, 0.3])),
            time_s,
        )
    ]
    with pytest.raises(CalibrationError, match="the cameras do not agree on where the ball was"):
        solved(procedure.booth.rig, replace(often_seen, balls=[*often_seen.balls, *heads]))


def test_a_head_taken_for_the_ball_is_no_camera_that_moved(
    procedure: VirtualProcedure, seen: Observations
) -> None:
    """Whoever waves stood with his head in one camera's view until he had walked on."""
    start_s = min(ball.time_s for ball in seen.balls)
    pose = procedure.booth.rig.cameras["front-upper"].world_from_camera
    far_m = transform(invert(pose), np.array([0.0, 0.0, 1.6]))[2]

    def head(ball: BallDetection) -> BallDetection:
        if ball.camera != "front-upper" or ball.time_s > start_s + 6.0:
            return ball
        x, y, _ = transform(pose, ball.center_m)
        away = transform(invert(pose), np.array([x + 0.3, y + 0.2, 1.6])) - ball.center_m
        shift_px = 585.0 * away[:2] / far_m
        patches = ball.patches + np.array([*shift_px, 0.0, 0.0])
        return replace(ball, center_m=ball.center_m + away, patches=patches)

    found = solved(procedure.booth.rig, replace(seen, balls=[head(ball) for ball in seen.balls]))
    twists = reference_errors(procedure.booth.rig, found.world_poses)[0]
    assert np.linalg.norm(twists[:, 3:], axis=1).max() < 3e-3


def test_a_sensor_far_off_its_factory_scale_is_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A prior with light tails shared the error out among all cameras: 5 mm from front to back."""
    reported = synthetic.reported

    def off(unit, pixels, depth_m):  # type: ignore[no-untyped-def]
        scale = 0.994 if unit.camera.name == "back-lower" else 1.0
        return reported(unit, pixels, depth_m) / scale

    monkeypatch.setattr(synthetic, "reported", off)
    procedure = VirtualProcedure(synthetic.booth(130))
    rig = procedure.booth.rig
    seen = synthetic.observations(procedure, rate_hz=RATE_HZ, boards=True, stands=True)
    twists = reference_errors(rig, solved(rig, seen).world_poses)[0]
    assert np.linalg.norm(twists[:, 3:], axis=1).max() < 2e-3


def test_a_lens_that_looks_elsewhere_than_its_driver_says_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Detections were compared with where a wrong lens had put them: from a principal point that
    was 5 px off on, nothing settled, and heights or a floor that were right were blamed."""
    monkeypatch.setattr(violations, "_CENTER_PX", 9.0)
    procedure = VirtualProcedure(synthetic.booth(131, switches=(violations.LENS,)))
    seen = synthetic.observations(procedure, rate_hz=RATE_HZ, boards=True, stands=True)
    solution = solved(procedure.booth.rig, seen)
    found = distortion(procedure.booth, solution.rig, load_mesh(BODY))
    assert found.normal_rms_mm < 0.6
    assert abs(found.height_mm) < 2.0
    assert np.abs(found.girths_mm).max() < 5.0
    assert normalised_square(procedure.booth.rig, solution.world_poses) < 3.0 * 18


def test_an_oval_ball_does_not_part_the_front_from_the_back() -> None:
    """Taken for a sphere it moved the cameras by 2 mm, and girths by 3.4 mm."""
    booth = synthetic.booth(1, switches=(violations.OVAL,))
    seen = synthetic.observations(VirtualProcedure(booth), boards=True, stands=True)
    solution = solved(booth.rig, seen)
    shifts = pair_errors(booth.rig, solution.world_poses)[:, 3:]
    assert np.linalg.norm(shifts, axis=1).mean() < 1.5e-3
    assert np.abs(distortion(booth, solution.rig, load_mesh(BODY)).girths_mm).mean() < 1.5


@pytest.mark.parametrize(
    "stated_mm", [(900, 1710), (910, 1710), (1730,)], ids=["one", "both", "the only one"]
)
def test_a_stand_that_was_measured_wrongly_is_refused(
    procedure: VirtualProcedure, seen: Observations, stated_mm: tuple[int, ...]
) -> None:
    """Heights were 4 to 26 mm wrong, and stated to within 1 to 3."""
    around = dict(seen.around)
    stands = {round(mm, -2): around.pop(f"stand-{round(mm, -2)}") for mm in (900, 1700)}
    around |= {f"stand-{mm}": stands[round(mm, -2)] for mm in stated_mm}
    with pytest.raises(CalibrationError, match=r"the ball at the height of .* too low"):
        solved(procedure.booth.rig, replace(seen, around=around))


def test_two_heights_that_were_exchanged_are_told_as_such(
    procedure: VirtualProcedure, seen: Observations
) -> None:
    """The ball was said to measure 85 mm instead of 100."""
    stands = {"stand-900": seen.around["stand-1700"], "stand-1700": seen.around["stand-900"]}
    exchanged = replace(seen, around={**seen.around, **stands})
    with pytest.raises(CalibrationError, match=r"said to be .* was seen near"):
        solved(procedure.booth.rig, exchanged)
    cameras = synthetic.factory(procedure.booth.rig)
    told = height_words(exchanged, cameras, radius_m=0.1, reference=REFERENCE)
    assert told is not None
    assert height_words(seen, cameras, radius_m=0.1, reference=REFERENCE) is None
    early = replace(exchanged, balls=exchanged.balls[:20])
    assert height_words(early, cameras, radius_m=0.1, reference=REFERENCE) is None


def test_a_height_is_not_judged_by_a_ball_that_hands_cover(
    procedure: VirtualProcedure, seen: Observations
) -> None:
    """The step ended with a traceback: nothing was left of the ball's path."""
    covered = [replace(ball, radius_sigma_m=0.01) for ball in seen.balls]
    cameras = synthetic.factory(procedure.booth.rig)
    seen = replace(seen, balls=covered)
    assert height_words(seen, cameras, radius_m=0.1, reference=REFERENCE) is None
    with pytest.raises(CalibrationError, match="no camera saw the whole ball"):
        first_problem(seen, cameras, 0.1, REFERENCE)


class _MovedHook(VirtualProcedure):
    """The hook moved by 20 mm between the two heights at which the ball hung."""

    def resting_m(self, step: str, time_s: float) -> NDArray[np.float64]:
        moved_m = np.array([0.02 if step == "hanging-1800" else 0.0, 0.0, 0.0])
        return super().resting_m(step, time_s) + moved_m


def _hanging(booth: SimulatedBooth, kind: type[VirtualProcedure]) -> Observations:
    return synthetic.observations(
        kind(booth, hanging=True), rate_hz=RATE_HZ, boards=True, stands=True
    )


def test_a_hanging_ball_shows_what_is_vertical() -> None:
    """With the ball on a stand, the world was tilted by 0.21 degrees, stated as 0.06."""
    booth = synthetic.booth(825, switches=violations.ALL)
    solution = solved(booth.rig, _hanging(booth, VirtualProcedure))
    assert distortion(booth, solution.rig, load_mesh(BODY)).tilt_deg < 0.15


def test_a_floor_that_slopes_is_not_taken_for_a_hook_that_moved() -> None:
    """A slope of 4 to 5 mm per metre was refused for ever: the hook was said to have moved."""
    booth = synthetic.booth(25, switches=(violations.SLOPE,))
    slope = violations.bow_m(booth.violations, booth.seed, np.eye(2)[0], np.eye(2)[1])
    assert np.linalg.norm(slope) > 4e-3
    solution = solved(booth.rig, _hanging(booth, VirtualProcedure))
    predicted = solution.rig.predicted
    assert predicted is not None
    tilt_rad = np.radians(distortion(booth, solution.rig, load_mesh(BODY)).tilt_deg)
    assert tilt_rad < min(np.radians(0.15), 3.0 * predicted.tilt_sigma_rad)


def test_a_hook_that_moved_is_refused(procedure: VirtualProcedure) -> None:
    booth = procedure.booth
    hung = _MovedHook(booth, hanging=True)
    long_s = np.linspace(0.0, 600.0, 2_000).tolist()
    upper_m, lower_m = (
        np.mean([hung.resting_m(step, time_s)[:2] for time_s in long_s], axis=0)
        for step in ("hanging-1800", "hanging-700")
    )
    with pytest.raises(CalibrationError, match=r"hanging ball's places are \d+ mm from") as refused:
        solved(booth.rig, _hanging(booth, _MovedHook))
    told_mm = int(re.findall(r"places are (\d+) mm", str(refused.value))[0])
    # A part of it, by which an ordinary floor slopes along the 1.1 m, may be the floor's.
    assert -4.0 < told_mm - 1e3 * np.linalg.norm(upper_m - lower_m) < 1.0


def test_a_ball_of_another_radius_is_refused(
    procedure: VirtualProcedure, seen: Observations
) -> None:
    """Girths were 5 mm wrong, and stated to within 2."""
    with pytest.raises(CalibrationError, match=r"the ball measures .* but 98\.0 mm was given"):
        solved(procedure.booth.rig, seen, 0.098)


def test_a_ball_that_lay_on_a_box_is_refused_where_no_camera_sees_the_floor() -> None:
    """It tilted the world by half a degree, which was stated as a tenth."""
    seen = synthetic.observations(
        _OnABox(synthetic.booth(101)), rate_hz=RATE_HZ, clock_error_s=0.002, boards=True
    )
    unseen = replace(seen, planes=[plane for plane in seen.planes if plane.surface != FLOOR])
    with pytest.raises(CalibrationError, match="do not lie on one floor"):
        solved(synthetic.booth(101).rig, unseen)
