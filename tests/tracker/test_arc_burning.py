"""Whether an arc burns, on frames of a world that is not the forward model: events, words that are wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rendered import CURRENT_A, EXPOSURE_S, small_setup

from noise_model.setup import Setup
from tracker import flags
from tracker.arc.burning import DECIDED_SIGMAS, MIN_OUTPUT, NOTHING_SEEN, ArcEvidence, ArcMemory, arc_evidence
from tracker.arc.level import Unlit, estimate_arc_level
from tracker.geometry import SensorGeometry
from tracker.state import Frame, Pose, Track
from tracker.tracker import Tracker
from validation.anywhere.swept_joint import SweptJoint
from validation.anywhere.swept_light import Look, SceneSurroundings
from validation.anywhere.swept_welding import Welding
from validation.anywhere.swept_world import SpeckleField, SweptWorld

OF_ARC = tuple(
    flag.name for flag in (flags.ARC_IGNITED, flags.ARC_LOST, flags.ARC_NOT_SEEN, flags.ARC_UNANNOUNCED)
)
HALL = SceneSurroundings(hall_e=700.0, look=Look(0.2, 1.0, 1))
WELDING = replace(HALL, welding=Welding(20.0, 0.3, 1.0, 30.0, 0.1))


@cache
def setup() -> Setup:
    return small_setup("v_groove")


@cache
def image(around: SceneSurroundings, level: float, index: int, laser_on: bool = True) -> np.ndarray:
    """A frame (H, W), DN, of the world; `level` is the arc's over the stated one."""
    arc = replace(setup().arc, radiance_e=level * setup().arc.radiance_e)
    joint = SweptJoint.of(setup().joint, 0.0, 100.0, 0.0)
    world = SweptWorld(replace(setup(), arc=arc), joint, SpeckleField(0.3, 0.7), around)
    return world.frame(pose(index).T_base_tool, laser_on, level > 0.0, np.random.default_rng(index))


def pose(index: int) -> Pose:
    T_base_tool = np.eye(4)
    T_base_tool[0, 3] = 0.8 * index
    return Pose(T_base_tool)


def tracked(
    around: SceneSurroundings, shots: Sequence[tuple[float, bool]], laser_on: bool = True
) -> list[Track]:
    """The tracks of frames in a row, each with the arc's level in it and what is said of the arc."""
    tracker = Tracker(setup())
    light = EXPOSURE_S, CURRENT_A, laser_on
    return [
        tracker.step(Frame(n, 0.1 * n, image(around, level, n, laser_on), *light, arc_on), pose(n))
        for n, (level, arc_on) in enumerate(shots)
    ]


def of_arc(track: Track) -> list[str]:
    return [name for name in track.flag_names if name in OF_ARC]


@pytest.mark.parametrize("around", [SceneSurroundings(), HALL, WELDING], ids=["clean", "hall", "welding"])
def test_an_event_is_flagged_in_its_frame(around: SceneSurroundings) -> None:
    """An arc that ignites, burns on, and goes out while it is said to burn."""
    shots = [(0.0, False), (0.0, False), (1.0, True), (0.7, True), (0.0, True), (0.0, True)]
    found = [of_arc(track) for track in tracked(around, shots)]
    assert found == [[], [], ["arc_ignited"], [], ["arc_lost", "arc_not_seen"], ["arc_not_seen"]]


def test_an_arc_that_ends_as_stated_is_not_lost() -> None:
    shots = [(1.0, True), (0.0, False), (0.0, False)]
    assert [of_arc(track) for track in tracked(HALL, shots)] == [[], [], []]


@pytest.mark.parametrize("laser_on", [True, False])
def test_an_arc_that_is_not_announced_is_flagged_and_read(laser_on: bool) -> None:
    """Without a word of it the frame is read as one that came with it."""
    silent = tracked(WELDING, [(0.0, False), (1.0, False), (1.0, False)], laser_on)
    spoken = tracked(WELDING, [(0.0, False), (1.0, True), (1.0, True)], laser_on)
    assert [of_arc(track) for track in silent] == [
        [],
        ["arc_ignited", "arc_unannounced"],
        ["arc_unannounced"],
    ]
    for one, other in zip(silent[1:], spoken[1:], strict=True):
        assert one.arc_level == other.arc_level
        assert one.seam_tool_mm == pytest.approx(other.seam_tool_mm, nan_ok=True)
        assert one.flags & ~flags.ARC_UNANNOUNCED.mask == other.flags


@pytest.mark.parametrize("level", [0.3, 1.0, 3.0])
def test_the_level_and_its_sigma(level: float) -> None:
    _, track = tracked(HALL, [(0.0, False), (level, True)])
    assert abs(track.arc_level - level) < 3.0 * track.arc_level_sigma
    assert track.arc_level_sigma < 0.15 * level + 0.05
    assert of_arc(track) == ["arc_ignited"]


def test_a_frame_that_is_all_hall_is_left_open() -> None:
    """Its light varies more over the image than a tenth of the arc's does."""
    bright = SceneSurroundings(hall_e=2e4, look=Look(0.3, 3.0, 1))
    for track in tracked(bright, [(0.0, False), (0.0, True)]):
        assert of_arc(track) == []


def sampled(geometry: SensorGeometry, level: float, rng: np.random.Generator, hall_e: float = 0.0) -> Unlit:
    """Pixels off the stripe under an arc of this level, and a lamp that lights one side of the image."""
    n = len(geometry.image_source.level_scan)
    map_e = np.linspace(200.0, 6000.0, n)
    lamp_e = hall_e * np.sign(np.linspace(-1.0, 1.0, n) + 0.3)
    mean_e = level * map_e + 2.0 * hall_e + lamp_e
    charge_e = rng.poisson(mean_e) + rng.normal(0.0, setup().sensor.read_noise_e, n)
    return Unlit(map_e, charge_e, np.arange(n))


@pytest.mark.parametrize("level", [0.0, 1.0])
@pytest.mark.parametrize("hall_e", [0.0, 40.0])
def test_no_draw_of_the_noise_is_answered_wrongly(level: float, hall_e: float) -> None:
    geometry, rng = SensorGeometry.of(setup()), np.random.default_rng(1)
    image_source = geometry.image_source
    answers = set()
    for _ in range(2000):
        unlit = sampled(geometry, level * rng.uniform(0.5, 1.5), rng, hall_e)
        answers.add(
            arc_evidence(image_source, unlit, estimate_arc_level(image_source, unlit), math.inf).burns
        )
    assert (level == 0.0) not in answers
    assert answers != {None}


def test_one_lamp_is_no_arc() -> None:
    """It lights the image where the arc does, and by more than an arc of the least output does."""
    geometry, rng = SensorGeometry.of(setup()), np.random.default_rng(1)
    unlit = sampled(geometry, 0.0, rng, 2000.0)
    arc = estimate_arc_level(geometry.image_source, unlit)
    assert arc.level > MIN_OUTPUT
    assert arc_evidence(geometry.image_source, unlit, arc, math.inf).burns is None


def test_the_threshold_is_the_false_rate() -> None:
    """Two tests in each of 1e5 frames are all right with a probability of 95 %."""
    wrong = 0.5 * math.erfc(DECIDED_SIGMAS / math.sqrt(2.0))
    assert (1.0 - wrong) ** 2e5 == pytest.approx(0.95, abs=0.002)


def test_the_hall_is_remembered_from_the_latest_dark_frame() -> None:
    dark, lit, open_ = ArcEvidence(0.0, 0.01, 80.0, False), ArcEvidence(1.0, 0.1, 900.0, True), ArcEvidence()
    memory = NOTHING_SEEN.after(dark, 2.0)
    assert memory == ArcMemory(False, 40.0)
    assert memory.after(lit, 1.0) == ArcMemory(True, 40.0)
    assert memory.after(open_, 1.0) == memory


def test_pixels_that_say_nothing_are_no_evidence() -> None:
    geometry = SensorGeometry.of(setup())
    few = Unlit(np.full(5, 100.0), np.full(5, 100.0), np.arange(5))
    flat = Unlit(np.full(100, 100.0), np.full(100, 90.0), np.arange(100))
    for unlit in (few, flat):
        arc = estimate_arc_level(geometry.image_source, unlit)
        assert arc_evidence(geometry.image_source, unlit, arc, math.inf).burns is None
