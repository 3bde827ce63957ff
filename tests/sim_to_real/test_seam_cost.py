"""What an effect costs the seam, held against closed forms: the way of a camera, a clock's delay, a tilt."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made import level_pose
from scipy.stats import foldnorm

from arctrack.recording import read_recording
from noise_model.condition import Condition
from noise_model.effects import REGISTRY, not_predicted
from noise_model.forward import Renderer, predict
from noise_model.surface.joint import NOMINAL_SEAM
from noise_model.transforms import invert, transform
from sim_to_real.decision.seam_cost import (
    RANDOM_EFFECTS,
    UNRENDERED_EFFECTS,
    SceneFrame,
    SeamTrial,
    Spread,
    bound_of,
    cost_of,
    ranked,
    seam_in_images,
    triangulation_shifts_mm,
    unknown_cost,
)
from sim_to_real.diagnosis import CostFlag
from tracker.geometry import SEARCH_REACH_MM
from tracker.seam_observations import SeamObservations
from tracker.state import Frame

SETUP = read_recording(Path(__file__).parents[2] / "examples" / "v_groove").setup
NONE = replace(SETUP, effects={})
SPEED_MM_S = np.array([8.0, 3.0, -2.0])
"""The tool's velocity, base frame: along the seam, to its side, and downwards."""


def moving(t_s):
    """The tool's pose at a time."""
    T_base_tool = level_pose(0.0)
    T_base_tool[:3, 3] += SPEED_MM_S * t_s
    return T_base_tool


def trial(setup=NONE, laser=1.0, times_s=(0.0, 0.2)):
    """Frames of a moving tool, laser and arc on."""
    exposure_s = setup.camera.exposure_s
    blank = np.empty((0, 0), dtype=np.uint8)
    frames = [
        SceneFrame(
            Frame(n, t, blank, exposure_s, setup.arc.current_a),
            moving,
            Condition(laser, 1.0, exposure_s, t),
            NOMINAL_SEAM,
        )
        for n, t in enumerate(times_s)
    ]
    return SeamTrial(setup, frames, Renderer(len(frames)))


@pytest.fixture(scope="module")
def on_track():
    return trial()


def shifts_mm(on_track, name, **values):
    complete = REGISTRY[name].complete(values)
    return on_track.shifts_mm(name, [complete, complete])


def seen():
    """The seam's points as the camera sees them from three places, without any error."""
    points_tool = np.array(
        [
            transform(invert(moving(t)), [moving(t)[0, 3] + SETUP.laser.point_mm[0], 0.0, -SEAM_DEPTH_MM])
            for t in TIMES_S
        ]
    )
    T_camera_tool = invert(SETUP.camera.T_tool_camera)
    image_px = SETUP.camera.project(transform(T_camera_tool, points_tool))
    return SeamObservations(image_px, TIMES_S, np.full((len(TIMES_S), 2), 1e-4), (moving,) * len(TIMES_S))


TIMES_S = np.array([0.0, 0.1, 0.2])
SEAM_DEPTH_MM = SETUP.joint.dimensions["depth_mm"]


def test_frames_see_the_seam_where_a_camera_projects_it():
    """A bent one too: its point lies in the sheet, on the course, and is triangulated there."""
    along = seam_in_images(NONE, TIMES_S, (moving,) * 3, straight)
    assert along.image_px == pytest.approx(seen().image_px, abs=1e-6)
    bent = seam_in_images(NONE, TIMES_S, (moving,) * 3, wavy)
    stations_mm, displacements_mm = bent.in_joint(NONE)
    assert displacements_mm == pytest.approx(wavy(stations_mm), abs=1e-6)


def wavy(stations_mm):
    return np.column_stack([3.0 * np.sin(stations_mm / 20.0), 0.05 * stations_mm])


def straight(stations_mm):
    return np.zeros((len(stations_mm), 2))


def triangulated_mm(name, **values):
    return triangulation_shifts_mm(seen(), NONE, name, REGISTRY[name].complete(values), straight)


def test_a_camera_moved_to_the_side_costs_its_way_to_the_side():
    """The camera's x axis is the tool's -y, so what moves by 0.2 mm is taken for the seam's way."""
    assert SETUP.camera.T_tool_camera[:3, 0] == pytest.approx([0.0, -1.0, 0.0], abs=1e-9)
    for shifts in (triangulated_mm("hand_eye", move_x_mm=0.2), triangulated_mm("hand_eye", move_x_mm=-0.2)):
        assert np.abs(shifts[:, 0]) == pytest.approx(0.2, abs=1e-3)
        assert shifts[:, 1] == pytest.approx(0.0, abs=1e-3)


def test_a_camera_so_far_off_that_no_search_reaches_the_seam_costs_no_mm():
    """At 4.9 mm the tracker is that far off; at 5.1 it finds no seam, and the bound says so."""
    near, far = ({"move_x_mm": mm} for mm in (SEARCH_REACH_MM - 0.1, SEARCH_REACH_MM + 0.1))
    assert np.abs(triangulated_mm("hand_eye", **near)[:, 0]) == pytest.approx(near["move_x_mm"], abs=1e-2)
    without_mm = np.zeros((len(TIMES_S), 2))
    lost = bound_of("hand_eye", lambda values: triangulated_mm("hand_eye", **values), [far], without_mm)
    assert lost.flag is CostFlag.SEAM_LOST
    assert (lost.n_frames, lost.n_lost) == (3, 3)
    assert math.isnan(lost.lateral_mm.high)


@pytest.mark.slow
def test_frames_that_are_rendered_say_the_same_of_a_camera(on_track):
    for values in ({"move_x_mm": 0.2}, {"rot_x_deg": 0.1}, {"rot_z_deg": 0.3}):
        rendered = shifts_mm(on_track, "hand_eye", **values)
        expected = triangulated_mm("hand_eye", **values)[[0, 2]]
        assert rendered == pytest.approx(expected, abs=0.006)


def test_a_late_clock_costs_its_way_across_the_seam_and_nothing_along():
    """The tool goes along the seam at 8 mm/s, and 3 mm/s to the side: 20 ms are 0.06 mm of seam, not 0.17."""
    delay_s = 0.02
    shifts = triangulated_mm("pose_delay", delay_s=delay_s)
    assert shifts[:, 0] == pytest.approx(-delay_s * SPEED_MM_S[1], abs=1e-6)
    assert shifts[:, 1] == pytest.approx(-delay_s * SPEED_MM_S[2], abs=1e-6)
    late = replace(NONE, effects={"pose_delay": {"delay_s": delay_s}})
    along = seen().in_joint(NONE)[0] - seen().in_joint(late)[0]
    assert along == pytest.approx(-delay_s * SPEED_MM_S[0], abs=1e-6)


def test_a_bent_seam_is_elsewhere_at_another_station():
    """A point that a late clock puts farther along is right where the seam is as the curve says there."""
    slope = 0.1
    along = triangulation_shifts_mm(
        seen(),
        NONE,
        "pose_delay",
        {"delay_s": 0.02},
        lambda stations: np.column_stack([slope * stations, 0.0 * stations]),
    )
    straight_on = triangulated_mm("pose_delay", delay_s=0.02)
    assert along[:, 0] - straight_on[:, 0] == pytest.approx(slope * 0.02 * SPEED_MM_S[0], abs=1e-6)


@pytest.mark.slow
def test_a_tilted_plate_costs_little_though_the_seam_moves_far(on_track):
    """The tracker follows the seam to where the tilt has brought it: 1 deg over 35 mm are 0.6 mm."""
    shifts = shifts_mm(on_track, "surface_tilt", pitch_deg=1.0)
    assert np.abs(shifts).max() < 0.05


@pytest.mark.slow
def test_a_wrong_response_costs_next_to_nothing(on_track):
    assert np.abs(shifts_mm(on_track, "gamma", gamma=0.8)).max() < 0.02
    assert np.array_equal(shifts_mm(on_track, "gamma", gamma=1.0), np.zeros((2, 2)))


@pytest.mark.slow
def test_a_seam_that_is_lost_is_flagged(on_track):
    values = REGISTRY["defocus"].complete({"sigma_px": 20.0})
    lost = cost_of(
        "defocus",
        lambda some: shifts_mm(on_track, "defocus", **some),
        Spread(values, np.zeros((1, 1))),
        on_track.without_mm,
        is_named=True,
    )
    assert lost.flag is CostFlag.SEAM_LOST
    assert (lost.n_frames, lost.n_lost) == (2, 2)
    assert math.isnan(lost.lateral_mm.value)
    assert lost.max_mm == math.inf


@pytest.mark.slow
def test_without_a_seam_there_is_no_cost():
    dark = trial(laser=0.0, times_s=(0.0,))
    bound = bound_of(
        "gamma",
        lambda values: dark.shifts_mm("gamma", [values]),
        [REGISTRY["gamma"].complete({"gamma": 0.9})],
        dark.without_mm,
    )
    assert bound.flag is CostFlag.NO_SEAM
    assert math.isnan(bound.vertical_mm.high)


def test_the_interval_is_that_of_the_parameters():
    """A shift in proportion to a parameter of known sigma: the rms of one frame is a folded normal."""
    value, sigma, slope = 0.05, 0.02, -2.0

    def shifts_of(values):
        return np.array([[slope * values["delay_s"], 0.0]])

    spread = Spread({"delay_s": value}, np.array([[sigma**2]]))
    cost = cost_of("pose_delay", shifts_of, spread, np.zeros((1, 2)), is_named=True)
    size = abs(slope) * sigma
    expected = foldnorm.ppf([0.025, 0.975], abs(slope) * value / size, scale=size)
    assert cost.lateral_mm.value == pytest.approx(0.1)
    assert cost.lateral_mm.mean == pytest.approx(-0.1)
    assert [cost.lateral_mm.low, cost.lateral_mm.high] == pytest.approx(expected, abs=0.2 * size)
    assert cost.vertical_mm.high == 0.0


def test_correlated_parameters_cancel():
    """What one takes from the other the seam does not see, however little is known of each."""

    def shifts_of(values):
        return np.array([[0.3 + values["roll_deg"] + values["pitch_deg"], 0.0]])

    opposite = np.array([[1.0, -1.0], [-1.0, 1.0]])
    spread = Spread({"roll_deg": 0.0, "pitch_deg": 0.0}, opposite)
    cost = cost_of("surface_tilt", shifts_of, spread, np.zeros((1, 2)), is_named=False)
    assert cost.lateral_mm.low == pytest.approx(cost.lateral_mm.high, abs=1e-6)


def test_a_bound_is_that_of_the_size_that_shifts_most():
    sizes = [{"delay_s": 0.01}, {"delay_s": -0.03}]
    bound = bound_of(
        "pose_delay",
        lambda values: np.full((2, 2), 10.0 * values["delay_s"]),
        sizes,
        np.zeros((2, 2)),
    )
    assert bound.values == sizes[1]
    assert bound.lateral_mm.high == pytest.approx(0.3)
    assert math.isnan(bound.lateral_mm.value)
    assert bound.flag is None


def test_what_was_found_comes_before_bounds_and_what_is_not_known_last():
    def cost(name, mm):
        spread = Spread({}, np.zeros((0, 0)))
        return cost_of(name, lambda _: np.full((1, 2), mm), spread, np.zeros((1, 2)), is_named=True)

    bound = bound_of("fume", lambda _: np.full((1, 2), 9.0), [{}], np.zeros((1, 2)))
    unknown = unknown_cost("read_noise", {}, is_named=True)
    order = ranked([bound, unknown, cost("gamma", 0.1), cost("defocus", 0.2)])
    assert [each.id for each in order] == ["defocus", "gamma", "read_noise", "fume"]
    assert unknown.flag is CostFlag.NOT_RENDERED


def test_random_effects_are_those_that_a_draw_changes():
    small = replace(NONE, camera=NONE.camera.coarser(6))
    condition = Condition(1.0, 1.0, small.camera.exposure_s, 0.1)
    renderer, drawn = Renderer(), set()
    for name, effect in REGISTRY.items():
        if name in not_predicted(small) or name in UNRENDERED_EFFECTS:
            continue
        acting = replace(small, effects={name: effect.complete(effect.typical)})
        means = [
            predict(acting, level_pose(0.0), condition, renderer=renderer, rng=rng).mean_dn
            for rng in (None, np.random.default_rng(3))
        ]
        if not np.array_equal(*means):
            drawn.add(name)
    coded = {name for name, effect in REGISTRY.items() if effect.codes is not None}
    # The hall's light has a mean that counts; its texture is left out.
    assert drawn | coded == RANDOM_EFFECTS | {"ambient_light"}
