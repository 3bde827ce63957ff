"""Scenarios of the blind check: tiers, draws, truth, and what a recording is written from."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arctrack.recording import RecordingWriter, pose_at, read_recording
from noise_model.transforms import transform
from sim_to_real.decision.experiments import MENU, N_MORE
from tracker.state import Frame
from validation.second_renderer.scenario import (
    TIERS,
    WIDE_TIERS,
    draw,
    followed_by,
    make,
    stated_moment,
    true_seam_tool_mm,
)
from validation.second_renderer.world import FORMS, FURTHER, apply_moment_effects
from validation.second_renderer.world_effect import CATALOGUE
from validation.second_renderer.world_light import Studio, TrueWorld
from validation.second_renderer.world_stated import JOINTS, WIDE_JOINTS, draw_wide

BY_KEY = {one.key: one for one in MENU}

TIMED = {
    "arc_deflection": "growing",
    "arc_flicker": "walk",
    "laser_power_drift": "swing",
    "pose_delay": "wandering",
}
"""Forms that depend on the time, on the frame's index or on how long the run is."""

pytestmark = pytest.mark.usefixtures("mitsuba")


def small(scenario):
    """The same with an image of 80 x 60 px."""

    def shrunk(setup):
        return dataclasses.replace(setup, camera=setup.camera.coarser(8))

    world = dataclasses.replace(scenario.world, setup=shrunk(scenario.world.setup))
    return dataclasses.replace(scenario, stated=shrunk(scenario.stated), world=world)


def short(scenario):
    """The same with eight frames."""
    return dataclasses.replace(scenario, switches=scenario.switches[:8])


@pytest.fixture(scope="module")
def nominal(mitsuba):
    return draw(3, "E", joint="v_groove")


def test_a_scenario_repeats_and_a_world_can_be_shared(nominal):
    again = draw(3, "E", joint="v_groove")
    assert again.labels == nominal.labels
    other = draw(8, "A", joint="v_groove", world_seed=3, effects=["gamma"])
    assert other.stated.joint == nominal.stated.joint
    assert other.stated.arc == nominal.stated.arc
    assert other.motion == nominal.motion
    np.testing.assert_array_equal(
        other.world.setup.camera.T_tool_camera, nominal.world.setup.camera.T_tool_camera
    )
    assert other.world.setup.arc.radiance_e != nominal.world.setup.arc.radiance_e


@pytest.mark.parametrize("tier", TIERS)
def test_a_tier_hides_as_many_effects_of_its_form(tier):
    scenario = draw(11, tier)
    assert len(scenario.effects) == TIERS[tier] == len({one.id for one in scenario.effects})
    for one in scenario.effects:
        if tier == "G":
            assert one.form == FURTHER[one.id].name
            continue
        assert (one.form == CATALOGUE) == (tier != "C")
        assert one.form in FORMS[one.id]
    assert scenario.stated.joint.type in (WIDE_JOINTS if tier in WIDE_TIERS else JOINTS)
    assert json.loads(json.dumps(scenario.labels)) == scenario.labels


@pytest.mark.parametrize("is_dry", [False, True])
def test_a_plain_run_goes_straight_and_takes_all_frames_alike(is_dry, nominal):
    plain = draw(3, "F", joint="v_groove", effects=["gamma"], is_dry=is_dry)
    assert len(plain.switches) == len(nominal.switches)
    (switches,) = set(plain.switches)
    assert switches.laser_on
    assert switches.arc_on != is_dry
    poses = np.array([plain.motion.T_base_tool(t) for t in (0.0, 0.8, 2.3)])
    np.testing.assert_array_equal(poses[:, :3, :3], np.broadcast_to(poses[0, :3, :3], (3, 3, 3)))
    np.testing.assert_allclose(np.diff(poses[:, 1:3, 3], axis=0), 0.0)
    np.testing.assert_allclose(poses[:, 0, 3], plain.motion.speed_mm_s * np.array([0.0, 0.8, 2.3]))


def test_true_values_are_off_by_the_tolerance(nominal):
    stated, true = nominal.stated, nominal.world.setup
    turn = stated.camera.T_tool_camera[:3, :3].T @ true.camera.T_tool_camera[:3, :3]
    assert 0.0 < np.degrees(np.arccos(0.5 * (np.trace(turn) - 1.0))) < 0.3
    move = true.camera.T_tool_camera[:3, 3] - stated.camera.T_tool_camera[:3, 3]
    assert 0.0 < np.linalg.norm(move) < 0.3
    assert 0.0 < abs(np.log(true.arc.radiance_e / stated.arc.radiance_e)) < 0.4
    assert 0.0 < abs(np.log(true.laser.peak_e / stated.laser.peak_e)) < 0.2
    assert 0.0 < abs(true.sensor.black_level_dn - stated.sensor.black_level_dn) < 1.2
    assert 0.0 < abs(np.log(true.sensor.read_noise_e / stated.sensor.read_noise_e)) < 0.2


def test_the_labels_of_older_checks_are_unchanged():
    """Equal options hide equal effects, of equal values: draws come in the order that they ever had."""
    shown = []
    for seed, (tier, joint) in enumerate(
        [("A", "lap"), ("C", "v_groove"), ("D", "corrugation"), ("E", "lap")]
    ):
        labels = draw(seed, tier, joint=joint, width_px=80).labels
        true = labels["true_values"]
        values = [true["laser_peak_e"], true["black_level_dn"], true["read_noise_e"]]
        values += [*true["departure"].values(), *(v for p in labels["parameters"] for v in p.values())]
        shown.append((labels["effects"], labels["form"], " ".join(f"{value:.6g}" for value in values)))
    assert shown == [
        (
            ["laser_speckle"],
            ["catalogue"],
            "4913.13 4.08717 42.797 -0.751433 167.062 0.00294379 0.127491 0.731453",
        ),
        (["filter_shift"], ["edge"], "5210.64 3.94216 46.4559 -0.439182 148.519 0.00961474 0.824572"),
        (
            ["hand_eye", "lens_distortion"],
            ["catalogue", "catalogue"],
            "5216.05 4.46072 45.0594 0.0221319 189.121 0.00551128 -0.0885995 0.128892 0.0737884 0.0973297 "
            "-0.12404 0.0773066 0.162037 0.783676",
        ),
        ([], [], "4626.93 3.9957 42.9144 0.946921 129.84 -0.00372028"),
    ]


@pytest.mark.parametrize("seed", range(6))
def test_a_hard_quiet_world_is_off_by_the_tolerances_tails(seed):
    scenario = draw(seed, "I", width_px=80)
    assert scenario.effects == ()
    stated, true = scenario.stated, scenario.world.setup
    T_stated_true = np.linalg.inv(stated.camera.T_tool_camera) @ true.camera.T_tool_camera
    turn_deg = np.degrees(Rotation.from_matrix(T_stated_true[:3, :3]).as_rotvec())
    tolerance = stated.tolerance
    off = [
        *turn_deg / tolerance.hand_eye_deg,
        *T_stated_true[:3, 3] / tolerance.hand_eye_mm,
        np.log(true.arc.radiance_e / stated.arc.radiance_e) / tolerance.arc_level_rel,
        np.log(true.laser.peak_e / stated.laser.peak_e) / tolerance.laser_level_rel,
        (true.sensor.black_level_dn - stated.sensor.black_level_dn) / tolerance.black_level_dn,
        np.log(true.sensor.read_noise_e / stated.sensor.read_noise_e) / tolerance.read_noise_rel,
    ]
    assert (np.abs(off) > 1.5 - 1e-6).all()
    assert (np.abs(off) < 3.0 + 1e-6).all()
    assert 0.8 <= abs(scenario.world.departure.y_amp_mm) <= 1.2
    assert 0.013 <= abs(scenario.world.departure.z_slope) <= 0.02


def test_cameras_stand_ahead_beside_and_behind():
    places = {}
    for seed in range(40):
        stated, _ = draw_wide(np.random.default_rng(seed), "butt")
        x, y, _ = stated.camera.T_tool_camera[:3, 3]
        place = "behind" if x < 0.0 else "beside" if abs(y) > 30.0 else "ahead"
        places.setdefault(place, set()).add(stated.material.name)
    assert places == {
        "ahead": {"mild_steel", "zn_coated"},
        "beside": {"zn_coated"},
        "behind": {"zn_coated"},
    }


def test_the_frames_are_those_of_a_recording_meant_for_diagnosis(nominal):
    switches = nominal.switches
    assert len(switches) == 24
    kinds = {(s.laser_on, s.arc_on, s.current_a, s.exposure_s) for s in switches}
    assert len(kinds) == 9
    assert [s.arc_on for s in switches[:3] + switches[-3:]] == 6 * [False]
    assert not switches[0].laser_on
    assert not switches[-1].laser_on


@pytest.mark.parametrize(("joint", "seed"), [("v_groove", 3), ("lap", 4), ("corrugation", 5)])
def test_the_nominal_arc_fills_a_part_of_the_well(joint, seed):
    scenario = small(draw(seed, "E", joint=joint))
    setup, motion = scenario.stated, scenario.motion
    studio = Studio(TrueWorld(setup, np.eye(4)), (0.0, 25.0))
    light = []
    for time_s in (0.3, 1.2, 2.0):
        sight = studio.sight(motion.T_base_tool(time_s))
        light.append(studio.arc_light(sight, studio.arc_body(sight, (0.0, 0.0, 0.0))))
    share = np.stack(light) / setup.sensor.full_well_e
    assert 0.04 < share.mean() < 0.16
    assert np.mean(share > 1.0) < 0.02


def test_a_recording_repeats_is_written_and_read(nominal, tmp_path):
    scenario = short(small(nominal))
    recorded, again = make(scenario, tmp_path / "kept"), make(scenario)
    for one, two in zip(recorded.frames, again.frames, strict=True):
        np.testing.assert_array_equal(one.image_dn, two.image_dn)
        assert one.image_dn.dtype == np.uint8
    times_s = np.array([timestamp_s for timestamp_s, _ in recorded.poses])
    assert times_s[0] < -0.3
    assert times_s[-1] > recorded.frames[-1].timestamp_s + 0.3
    assert (np.diff(times_s) > 0.0).all()
    assert 0.0005 < np.std(np.diff(times_s)) < 0.003
    with RecordingWriter(tmp_path / "made", recorded.setup) as writer:
        for pose in recorded.poses:
            writer.write_pose(*pose)
        for frame, seam_tool_mm in zip(recorded.frames, recorded.truth, strict=True):
            writer.write_frame(frame)
            writer.write_truth(frame.index, seam_tool_mm)
    read = read_recording(tmp_path / "made")
    assert read.setup.joint == scenario.stated.joint
    assert [frame.timestamp_s for frame in read.frames()] == [f.timestamp_s for f in recorded.frames]


@pytest.mark.parametrize("joint", JOINTS)
def test_the_truth_lies_in_the_laser_plane_on_the_true_seam(joint):
    scenario = draw(6, "A", joint=joint, effects=["surface_tilt"], strength=0.5)
    T_base_tool = scenario.motion.T_base_tool(1.3)
    seam_tool_mm = true_seam_tool_mm(scenario.world, T_base_tool)
    assert seam_tool_mm[0] == pytest.approx(35.0, abs=1e-6)
    x, y, z = transform(T_base_tool, seam_tool_mm)
    departure, size = scenario.world.departure, scenario.stated.joint.dimensions
    assert y == pytest.approx(departure.y_amp_mm * np.sin(2.0 * np.pi * x / departure.y_period_mm))
    if joint == "corrugation":
        # Along the sheet, which is tilted with its ridges.
        tilt = np.arctan(departure.z_slope)
        s = x * np.cos(tilt) + z * np.sin(tilt)
        is_ridge = abs(s - 60.0 * np.rint(s / 60.0)) < 15.0
        ridge = 4.0 * (1.0 + np.cos(2.0 * np.pi * s / 30.0)) if is_ridge else 0.0
        assert z * np.cos(tilt) - x * np.sin(tilt) == pytest.approx(ridge, abs=1e-6)
    else:
        assert z == pytest.approx(departure.z_slope * x - size.get("depth_mm", 0.0), abs=1e-6)


def test_a_late_clock_shows_the_pose_of_another_time(nominal):
    late = draw(3, "A", joint="v_groove", effects=["pose_delay"], strength=1.0)
    delay_s = late.effects[0].values["delay_s"]
    made, plain = make(short(small(late))), make(short(small(nominal)))
    want = true_seam_tool_mm(late.world, late.motion.T_base_tool(0.2 + delay_s))
    np.testing.assert_allclose(made.truth[2], want)
    assert np.abs(made.truth[2] - plain.truth[2]).max() > 0.05
    assert made.poses[10][0] == plain.poses[10][0]
    np.testing.assert_array_equal(made.poses[10][1], plain.poses[10][1])


def test_what_cannot_be_is_named():
    with pytest.raises(ValueError, match="tier 'Z' is not known"):
        draw(1, "Z")
    with pytest.raises(ValueError, match="joint 'tee' is not known"):
        draw(1, "E", joint="tee")
    with pytest.raises(ValueError, match="tier D hides 2 effects, not 1"):
        draw(1, "D", effects=["gamma"])
    with pytest.raises(ValueError, match="arc_radius cannot be hidden in tier C"):
        draw(1, "C", effects=["arc_radius"])
    with pytest.raises(ValueError, match="gamma has no form 'log'"):
        draw(1, "C", effects=["gamma"], form="log")
    with pytest.raises(ValueError, match="interreflection cannot be hidden in tier G on a outside_corner"):
        draw(1, "G", joint="outside_corner", effects=["interreflection"])
    with pytest.raises(ValueError, match="tier H hides 3 effects, not 1"):
        draw(1, "H", effects=["gamma"])


@pytest.mark.parametrize(
    ("key", "laser_on", "arc_on", "current_a", "exposure_s"),
    [
        ("dark", False, False, 0.0, 0.005),
        ("laser", True, False, 0.0, 0.005),
        ("arc", False, True, 100.0, 0.005),
        ("exposure", True, True, 100.0, 0.0025),
        ("current", True, True, 150.0, 0.005),
        ("raised", True, True, 100.0, 0.005),
        ("sideways", True, True, 100.0, 0.005),
        ("along", True, True, 100.0, 0.005),
        ("faster", True, True, 100.0, 0.005),
    ],
)
def test_an_experiment_follows_the_run(nominal, key, laser_on, arc_on, current_a, exposure_s):
    longer = followed_by(nominal, BY_KEY[key])
    assert longer.switches[:24] == nominal.switches
    assert longer.labels == nominal.labels
    assert len(longer.switches) == 24 + N_MORE
    for more in longer.switches[24:]:
        assert vars(more) == {
            "laser_on": laser_on,
            "arc_on": arc_on,
            "current_a": current_a,
            "exposure_s": exposure_s,
        }
    assert [longer.time_s(n) for n in (0, 23)] == [0.0, 2.3]
    np.testing.assert_allclose([longer.time_s(n) for n in range(24, 28)], [3.9, 4.0, 4.1, 4.2])
    assert stated_moment(longer, 25).arc_level == pytest.approx((current_a / 100.0) ** 1.3)


@pytest.mark.parametrize("effect", ["arc_deflection", "arc_flicker", "laser_power_drift", "pose_delay"])
def test_effects_go_on_and_the_runs_frames_do_not_change(effect):
    scenario = draw(7, "C", joint="v_groove", effects=[effect], form=TIMED[effect], strength=1.0)
    longer = followed_by(scenario, BY_KEY["raised"])
    at = [apply_moment_effects(stated_moment(longer, n), longer.effects) for n in range(28)]
    assert at[:24] == [apply_moment_effects(stated_moment(scenario, n), scenario.effects) for n in range(24)]
    run, more = at[23], at[27]
    if effect == "arc_deflection":
        np.testing.assert_allclose(more.arc_shift_mm, np.array(run.arc_shift_mm) * 4.2 / 2.3)
    elif effect == "pose_delay":
        delay_s = scenario.effects[0].values["delay_s"]
        skew = scenario.effects[0].values["skew"]
        late_s = more.pose_time_s - more.time_s
        assert late_s == pytest.approx(delay_s + 4.2 * skew, abs=0.4 * abs(delay_s))
        # The experiment is made at all times that the delay can mean.
        assert longer.motion.to_s + 0.2 < more.pose_time_s < 4.2 + 0.5
    else:
        levels = [(one.arc_level, one.laser_level) for one in at[24:]]
        assert len(set(levels)) == N_MORE


def test_a_longer_recording_begins_with_the_same_frames(tmp_path):
    scenario = short(small(draw(7, "C", joint="corrugation", effects=["arc_deflection"], strength=1.0)))
    run = make(scenario, tmp_path)
    longer = followed_by(scenario, BY_KEY["faster"])
    whole, rest = make(longer, tmp_path), make(longer, first=8)
    assert [frame.index for frame in whole.frames] == list(range(12))
    assert [frame.index for frame in rest.frames] == [8, 9, 10, 11]
    for one, two in zip(run.frames, whole.frames, strict=False):
        np.testing.assert_array_equal(one.image_dn, two.image_dn)
        assert one.timestamp_s == two.timestamp_s
    for one, two in zip(rest.frames, whole.frames[8:], strict=True):
        np.testing.assert_array_equal(one.image_dn, two.image_dn)
    np.testing.assert_array_equal(whole.truth, [*run.truth, *rest.truth])
    assert len({frame.image_dn.tobytes() for frame in whole.frames}) == 12
    for frame, seam_tool_mm in zip(rest.frames, rest.truth, strict=True):
        T_base_tool = longer.motion.T_base_tool(frame.timestamp_s)
        np.testing.assert_allclose(seam_tool_mm, true_seam_tool_mm(scenario.world, T_base_tool))


@pytest.mark.parametrize("key", ["raised", "along", "faster"])
def test_the_poses_hold_the_experiments_motion(nominal, tmp_path, key):
    scenario = short(small(nominal))
    longer = followed_by(scenario, BY_KEY[key])
    run, recorded = make(scenario, first=8), make(longer, first=12)
    for one, two in zip(run.poses, recorded.poses, strict=False):
        assert one[0] == two[0]
        np.testing.assert_array_equal(one[1], two[1])
    assert len(recorded.poses) > len(run.poses) + 150
    frames = [
        Frame(n, longer.time_s(n), np.zeros((60, 80), dtype=np.uint8), 0.005) for n in range(N_MORE + 8)
    ]
    with RecordingWriter(tmp_path / "made", recorded.setup) as writer:
        for pose in recorded.poses:
            writer.write_pose(*pose)
        for frame in frames:
            writer.write_frame(frame)
    read = read_recording(tmp_path / "made")
    buffer = read.pose_buffer()
    for row in read.rows:
        # A late clock looks up another time than the frame's.
        for time_s in (row.timestamp_s - 0.1, row.timestamp_s, row.timestamp_s + 0.1):
            found, want = pose_at(buffer, time_s), longer.motion.T_base_tool(time_s)
            np.testing.assert_allclose(found.T_base_tool[:3, 3], want[:3, 3], atol=0.01)
            np.testing.assert_allclose(found.T_base_tool[:3, :3], want[:3, :3], atol=2e-4)
