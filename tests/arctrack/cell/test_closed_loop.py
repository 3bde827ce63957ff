from __future__ import annotations

import csv
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from arctrack.cell.closed_loop import ClosedLoop, LoopPlan
from arctrack.cell.robot import Robot
from arctrack.cell.world import draw_world
from arctrack.cli import app
from robot_io import SeamOffset, Validity

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
def test_a_run_is_a_table_a_picture_and_some_lines(tmp_path):
    words = ["cell", "run", str(tmp_path / "out"), "--joint", "lap", "--length-mm", "3", "--fps", "20"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "the torch never locked onto the seam" in done.output
    assert "offsets: 0.0 % VALID; not as measured: NOT_ARMED" in done.output
    with (tmp_path / "out" / "run.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["validity"] for row in rows] == ["REFUSED"] * 6
    assert float(rows[-1]["seam_y_mm"]) == 3.0
    assert math.isnan(float(rows[-1]["offset_y_mm"]))
    assert float(rows[-1]["station_mm"]) == pytest.approx(10.0 * float(rows[-1]["time_s"]), abs=2e-3)
    image = cv2.imread(str(tmp_path / "out" / "run.png"))
    assert image is not None
    assert image.std() > 10.0


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
