from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from robot_io import GateReason, Switch, Validity
from robot_io.link.reconnecting import LinkFault
from validation.fault_schedules import schedules
from validation.fault_schedules.__main__ import app
from validation.fault_schedules.fault_kind import FaultKind
from validation.fault_schedules.judged_cell import JudgedCell
from validation.fault_schedules.kinds import KINDS
from validation.fault_schedules.schedules import ScheduleOutcome, run_schedule, run_schedules
from validation.fault_schedules.table import failures, table
from validation.fault_schedules.worlds import draw_world

pytestmark = pytest.mark.slow

NOTHING = FaultKind("nothing", lambda cell, rng: lambda: None)


def cell_of(seed):
    rng = np.random.default_rng(seed)
    return JudgedCell(draw_world(rng), rng)


@pytest.mark.parametrize("seed", range(3))
def test_a_cell_without_faults_follows_its_seam(seed):
    cell = cell_of(seed)
    cell.run(4.0)
    assert set(cell.validities(0.7, 4.0)) == {Validity.VALID}
    assert max(off_mm for t_s, off_mm in cell.torch_error_mm if t_s > 1.5) < 0.1
    assert {reason for t_s, reason in cell.reasons if t_s > 1.5} == {GateReason.NONE}


def test_the_weave_survives_and_an_offset_moves_the_robot_once():
    cell = cell_of(5)
    places = []
    cell.scheduler.every(0.01, lambda: places.append(cell.robot.robot.place_mm()[1]), 1.5)
    cell.run(4.0)
    off_mm = np.array(places) - np.mean(places)
    assert np.ptp(off_mm) == pytest.approx(2.0 * cell.world.weave_mm, rel=0.1)


def test_a_run_is_the_same_again():
    first, again = run_schedule(3, 7), run_schedule(3, 7)
    assert repr(first) == repr(again)
    cells = []
    for _ in range(2):
        cells.append(cell_of(9))
        cells[-1].run(1.5)
    assert repr(cells[0].received) == repr(cells[1].received)


@pytest.mark.parametrize("number", range(len(KINDS)), ids=[kind.name for kind in KINDS])
def test_each_fault_ends_as_it_must(number):
    outcome = run_schedule(11, number)
    assert outcome.fault == KINDS[number].name
    assert outcome.broken == ()


def test_what_must_hold_can_fail():
    # The same faults, held against what is not so.
    emergency = next(kind for kind in KINDS if kind.name == "emergency stop")
    silent = replace(NOTHING, stop_s=0.1, reasons=frozenset())
    (line,) = run_schedule(1, 0, [silent]).broken
    assert line.startswith("usable 0.1")
    (line,) = run_schedule(1, 0, [replace(emergency, reasons=frozenset({GateReason.ARC_OFF}))]).broken
    assert line == "said EMERGENCY_STOP"

    def for_ever(cell, rng):
        emergency.begin(cell, rng)
        return lambda: None

    (line,) = run_schedule(1, 0, [replace(emergency, begin=for_ever)]).broken
    assert line.startswith("not VALID again at the end: {<Validity.REFUSED: 2>: ")

    def moves_part(cell, rng):
        # The part goes on after the last that anyone tells of it.
        def end():
            later = replace(cell.world, displaced_mm=(9.0, 9.0))
            cell.scheduler.at(cell.scheduler.now_s + 1.57, lambda: setattr(cell, "world", later))

        return end

    (line,) = run_schedule(1, 0, [replace(NOTHING, begin=moves_part)]).broken
    assert line.startswith("the torch is off by ")


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"range_y_mm": 1e-6, "range_z_mm": 1e-6}, "an offset out of range"),
        ({"capture_age_s": 0.001, "hold_s": 0.001}, "an offset too old"),
    ],
)
def test_offsets_beyond_their_limits_are_seen(limits, said):
    def narrows_limits(cell, _):
        # The tracker keeps those of its own job.
        cell.job = replace(cell.job, limits=replace(cell.job.limits, **limits))
        return lambda: None

    assert any(
        line.startswith(said) for line in run_schedule(1, 0, [replace(NOTHING, begin=narrows_limits)]).broken
    )


def test_schedules_run_at_once_are_those_one_by_one():
    with schedules.executor(2) as pool:
        at_once = list(run_schedules(4, 3, pool))
    assert repr(at_once) == repr(list(run_schedules(4, 3)))


def test_the_table_says_what_became_of_each_fault():
    name = KINDS[0].name
    told = ScheduleOutcome(0, name, (), 0.02, 0.1, frozenset({"CAMERA_STOPPED"}))
    went_on = ScheduleOutcome(41, name, ("no",), math.nan, 0.3)
    row = table([told, went_on]).splitlines()[2]
    assert row == f"| {name}, 1 of 2 failed | 0.02, 0.02; go on in 1 | CAMERA_STOPPED | 0.30, 0.30 |  |"
    assert list(failures(7, [told, went_on])) == [f"--seed 7 --only 41: {name}: no"]


def test_the_command_prints_the_table_and_what_failed(monkeypatch):
    done = CliRunner().invoke(app, ["--seed", "2", "--only", "20"])
    assert done.exit_code == 0
    assert KINDS[20].name in done.stdout
    monkeypatch.setattr(schedules, "KINDS", ())
    broken = replace(run_schedule(2, 20, KINDS), broken=("no",))
    monkeypatch.setattr(schedules, "run_schedule", lambda seed, number: broken)
    failed = CliRunner().invoke(app, ["--seed", "2", "--count", "1"])
    assert failed.exit_code == 1
    assert "--seed 2 --only 20" in failed.stderr


def test_the_robot_says_what_the_fault_makes_it_say():
    cell = cell_of(2)
    kind = next(kind for kind in KINDS if kind.name == "arc off")
    cell.run(1.0)
    end = kind.begin(cell, cell.rng)
    assert cell.robot.robot.status.arc is Switch.OFF
    end()
    assert cell.robot.robot.status.arc is Switch.ON


def test_a_full_disk_stops_nothing_and_is_said():
    cell = cell_of(2)
    kind = next(kind for kind in KINDS if kind.name == "disk full")
    cell.run(1.0)
    end = kind.begin(cell, cell.rng)
    cell.run(1.3)
    unlogged = cell.tracker.faults[LinkFault.UNLOGGED]
    assert unlogged > 50
    assert set(cell.validities(1.0, 1.3)) == {Validity.VALID}
    end()
    cell.run(3.0)
    # A second after it was tried last, the log goes on in another file.
    assert set(cell.tracker.disk.frames) == {"bus.blf", "bus.1.blf"}
    assert unlogged < cell.tracker.faults[LinkFault.UNLOGGED] < 10 * unlogged
    assert cell.tracker.said == [
        "log bus.blf: cannot be written: No space left on device; frames are left out"
    ]


def test_the_page_has_a_row_for_each_fault():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "cell.md").read_text()
    rows = (
        page.partition("<!-- schedules: begin -->")[2]
        .partition("<!-- schedules: end -->")[0]
        .splitlines()[3:]
    )
    listed = [(cells[1].strip(), cells[5].strip()) for cells in (row.split("|") for row in rows)]
    stated = [(kind.name, kind.note) for kind in KINDS]
    assert listed == stated, "print the table anew: the page names the command"
