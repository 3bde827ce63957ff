"""Seams from profiles: the trace among false echoes, and sections with noise, dropouts and echoes."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.drawn_profile import draw_profile, spoilt_profile, trace_heights
from noise_model.instrument.profiler import SENSOR, Profiler
from noise_model.setup import Setup
from noise_model.setup_keys import Tolerance
from noise_model.surface.joint import Joint, SeamLine, corrugation_height
from tracker.state import Frame, Pose
from tracker.stripe.profile_trace import BEGIN_NATS, ECHO_NATS, EDGE_NATS, TURN, likeliest_trace
from tracker.tracker import Tracker

AHEAD_MM = 40.0
UPRIGHT = {
    "lap": {"thickness_mm": 5.0},
    "corrugation": {"thickness_mm": 2.0, "height_mm": 6.0, "width_mm": 30.0, "pitch_mm": 60.0},
    "butt": {"thickness_mm": 6.0, "gap_mm": 1.315},
    "edge": {"thickness_mm": 4.0, "gap_mm": 1.315},
    "half_v": {"bevel_angle_deg": 45.0, "depth_mm": 6.0, "root_gap_mm": 1.0},
}
JOINTS = {
    "v_groove": {"included_angle_deg": 60.0, "depth_mm": 6.0, "root_gap_mm": 1.0},
    "fillet": {"included_angle_deg": 90.0},
    "u_groove": {"depth_mm": 8.0, "root_radius_mm": 3.0, "bevel_angle_deg": 15.0, "root_gap_mm": 2.0},
}


def setup_of(type_name: str, columns: int = 1280, pitch_mm: float = 0.03, **size: float) -> Setup:
    T_tool_profile = np.eye(4)
    T_tool_profile[0, 3] = AHEAD_MM
    sensor = Profiler(columns, pitch_mm, 60.0, 150.0, T_tool_profile)
    joint = Joint(
        type=type_name,
        dimensions=(JOINTS | UPRIGHT)[type_name] | size,
        seam_in_base_mm=((0.0, 0.0, 0.0), (200.0, 0.0, 0.0)),
        surface_normal_in_base=(0.0, 0.0, 1.0),
    )
    return Setup(
        camera=sensor.camera,
        sensor=SENSOR,
        laser=sensor.laser,
        joint=joint,
        tolerance=Tolerance(hand_eye_deg=0.0, hand_eye_mm=0.0),
        profiler=sensor,
    )


def cost_of(chosen: tuple[bool, ...], scan: Float64, off_px: Float64, variance_px2: Float64) -> float:
    """Return the cost of a choice of points by its definition, point by point."""

    def follows(n: int, last: int) -> float:
        variance = variance_px2[n] + variance_px2[last] + (TURN * (scan[n] - scan[last])) ** 2
        return float(0.5 * (off_px[n] - off_px[last]) ** 2 / variance)

    cost, last, run = 0.0, -1, False
    for n, on_trace in enumerate(chosen):
        if not on_trace:
            cost += ECHO_NATS + (min(follows(n, n - 1), BEGIN_NATS) if run else BEGIN_NATS)
        elif last >= 0:
            cost += min(follows(n, last), EDGE_NATS)
        last, run = (n if on_trace else last), not on_trace
    return cost


@given(st.lists(st.sampled_from([0.0, 0.5, -0.7, 12.0, 13.0, -9.0]), min_size=1, max_size=9))
def test_trace_is_the_likeliest_of_all_choices(off: list[float]) -> None:
    off_px, scan = np.array(off), np.cumsum(np.arange(len(off)) % 3 + 1.0)
    variance_px2 = 0.1 + 0.3 * (np.arange(len(off)) % 4)
    best = min(
        cost_of(chosen, scan, off_px, variance_px2)
        for chosen in product([False, True], repeat=len(off))
        if any(chosen)
    )
    found = tuple(likeliest_trace(scan, off_px, variance_px2).tolist())
    assert cost_of(found, scan, off_px, variance_px2) == pytest.approx(best)


def test_runs_of_echoes_on_either_side_are_left_out() -> None:
    rng = np.random.default_rng(0)
    off_px = rng.normal(0.0, 1.0, 600)
    is_echo = np.zeros(600, np.bool_)
    for start, away in ((50, 40.0), (200, -60.0), (210, 90.0), (400, 30.0)):
        off_px[start : start + 10] += away
        is_echo[start : start + 10] = True
    on_trace = likeliest_trace(np.arange(600.0), off_px, np.ones(600))
    assert not on_trace[is_echo].any()
    assert on_trace[~is_echo].mean() > 0.9


def test_points_that_are_known_worse_stay_on_the_trace() -> None:
    sigma_px = np.where(np.arange(600) % 40 < 10, 8.0, 0.5)
    off_px = np.random.default_rng(0).normal(0.0, sigma_px)
    on_trace = likeliest_trace(np.arange(600.0), off_px, sigma_px**2)
    assert on_trace.mean() > 0.9
    # With one sigma for all they are echoes.
    assert likeliest_trace(np.arange(600.0), off_px, np.full(600, 0.25)).mean() < 0.9


def test_an_upright_edge_stays_on_the_trace() -> None:
    off_px = np.where(np.arange(400) < 200, 0.0, 100.0) + np.random.default_rng(0).normal(0.0, 1.0, 400)
    on_trace = likeliest_trace(np.arange(400.0), off_px, np.ones(400))
    assert min(on_trace[:200].mean(), on_trace[200:].mean()) > 0.8


def drawn_errors(type_name: str) -> tuple[Float64, int]:
    """Return (y, z) off a drawn section's seam in 60 frames (n, 2), in sigmas, and how many are not valid."""
    setup, rng = setup_of(type_name), np.random.default_rng(1)
    tracker, errors, n_lost = Tracker(setup), [], 0
    for n in range(60):
        T_base_tool = np.eye(4)
        T_base_tool[:3, 3] = 20.0 + n, 0.4 * np.sin(0.2 * n), 0.3
        scene = make_scene(setup, T_base_tool, SeamLine(0.0, 0.6, -0.2, 0.0, 0.0, 0.0))
        image = draw_profile(setup, scene, rng)
        track = tracker.step(Frame(n, 0.1 * n, image, 0.001, arc_on=False), Pose(T_base_tool))
        if not track.valid:
            n_lost += 1
            continue
        height_mm = -(JOINTS | UPRIGHT)[type_name].get("depth_mm", 0.0)
        height_mm += float(corrugation_height(T_base_tool[0, 3] + AHEAD_MM, scene.shape.corrugation))
        true_mm = 0.6 - T_base_tool[1, 3], height_mm - 0.2 - T_base_tool[2, 3]
        errors.append(
            [
                (track.seam_tool_mm[1] - true_mm[0]) / track.sigma_y_mm,
                (track.seam_tool_mm[2] - true_mm[1]) / track.sigma_z_mm,
            ]
        )
    return np.array(errors), n_lost


@pytest.mark.slow
@pytest.mark.parametrize("type_name", JOINTS)
def test_error_over_sigma_of_drawn_profiles(type_name: str) -> None:
    errors, n_lost = drawn_errors(type_name)
    assert n_lost == 0
    # 60 errors scatter by 9 %: 1.3 is three sigmas of that beyond 1.
    assert np.sqrt(np.mean(np.square(errors), axis=0)).max() < 1.3
    assert np.abs(errors).max() < 5.0


@pytest.mark.slow
@pytest.mark.parametrize("type_name", UPRIGHT)
def test_error_over_sigma_of_upright_edges(type_name: str) -> None:
    errors, n_lost = drawn_errors(type_name)
    # A run of echoes at the height of one face, next to the edge, is not told from it.
    assert n_lost <= 3
    error_over_sigma = np.sqrt(np.mean(np.square(errors), axis=0))
    # Where few columns tell how often a sheet misses them, as of an edge, sigma is the wider.
    assert (error_over_sigma > 0.5).all()
    assert (error_over_sigma < 1.3).all()


@pytest.mark.slow
def test_sigmas_of_points_weigh_a_face_that_scatters_five_times_as_much() -> None:
    figures = []
    for point_sigma in (True, False):
        setup, rng = setup_of("v_groove"), np.random.default_rng(1)
        assert setup.profiler is not None
        sensor = replace(setup.profiler, point_sigma=point_sigma)
        tracker = Tracker(replace(setup, profiler=sensor))
        trace_mm = trace_heights(setup, make_scene(setup, np.eye(4)))
        sigma_mm = np.where(sensor.y_mm < 0.0, 0.05, 0.01)
        errors_mm, sigmas_mm = [], []
        for n in range(60):
            z_mm = trace_mm + sigma_mm * rng.standard_normal(sensor.columns)
            image = sensor.profile(z_mm, np.ones(sensor.columns), sigma_mm)
            track = tracker.step(Frame(n, 0.1 * n, image, 0.001, arc_on=False), Pose(np.eye(4)))
            assert track.valid
            errors_mm.append(track.seam_tool_mm[1])
            sigmas_mm.append(track.sigma_y_mm)
        figures.append((np.std(errors_mm), np.std(errors_mm) / np.median(sigmas_mm)))
    (own_mm, own_over_sigma), (one_mm, one_over_sigma) = figures
    # One sigma for all is too small by a factor of three here; 60 errors scatter by 9 %.
    assert own_over_sigma < 1.4 < 2.5 < one_over_sigma
    assert own_mm < 0.7 * one_mm


@pytest.mark.slow
def test_a_groove_of_few_columns_is_found_wherever_it_lies_between_two_steps() -> None:
    setup, rng = setup_of("v_groove", 640, 0.06, depth_mm=3.5), np.random.default_rng(3)
    n_found = 0
    for _ in range(30):
        seam = SeamLine(0.0, rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0), 0.0, 0.0, 0.02 * rng.normal())
        image = draw_profile(setup, make_scene(setup, np.eye(4), seam), rng)
        track = Tracker(setup).step(Frame(0, 0.0, image, 0.001, arc_on=False), Pose(np.eye(4)))
        n_found += track.valid
    # Echoes of 12 columns in one of 8 profiles lie in the groove.
    assert n_found >= 28


@pytest.mark.slow
@pytest.mark.parametrize("bow", [0.0, 0.0005])
@pytest.mark.parametrize("type_name", ["lap", "butt", "edge"])
def test_a_plate_without_an_edge_is_refused(type_name: str, bow: float) -> None:
    setup, rng = setup_of(type_name), np.random.default_rng(7)
    profiler = setup.profiler
    assert profiler is not None
    for _ in range(20):
        z_mm = -0.5 + rng.normal(0.0, 0.02) * profiler.y_mm + bow * profiler.y_mm**2
        image = spoilt_profile(profiler, z_mm, rng)
        track = Tracker(setup).step(Frame(0, 0.0, image, 0.001, arc_on=False), Pose(np.eye(4)))
        assert not track.valid
        assert "joint_not_found" in track.flag_names


@pytest.mark.parametrize("type_name", ["lap", "butt"])
def test_an_edge_out_of_view_is_refused(type_name: str) -> None:
    """One plate that ends within the profile: nothing lies behind its edge."""
    setup, rng = setup_of(type_name), np.random.default_rng(7)
    profiler = setup.profiler
    assert profiler is not None
    z_mm = np.where(profiler.y_mm < 0.0, 0.0, math.nan)
    track = Tracker(setup).step(
        Frame(0, 0.0, spoilt_profile(profiler, z_mm, rng), 0.001, arc_on=False), Pose(np.eye(4))
    )
    assert not track.valid


def test_a_profile_without_heights_is_refused_by_name() -> None:
    setup = setup_of("v_groove")
    track = Tracker(setup).step(Frame(0, 0.0, np.zeros((2, 1280), np.uint16), 0.001), Pose(np.eye(4)))
    assert not track.valid
    assert "stripe_lost" in track.flag_names


def test_an_image_in_a_profiles_place_is_refused() -> None:
    setup = setup_of("v_groove")
    with pytest.warns(UserWarning, match="a profile of 2 x 1280 uint16 is needed"):
        track = Tracker(setup).step(Frame(0, 0.0, np.zeros((480, 1280), np.uint16), 0.001), Pose(np.eye(4)))
    assert "frame_unreadable" in track.flag_names
