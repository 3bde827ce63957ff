"""The latency and bandwidth budget, by hand and by a simulated bus."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arctrack.control.cell_file import read_cell_file
from arctrack.control.cell_file.new import write_new_cell
from arctrack.live.doctor.camera import CameraReading
from arctrack.live.doctor.examine import (
    LatencyPart,
    bandwidth_finding,
    budget_finding,
    budget_of,
    max_rows,
    transfer_s,
)
from arctrack.live.doctor.finding import FindingState
from arctrack.live.doctor.steps import StepTimes
from arctrack.live.serve.latency import LatencyCounts, Quantiles
from robot_io.protocol.bus_load import frame_bits, min_frame_bits, response_time_s
from robot_io.protocol.dbc import cycle_time_s, database


def quantiles(*times_ms: float) -> Quantiles:
    counts = LatencyCounts()
    for time_ms in times_ms:
        counts.add(1e-3 * time_ms)
    return counts.quantiles()


def test_a_gigabit_line_carries_the_rows_that_the_page_states() -> None:
    assert max_rows(1280, 1, 200.0) == 464
    assert transfer_s(1280 * 128) == pytest.approx(1.377e-3, rel=1e-3)
    assert (min_frame_bits(), frame_bits()) == (111, 135)


@given(st.integers(1, 10_000), st.sampled_from([1, 2]), st.floats(0.1, 5000.0))
def test_the_rows_that_fit_take_a_frames_period_and_one_more_does_not(
    width: int, pixel_bytes: int, rate_hz: float
) -> None:
    rows = max_rows(width, pixel_bytes, rate_hz)
    assert rate_hz * transfer_s(rows * width * pixel_bytes) <= 1.0 + 1e-12
    assert rate_hz * transfer_s((rows + 1) * width * pixel_bytes) > 1.0 - 1e-12


def simulated_response_s(name: str, frame_rate_hz: float, bit_rate_bit_s: float) -> float:
    """Let a message and all of higher priority be due at once, one bit after one of lower priority began."""
    layouts, longest_s = database().messages, frame_bits() / bit_rate_bit_s
    own_id = database().get_message_by_name(name).frame_id
    per_frame = ("SeamOffset", "SeamPoint", "SeamGeometry", "TrackerStatus")
    periods_s = [
        1.0 / frame_rate_hz if layout.name in per_frame else cycle_time_s(layout)
        for layout in layouts
        if layout.frame_id < own_id
    ]
    due_s, now_s = [0.0] * len(periods_s), longest_s
    while any(due <= now_s for due in due_s):
        first = next(n for n, due in enumerate(due_s) if due <= now_s)
        due_s[first] += periods_s[first]
        now_s += longest_s
    return now_s + longest_s


@given(
    st.sampled_from([layout.name for layout in database().messages]),
    st.sampled_from([125_000, 250_000, 500_000, 1_000_000]),
    st.floats(1.0, 150.0),
)
def test_the_longest_time_on_the_bus_is_that_of_a_simulated_one(
    name: str, bit_rate: int, rate_hz: float
) -> None:
    worked_out = response_time_s(name, rate_hz, bit_rate)
    assert worked_out.time_s == pytest.approx(simulated_response_s(name, rate_hz, bit_rate))
    assert worked_out.frames * frame_bits() / bit_rate == pytest.approx(worked_out.time_s)


def test_a_bus_that_is_full_has_no_longest_time() -> None:
    with pytest.raises(ValueError, match="take all of 125000 bit/s"):
        response_time_s("DbcVersion", 1000.0, 125_000)


def test_the_parts_sum_up_to_what_is_held_against_the_gate(tmp_path: Path) -> None:
    cell = read_cell_file(write_new_cell(tmp_path / "cell", "lap", "zn_coated")[0])
    steps = StepTimes(quantiles(2.0), quantiles(7.0), 1.0)
    budget = budget_of(cell, steps, quantiles(0.1))
    assert [part.name for part in budget.parts][:2] == ["half of the exposure", "transfer"]
    assert budget.parts[0] == LatencyPart("half of the exposure", 0.0025, 0.0025, "the setup")
    assert budget.typical_s == pytest.approx(sum(part.typical_s for part in budget.parts))
    assert budget.at_most_s > budget.typical_s
    assert budget_finding(budget).state is FindingState.OK
    tight = replace(budget, capture_age_s=0.5 * (budget.typical_s + budget.at_most_s))
    assert budget_finding(tight).state is FindingState.WARNING
    late = replace(budget, capture_age_s=0.5 * budget.typical_s)
    assert budget_finding(late).state is FindingState.FAILED
    live = budget_of(cell, steps, quantiles(0.1), CameraReading(25, 0, 25.0, quantiles(30.0, 40.0)))
    assert live.parts[0].at_most_s == pytest.approx(0.04)
    # A frame that comes later than any pose waits for none.
    assert next(part for part in live.parts if part.name == "wait for the pose").at_most_s == 0.0


def test_a_robots_port_answers_the_next_report(tmp_path: Path) -> None:
    cell = read_cell_file(write_new_cell(tmp_path / "cell", "lap", "zn_coated")[0])
    cell = replace(cell, bus=replace(cell.bus, interface="rsi", channel="127.0.0.1"))
    parts = {part.name: part for part in budget_of(cell, None, quantiles(0.1)).parts}
    assert "bus" not in parts
    assert (parts["port"].typical_s, parts["port"].at_most_s) == (0.005, 0.01)


def test_a_step_that_was_not_timed_is_not_known(tmp_path: Path) -> None:
    cell = read_cell_file(write_new_cell(tmp_path / "cell", "lap", "zn_coated")[0])
    budget = budget_of(cell, None, quantiles(0.1))
    assert math.isnan(budget.typical_s)
    assert budget_finding(budget).state is FindingState.WARNING


def test_more_rows_than_fit_are_named(tmp_path: Path) -> None:
    setup = read_cell_file(write_new_cell(tmp_path / "cell", "lap", "zn_coated")[0]).setup.setup
    assert bandwidth_finding(setup, 25.0, is_ethernet=True).state is FindingState.OK
    slow = bandwidth_finding(setup, 1000.0, is_ethernet=False)
    assert slow.state is FindingState.WARNING
    assert "it carries 185 rows" in slow.cure
    assert bandwidth_finding(setup, 1000.0, is_ethernet=True).state is FindingState.FAILED
