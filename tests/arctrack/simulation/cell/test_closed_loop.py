from __future__ import annotations

import csv
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.cli.cell import event_lines
from arctrack.errors import ArctrackError
from arctrack.simulation.cell.robot import CORRECTION_MM_S, Robot
from arctrack.simulation.cell.weld.closed_loop import ClosedLoop, LoopPlan
from arctrack.simulation.cell.weld.events import arc_fault, arc_fault_s
from robot_io import SeamOffset, Validity, WeldingState
from validation.fault_schedules.judged_cell import JudgedCell
from validation.fault_schedules.worlds import draw_world

QUICK = LoopPlan(joint="lap", speed_mm_s=20.0, length_mm=64.0, rate_hz=12.5)
"""A run of few frames that is long enough to lock."""


@pytest.mark.slow
def test_a_torch_follows_a_displaced_seam_that_a_rendered_camera_sees():
    loop = ClosedLoop(replace(QUICK, displaced_mm=-3.0))
    result = loop.run()
    assert result.rms_mm < 0.1
    assert result.max_mm < 0.3
    assert result.weave_mm == pytest.approx(1.5, abs=0.03)
    # It began 3 mm off, and only the offsets took it there.
    assert loop.samples[0].torch_mm == (0.0, 0.0)
    assert loop.samples[-1].torch_mm[0] == pytest.approx(-3.0, abs=0.1)
    settled = [f.offset.validity for f in loop.frames if f.sample.time_s >= result.lock_s]
    assert set(settled) == {Validity.VALID}
    # What the tracker knows is the setup: the seam there is the nominal one.
    assert {y for _, y, _ in loop.setup.joint.seam_in_base_mm} == {0.0}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("joint", "path", "speed_mm_s", "length_mm", "within_mm"),
    [("lap", "circle:50", 20.0, 64.0, 0.15), ("v_groove", "corner:10", 10.0, 80.0, 0.3)],
)
def test_a_torch_follows_a_displaced_part_round_a_turn(joint, path, speed_mm_s, length_mm, within_mm):
    """The part lies 1 mm to the left of the path's start and 1 mm along it; the tool turns with it."""
    plan = replace(QUICK, joint=joint, path=path, speed_mm_s=speed_mm_s, length_mm=length_mm)
    loop = ClosedLoop(replace(plan, displaced_mm=1.0, weave_mm=0.0, size_px=(320, 240)))
    result = loop.run()
    assert result.max_mm < within_mm
    settled = [f.offset.validity for f in loop.frames if f.sample.time_s >= result.lock_s]
    assert set(settled) == {Validity.VALID}
    first, last = loop.cell.world.R_base_tool(0.0), loop.cell.world.R_base_tool(length_mm)
    assert first[:, 0] @ last[:, 0] < 0.6


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["v_groove", "corrugation"])
def test_a_torch_follows_a_displaced_seam_that_a_profiler_sees(joint):
    loop = ClosedLoop(replace(QUICK, joint=joint, displaced_mm=-3.0, profiles=True))
    result = loop.run()
    # It was off by 0.01 mm RMS and 0.02 mm at most as this was written.
    assert result.max_mm < 0.1
    assert loop.samples[-1].torch_mm[0] == pytest.approx(-3.0, abs=0.1)
    settled = [f.offset.validity for f in loop.frames if f.sample.time_s >= result.lock_s]
    assert set(settled) == {Validity.VALID}


def test_a_tack_is_refused_with_profiles(tmp_path):
    words = ["cell", "run", str(tmp_path / "out"), "--profiles", "--event", "tack"]
    with pytest.raises(ArctrackError, match="--event tack: a tack is drawn on images alone"):
        raise CliRunner().invoke(app, words).exception or AssertionError


@pytest.mark.slow
def test_a_run_is_a_table_a_picture_and_some_lines(tmp_path):
    words = ["cell", "run", str(tmp_path / "out"), "--joint", "lap", "--length-mm", "3", "--fps", "20"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "the torch never locked onto the seam" in done.output
    assert "0 of 2 offsets sent; not as measured: NOT_ARMED" in done.output
    with (tmp_path / "out" / "run.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["validity"] for row in rows] == ["REFUSED"] * 6
    assert float(rows[-1]["seam_y_mm"]) == 3.0
    assert math.isnan(float(rows[-1]["offset_y_mm"]))
    assert float(rows[-1]["station_mm"]) == pytest.approx(10.0 * float(rows[-1]["time_s"]), abs=2e-3)
    image = cv2.imread(str(tmp_path / "out" / "run.png"))
    assert image is not None
    assert image.std() > 10.0


def test_a_robot_corrects_its_path_no_faster_than_it_may():
    """A far offset acts at the largest speed until the lag is slower; small steps add to a large one."""
    world = replace(draw_world(np.random.default_rng(2)), latency_s=0.0, time_constant_s=0.03)
    whole, stepwise = Robot(world), Robot(world)
    offset = SeamOffset(4.8, -1.4, 10.0, 1.0, Validity.VALID)
    for robot in (whole, stepwise):
        robot.hear(offset, 0.0)
    whole.advance(0.2)
    places = [np.zeros(2)]
    for n in range(1, 201):
        stepwise.advance(0.001 * n)
        places.append(stepwise.offset_mm)
    np.testing.assert_allclose(whole.offset_mm, stepwise.offset_mm, atol=1e-9)
    speeds_mm_s = np.linalg.norm(np.diff(places, axis=0), axis=1) / 0.001
    assert speeds_mm_s.max() == pytest.approx(CORRECTION_MM_S)
    # 5 mm less the 0.9 mm at which the lag is as slow take 4.1 / 30 s, then it is a lag's.
    left_mm = 0.9 * math.exp(-(0.2 - 4.1 / 30.0) / 0.03)
    assert math.hypot(4.8 - whole.offset_mm[0], -1.4 - whole.offset_mm[1]) == pytest.approx(left_mm)


def test_an_offset_that_comes_twice_moves_the_robot_once():
    places = []
    for times in (1, 2):
        robot = Robot(draw_world(np.random.default_rng(3)))
        for n in range(times):
            robot.hear(SeamOffset(1.5, -0.5, 20.0, 0.9, Validity.VALID), 0.05 * n)
        robot.advance(5.0)
        places.append(robot.offset_mm)
    assert places[1] == pytest.approx(places[0], abs=1e-9)
    assert places[1] == pytest.approx([1.5, -0.5], abs=1e-6)


@pytest.mark.slow
def test_nothing_is_valid_before_a_struck_arc_is_steady_and_a_tack_hides_the_joint():
    loop = ClosedLoop(replace(QUICK, event="ignition", length_mm=20.0))
    levels = []
    loop.cell.scheduler.every(0.05, lambda: levels.append(loop.camera.level_now()), 0.01)
    loop.run()
    happened = loop.event_result()
    assert (happened.begin_s, happened.end_s) == (0.0, pytest.approx(0.9))
    assert set(happened.validities) == {"REFUSED"}
    assert "ROBOT_NOT_MOVING" in happened.reasons
    assert happened.valid_again_s < 1.0
    # The image had no arc, then an unsteady one, then a steady one.
    assert set(levels[:10]) == {0.0}
    assert np.std(levels[10:18]) > 0.3
    assert set(levels[18:]) == {1.0}
    assert "VALID again" in "\n".join(event_lines(happened))
    camera, robot = loop.camera, loop.cell.robot.robot
    camera.rng = np.random.default_rng(1)
    plain = camera.look().astype(float)
    first_mm = robot.station_mm + 32.0
    camera.rng, camera.tacks_mm = np.random.default_rng(1), ((first_mm, first_mm + 6.0),)
    hidden = camera.look() != plain
    columns = np.nonzero(hidden)[1]
    assert 0.01 < hidden.mean() < 0.1
    # The stripe's middle is under it, both its ends are not.
    assert hidden[:, columns.min() : columns.max()].any(axis=0).mean() > 0.95
    assert not hidden[:, :100].any()
    assert not hidden[:, -100:].any()


@pytest.mark.slow
def test_a_tack_that_looks_like_a_seam_that_jumps_is_no_doubt_of_the_poses():
    small = LoopPlan(joint="lap", length_mm=60.0, rate_hz=15.0, size_px=(160, 120), displaced_mm=2.0)
    loop = ClosedLoop(replace(small, slope=0.02, bend_mm=1.0, event="tack", exact=False))
    loop.run()
    assert any("seam_jump" in frame.track.flag_names for frame in loop.frames)
    assert loop.event_result().reasons == {}


@pytest.mark.slow
def test_an_arc_fault_moves_the_robot_back_and_it_goes_on():
    rng = np.random.default_rng(4)
    cell = JudgedCell(draw_world(rng), rng)
    cell.run(2.0)
    before_mm = cell.robot.robot.station_mm
    cell.scheduler.at(2.0 + arc_fault_s(cell.world), arc_fault(cell, rng))
    cell.run(2.0 + 0.3 + 0.75 + 0.1)
    assert cell.robot.robot.station_mm == pytest.approx(before_mm - 15.0, abs=0.1)
    assert cell.robot.robot.status.welding is WeldingState.IGNITING
    cell.run(5.0)
    assert cell.robot.robot.station_mm > before_mm - 15.0
    assert set(cell.validities(4.0, 5.0)) == {Validity.VALID}
