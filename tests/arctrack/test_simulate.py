import math
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arctrack.errors import ArctrackError
from arctrack.nominal import DIMENSIONS, nominal_setup
from arctrack.recording import BadFrame, format_setup, read_recording, read_setup_file, read_truth
from arctrack.simulation.simulate import (
    SimulatedMotion,
    SimulationPlan,
    balance,
    conditions,
    simulate_recording,
    true_values,
)
from noise_model.effects import apply_setup_effects, checked
from noise_model.instrument.sensor import linearise
from noise_model.setup import Setup
from noise_model.surface.brdf import TABLE_1
from noise_model.surface.joint import BentSeam, Joint, seam_height_mm
from noise_model.transforms import invert, transform
from tracker.geometry import SensorGeometry
from tracker.tracker import Tracker


@pytest.mark.slow
def test_the_same_seed_makes_the_same_recording(seen_setup: Setup, tmp_path: Path) -> None:
    plan = SimulationPlan(frames=3, production=True, seed=5)
    first = simulate_recording(tmp_path / "a", seen_setup, plan)
    second = simulate_recording(tmp_path / "b", seen_setup, replace(plan, video=True))
    third = simulate_recording(tmp_path / "c", seen_setup, replace(plan, seed=6))
    for name in ("recording.toml", "frames.csv", "poses.csv", "truth.csv"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
        assert (
            name in ("recording.toml", "frames.csv")
            or (first / name).read_bytes() != (third / name).read_bytes()
        )
    for a, b in zip(read_recording(first).frames(), read_recording(second).frames(), strict=True):
        assert not isinstance(a, BadFrame)
        assert not isinstance(b, BadFrame)
        np.testing.assert_array_equal(a.image_dn, b.image_dn)


@pytest.mark.slow
def test_the_laser_speckles_unless_it_is_told_not_to(seen_setup: Setup, tmp_path: Path) -> None:
    quiet = replace(
        seen_setup,
        arc=replace(seen_setup.arc, radiance_e=1e-3),
        camera=replace(seen_setup.camera, f_number=60.0),
        sensor=replace(seen_setup.sensor, read_noise_e=1.0),
    )
    still = SimulationPlan(
        frames=2,
        production=True,
        exact=True,
        travel_speed_mm_s=0.0,
        weave_mm=0.0,
        tilt_deg=0.0,
        height_mm=(1.0, 1.0),
    )
    plain = {"laser_speckle": {"contrast": 0.0}}
    images = {
        name: [
            linearise(frame.image_dn, quiet.sensor)
            for frame in read_recording(
                simulate_recording(tmp_path / name, quiet, plan, None, effects)
            ).frames()
            if not isinstance(frame, BadFrame)
        ]
        for name, plan, effects in (
            ("speckled", still, None),
            ("plain", still, plain),
            ("other", replace(still, seed=1), None),
        )
    }
    smooth = np.mean(images["plain"], axis=0)
    stripe = smooth > 0.5 * smooth.max()
    pattern = {name: [image[stripe] / smooth[stripe] - 1.0 for image in images[name]] for name in images}
    assert np.std(pattern["speckled"]) > 5.0 * np.std(pattern["plain"])
    # It stays while the robot stands still, and another seed is another part.
    assert np.corrcoef(*pattern["speckled"])[0, 1] > 0.9
    assert abs(np.corrcoef(pattern["speckled"][0], pattern["other"][0])[0, 1]) < 0.3


def test_the_conditions_are_those_of_a_diagnosis(seen_setup: Setup) -> None:
    found = conditions(seen_setup, SimulationPlan(frames=24), np.random.default_rng(0))
    assert len(found) == 24
    counts = Counter((c.laser_on, c.arc_on, c.current_a, c.exposure_s) for c in found)
    assert set(counts) == {
        (False, False, 0.0, 0.005),
        (True, False, 0.0, 0.005),
        (True, False, 0.0, 0.0025),
        (False, True, 100.0, 0.005),
        (False, True, 140.0, 0.005),
        (False, True, 100.0, 0.0025),
        (True, True, 100.0, 0.005),
        (True, True, 140.0, 0.005),
        (True, True, 100.0, 0.0025),
    }
    assert [c.arc_on for c in found[:3] + found[-3:]] == [False] * 6
    assert all(c.arc_on for c in found[3:-3])


@pytest.mark.parametrize(("frames", "rate_hz"), [(11, 10.0), (24, 0.0), (24, float("nan"))])
def test_plans_that_make_no_recording(frames: int, rate_hz: float) -> None:
    with pytest.raises(ArctrackError, match=r"--frames 11|--fps"):
        SimulationPlan(frames=frames, rate_hz=rate_hz)


@pytest.mark.parametrize(
    ("option", "wanted"),
    [
        *(("--fps", {"rate_hz": rate_hz}) for rate_hz in (math.inf, 1e7, 1e-9)),
        *(("--speed-mm-s", {"travel_speed_mm_s": speed_mm_s}) for speed_mm_s in (math.nan, -8.0, math.inf)),
        ("--seam-wander-mm", {"seam_wander_mm": math.inf}),
        ("--weave-mm", {"weave_mm": math.nan}),
        ("--tilt-deg", {"tilt_deg": 90.0}),
    ],
)
def test_plans_beyond_all_bounds(option: str, wanted: dict[str, float]) -> None:
    with pytest.raises(ArctrackError, match=f"{option} .*: must be from [0-9.]+ to [0-9.]+"):
        SimulationPlan(**wanted)  # type: ignore[arg-type]


@pytest.mark.parametrize("path", [".", "/"])
def test_a_folder_without_a_name_is_none_for_a_recording(seen_setup: Setup, path: str) -> None:
    with pytest.raises(ArctrackError, match="is no name for a recording"):
        simulate_recording(Path(path), seen_setup)


def test_a_bent_seam_cannot_be_simulated(seen_setup: Setup, tmp_path: Path) -> None:
    points = (*seen_setup.joint.seam_in_base_mm, (1100.0, 50.0, 0.0))
    bent = replace(seen_setup, joint=replace(seen_setup.joint, seam_in_base_mm=points))
    with pytest.raises(ArctrackError, match="straight seam"):
        simulate_recording(tmp_path / "r", bent)
    assert not list(tmp_path.iterdir())


def test_the_setups_file_is_copied_and_its_controller_obeyed(seen_setup: Setup, tmp_path: Path) -> None:
    turned = """
# The torch as the robot's vendor sees it.
[robot.controllertool_to_tool]
translation_mm = [1.0, 2.0, 3.0]
quaternion_xyzw = [1.0, 0.0, 0.0, 0.0]

[follow]
when_lost = "hold"
"""
    file = tmp_path / "recording.toml"
    file.write_text(format_setup(seen_setup) + turned, encoding="utf-8")
    stated, plan = read_setup_file(file), SimulationPlan(frames=1, production=True)
    plain = simulate_recording(tmp_path / "plain", seen_setup, plan)
    path = simulate_recording(tmp_path / "stated", stated.setup, plan, stated=stated)
    assert (path / "recording.toml").read_text(encoding="utf-8") == file.read_text(encoding="utf-8")
    recording = read_recording(path)
    assert recording.correction.when_lost == "hold"
    # Read back they are the tool's poses again, though the file holds the controller's.
    assert (path / "poses.csv").read_bytes() != (plain / "poses.csv").read_bytes()
    np.testing.assert_allclose(
        recording.poses.T_base_tool, read_recording(plain).poses.T_base_tool, atol=1e-5
    )


def test_what_bounces_in_a_u_cannot_be_simulated(tmp_path: Path) -> None:
    setup = nominal_setup("u_groove", "mild_steel", width=160, height=120)
    with pytest.raises(ArctrackError, match=r"\[effects.interreflection\]: is not predicted for a u_groove"):
        simulate_recording(
            tmp_path / "r", setup, hidden_effects=checked({"interreflection": {"albedo": 0.5}})
        )
    assert not list(tmp_path.iterdir())


def test_a_stripe_out_of_view_cannot_be_simulated(seen_setup: Setup, tmp_path: Path) -> None:
    away = replace(seen_setup, laser=replace(seen_setup.laser, plane_in_tool=(1.0, 0.0, 0.0, -350.0)))
    with pytest.raises(ArctrackError, match=r"\[laser\] plane_in_tool"):
        simulate_recording(tmp_path / "r", away)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@given(
    joint_type=st.sampled_from(sorted(DIMENSIONS)),
    seed=st.integers(0, 1000),
    timestamp_s=st.floats(0.0, 60.0),
    wander_mm=st.floats(0.0, 3.0),
)
def test_the_true_seam_point_lies_in_the_laser_sheet_and_on_the_seam(
    joint_type: str, seed: int, timestamp_s: float, wander_mm: float
) -> None:
    setup = nominal_setup(joint_type, "mild_steel")
    setup = replace(setup, laser=replace(setup.laser, bow=0.15))
    plan = SimulationPlan(seam_wander_mm=wander_mm)
    motion = SimulatedMotion(setup, plan, np.random.default_rng(seed))
    T_base_tool = motion.T_base_tool(timestamp_s)
    drawn = motion.true_seam(0.0, 600.0, -30.0)
    point_tool = motion.seam_point(T_base_tool, drawn)
    assert abs(float(setup.laser.off_mm(point_tool))) < 1e-6
    x, y, z = transform(T_base_tool, point_tool)
    # A slope leans the section: what lies below the surface line moves along the seam by less than this.
    assert abs(y) <= wander_mm + 0.5
    corrugation_mm = setup.joint.dimensions.get("height_mm", 0.0)
    low_mm = seam_height_mm(setup.joint) - 0.5 * wander_mm - 0.1
    assert low_mm <= z <= seam_height_mm(setup.joint) + 0.5 * wander_mm + corrugation_mm + 0.1
    # It lies on a stretch of the drawn seam, one that stands for a station near its own.
    near = drawn.lines[_stretches_about(drawn, x)]
    on_seam = [transform(invert(line.frame()), np.array([x, y, z])) for line in near]
    over_mm = [place[2] - seam_height_mm(setup.joint) for place in on_seam if abs(place[1]) < 1e-6]
    assert over_mm
    assert -1e-6 <= over_mm[0] <= corrugation_mm + 1e-6


def _stretches_about(seam: BentSeam, station_mm: float) -> slice:
    """The stretch that stands for a station and those beside it."""
    at = int(seam.stretch_at(np.array(station_mm)))
    return slice(max(at - 1, 0), at + 2)


def test_a_seam_that_runs_elsewhere(seen_setup: Setup, tmp_path: Path) -> None:
    away = Joint(
        type="v_groove",
        dimensions=seen_setup.joint.dimensions,
        seam_in_base_mm=((500.0, 300.0, 20.0), (500.0, 900.0, 20.0)),
    )
    plan = SimulationPlan(frames=1, production=True, weave_mm=0.0, tilt_deg=0.0, seam_wander_mm=0.0)
    path = simulate_recording(tmp_path / "r", replace(seen_setup, joint=away), plan)
    recording, truth = read_recording(path), read_truth(path)
    assert truth is not None
    at_start = np.argmin(np.abs(recording.poses.timestamps_s))
    np.testing.assert_allclose(recording.poses.T_base_tool[at_start, :2, 3], [500.0, 300.0], atol=0.1)
    np.testing.assert_allclose(truth.seam_tool_mm[0, :2], [35.0, 0.0], atol=1e-4)


def test_true_values_stay_near_the_nominal_ones(seen_setup: Setup) -> None:
    draws = [true_values(seen_setup, np.random.default_rng(n)) for n in range(200)]
    tolerance = seen_setup.tolerance
    moved = [invert(seen_setup.camera.T_tool_camera) @ d.camera.T_tool_camera for d in draws]
    assert np.std([m[:3, 3] for m in moved]) == pytest.approx(tolerance.hand_eye_mm, rel=0.15)
    arc = [d.arc.radiance_e / seen_setup.arc.radiance_e for d in draws]
    assert np.std(np.log(arc)) == pytest.approx(tolerance.arc_level_rel, rel=0.2)
    assert all(d.joint == seen_setup.joint and d.material == seen_setup.material for d in draws)


@pytest.mark.slow
@pytest.mark.parametrize("joint_type", sorted(DIMENSIONS))
@pytest.mark.parametrize("material", TABLE_1)
def test_nominal_setups_see_stripe_and_arc(joint_type: str, material: str, tmp_path: Path) -> None:
    setup = balance(nominal_setup(joint_type, material, width=160, height=120))
    assert SensorGeometry.of(setup).along_rows
    plan = SimulationPlan(frames=1, production=True, exact=True, weave_mm=0.0, tilt_deg=0.0)
    (frame,) = read_recording(simulate_recording(tmp_path / "r", setup, plan)).frames()
    assert not isinstance(frame, BadFrame)
    mean_e = linearise(frame.image_dn, setup.sensor).mean() / setup.sensor.full_well_e
    assert 0.08 < mean_e < 0.25


def fit_of_the_arc(path: Path, setup: Setup, effects: dict[str, dict[str, float]]) -> list[float]:
    """How far the arc's light is off what a tracker expects that knows of these effects, per frame."""
    recording, tracker = read_recording(path), Tracker(replace(setup, effects=effects))
    poses = recording.pose_buffer()
    found = []
    for frame in recording.frames():
        assert not isinstance(frame, BadFrame)
        found.append(tracker.step(frame, recording.pose_at(poses, frame.timestamp_s)).map_misfit)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "values"),
    [
        ("veiling_glare", {"share": 0.5}),
        ("vignetting", {"loss": 0.6}),
        ("gamma", {"gamma": 0.8}),
        ("arc_length", {"height_mm": 2.0}),
        ("hot_metal_glow", {"peak_e": 60000.0, "length_mm": 15.0}),
        ("fume", {"extinction_per_m": 3.0, "scatter": 0.05}),
    ],
)
def test_a_known_effect_is_honoured_by_the_tracker(
    tmp_path: Path, effect: str, values: dict[str, float]
) -> None:
    setup = balance(nominal_setup("v_groove", "mild_steel", width=320, height=240))
    plan = SimulationPlan(frames=2, production=True, exact=True, seed=2, seam_wander_mm=0.0)
    path = simulate_recording(tmp_path / "r", setup, plan, hidden_effects={effect: values})
    assert read_recording(path).setup.effects == {}
    unaware, aware = (fit_of_the_arc(path, setup, e) for e in ({}, checked({effect: values})))
    # 1 where the model is right; a quantile of its sample scatters by 5 %.
    assert max(aware) < 1.15
    assert min(unaware) > 1.3 * max(aware)


def test_a_known_pose_delay_takes_the_pose_of_another_time(seen_setup: Setup, tmp_path: Path) -> None:
    plan = SimulationPlan(frames=2, production=True, exact=True, travel_speed_mm_s=20.0)
    late = replace(seen_setup, effects=checked({"pose_delay": {"delay_s": 0.2}}))
    recording = read_recording(simulate_recording(tmp_path / "r", late, plan))
    poses = recording.pose_buffer()
    x_mm = [pose.T_base_tool[0, 3] for t in (0.0, 0.1) if (pose := recording.pose_at(poses, t)) is not None]
    np.testing.assert_allclose(x_mm, [4.0, 6.0], atol=0.05)


def test_the_true_seam_of_a_tilted_plate(seen_setup: Setup) -> None:
    tilted = apply_setup_effects(replace(seen_setup, effects=checked({"surface_tilt": {"roll_deg": 10.0}})))
    plan = SimulationPlan(seam_wander_mm=0.0, weave_mm=0.0, tilt_deg=0.0)
    motion = SimulatedMotion(seen_setup, plan, np.random.default_rng(0), tilted.joint)
    T_base_tool = motion.T_base_tool(0.0)
    point_tool = motion.seam_point(T_base_tool, motion.true_seam(0.0, 80.0, 0.0))
    depth = seen_setup.joint.dimensions["depth_mm"]
    root = transform(T_base_tool, point_tool)
    np.testing.assert_allclose(
        root[1:], [depth * np.sin(np.radians(10.0)), -depth * np.cos(np.radians(10.0))], atol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["butt", "fillet", "half_v", "u_groove", "edge", "outside_corner"])
def test_every_joint_is_simulated_and_its_nominal_values_track_it(joint: str, tmp_path: Path) -> None:
    setup = balance(nominal_setup(joint, "zn_coated", width=320, height=240))
    plan = SimulationPlan(frames=3, production=True, exact=True, seed=4)
    path = simulate_recording(tmp_path / joint, setup, plan)
    recording, truth = read_recording(path), read_truth(path)
    assert truth is not None
    assert recording.setup.joint == setup.joint
    tracker, poses = Tracker(recording.setup), recording.pose_buffer()
    for frame in recording.frames():
        assert not isinstance(frame, BadFrame)
        track = tracker.step(frame, recording.pose_at(poses, frame.timestamp_s))
        assert track.valid, track.flag_names
        # To a scan line and half of one where upright edges are all that tells of the seam.
        np.testing.assert_allclose(track.seam_tool_mm, truth.seam_tool_mm[frame.index], atol=0.2)


@pytest.mark.slow
def test_a_bowed_sheet_is_tracked_where_it_is_stated(tmp_path: Path) -> None:
    setup = nominal_setup("lap", "mild_steel", width=320, height=240)
    setup = replace(setup, laser=replace(setup.laser, bow=0.15))
    plan = SimulationPlan(frames=12, production=True, exact=True, seed=3, weave_mm=10.0, seam_wander_mm=0.5)
    path = simulate_recording(tmp_path / "bowed", setup, plan)
    recording, truth = read_recording(path), read_truth(path)
    assert recording.setup.laser.bow == 0.15
    assert truth is not None
    poses, off_mm = recording.pose_buffer(), []
    for bow in (0.15, 0.0):
        tracker = Tracker(replace(recording.setup, laser=replace(recording.setup.laser, bow=bow)))
        for frame in recording.frames():
            assert not isinstance(frame, BadFrame)
            track = tracker.step(frame, recording.pose_at(poses, frame.timestamp_s))
            off_mm.append(abs(track.seam_tool_mm[2] - truth.seam_tool_mm[frame.index, 2]))
    stated, ignored = np.split(np.array(off_mm), 2)
    assert stated.max() < 0.03
    # On plates that look bent a joint is refused, or off.
    assert not (ignored < 3.0 * np.sqrt(np.mean(stated**2))).any()


@pytest.mark.slow
@pytest.mark.parametrize(("joint", "radius_mm"), [("lap", 50.0), ("fillet", 100.0)])
def test_a_circle_is_recorded_and_tracked(joint: str, radius_mm: float, tmp_path: Path) -> None:
    """The tool turns and looks at its path: the true seam lies on the circle, in the middle of the view."""
    setup = balance(nominal_setup(joint, "mild_steel", width=320, height=240))
    plan = SimulationPlan(
        frames=3, travel_speed_mm_s=60.0, production=True, exact=True, seam_wander_mm=0.0, weave_mm=0.0,
        tilt_deg=0.0, height_mm=(0.0, 0.0), path=f"circle:{radius_mm:g}",
    )  # fmt: skip
    recording = read_recording(simulate_recording(tmp_path / "circle", setup, plan))
    tracker, poses = Tracker(recording.setup), recording.pose_buffer()
    assert (recording.setup.joint.surface_normals_in_base is not None) == (joint == "fillet")
    truths = np.loadtxt(tmp_path / "circle" / "truth.csv", delimiter=",", skiprows=1)[:, 1:]
    for frame, truth in zip(recording.frames(), truths, strict=True):
        assert not isinstance(frame, BadFrame)
        pose = recording.pose_at(poses, frame.timestamp_s)
        assert pose is not None
        x, y, z = transform(pose.T_base_tool, truth)
        assert math.hypot(x, y - radius_mm) == pytest.approx(radius_mm, abs=0.02)
        assert z == pytest.approx(0.0, abs=0.02)
        assert truth[1] == pytest.approx(0.0, abs=0.1)
        track = tracker.step(frame, pose)
        assert track.valid
        # To half of a scan line of a coarse sensor.
        assert track.seam_tool_mm == pytest.approx(tuple(truth), abs=0.15)


@pytest.mark.parametrize(
    ("path", "joint", "cure"),
    [
        ("circle", "lap", "give circle:RADIUS or corner:RADIUS in mm, such as circle:100"),
        ("square:10", "lap", "give circle:RADIUS or corner:RADIUS in mm"),
        ("corner:1", "lap", "with a radius from 2 to 10000"),
        ("circle:20", "lap", "the sensor looks 35 mm ahead; a circle of less than that turns away from it"),
        ("corner:10", "corrugation", "ridges run across a straight seam; take another --joint"),
    ],
)
def test_a_path_that_cannot_be_is_refused(path: str, joint: str, cure: str, tmp_path: Path) -> None:
    plan = SimulationPlan(frames=1, production=True, path=path)
    with pytest.raises(ArctrackError, match=f"--path {path}: .*{re.escape(cure)}"):
        simulate_recording(tmp_path / "r", nominal_setup(joint, "mild_steel"), plan)
