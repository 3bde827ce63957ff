"""Stored frames give the stored stripes, seams and flags: processors differ in the last bits only."""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from golden import CASES, FRAMES, SEAMS, STRIPES, numbers_of, replay, stored, stripe_of

TOLERANCES = {"mm": 5e-6, "mm2": 1e-5, "deg": 1e-4, "px": 2e-5}
PURE_NUMBER = 1e-5
"""How far processors may differ, by a column's unit: some five times what they do.

Light is kept in float32, and sums of it depend on the processor's vectors and fused products. Compiled for
SSE2 alone and for AVX-512 the cases differ by up to 1e-6 mm, 2e-6 mm^2, 2e-5 deg, 5e-6 px and 2e-6.
"""

Rows = dict[tuple[str, str], list[dict[str, str]]]


def tolerance_of(column: str) -> float:
    return TOLERANCES.get(column.rpartition("_")[2], PURE_NUMBER)


def rows_of(path: Path) -> Rows:
    """A reference's rows by case and frame."""
    rows: Rows = defaultdict(list)
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            rows[row.pop("case"), row.pop("frame")].append(row)
    return rows


@pytest.fixture(scope="module")
def seams() -> Rows:
    return rows_of(SEAMS)


@pytest.fixture(scope="module")
def stripes() -> Rows:
    return rows_of(STRIPES)


@pytest.mark.parametrize("name", CASES)
def test_the_golden_frames_give_the_golden_tracks(name: str, seams: Rows, stripes: Rows) -> None:
    for track in replay(CASES[name]):
        key = name, str(track.frame)
        (want,) = seams[key]
        assert (key, " ".join(track.flag_names)) == (key, want["flags"])
        numbers = numbers_of(track)
        assert ["flags", *numbers] == list(want)
        differ = {
            column: (value, float(want[column]))
            for column, value in numbers.items()
            if not np.isclose(value, float(want[column]), 0.0, tolerance_of(column), equal_nan=True)
        }
        assert not differ, key
        lines = [[float(value) for value in row.values()] for row in stripes.get(key, [])]
        np.testing.assert_allclose(stripe_of(track), lines, rtol=0.0, atol=TOLERANCES["px"], err_msg=str(key))


def test_each_stored_frame_and_row_is_replayed(seams: Rows) -> None:
    shots = [(name, shot) for name, case in CASES.items() for shot in case.shots]
    assert {stored(shot.image) for _, shot in shots} == set(FRAMES.glob("*.png"))
    assert [name for name, _ in seams] == [name for name, _ in shots]
