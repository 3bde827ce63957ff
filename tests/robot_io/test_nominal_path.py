from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robot_io.poses.nominal_path import NominalPath

CORNER = NominalPath(((0.0, 0.0, 0.0), (100.0, 0.0, 0.0), (100.0, 50.0, 0.0)))
NUMBERS = st.floats(-50.0, 50.0)


def test_stations_run_on_round_a_corner():
    assert CORNER.length_mm == 150.0
    first, second = CORNER.place((40.0, 3.0, 2.0)), CORNER.place((98.0, 20.0, -1.0))
    assert (first.station_mm, first.lateral_mm, first.height_mm, first.segment) == (40.0, 3.0, 2.0, 0)
    assert (second.station_mm, second.lateral_mm, second.height_mm, second.segment) == (120.0, 2.0, -1.0, 1)
    assert CORNER.place((-10.0, 0.0, 0.0)).station_mm == -10.0
    assert CORNER.place((100.0, 60.0, 0.0)).station_mm == 160.0


def test_near_a_corner_both_pieces_count():
    assert len(CORNER.segments_near((99.0, 1.0, 0.0), 5.0)) == 2
    assert CORNER.segments_near((50.0, 1.0, 0.0), 5.0) == CORNER.segments[:1]
    straight = NominalPath(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    assert straight.segments_near((0.0, 9.0, 0.0), 1.0) == straight.segments


@given(st.tuples(NUMBERS, NUMBERS, NUMBERS), st.tuples(NUMBERS, NUMBERS, NUMBERS), st.integers(0, 10**6))
def test_coordinates_are_those_of_a_frame_on_the_path(point, origin, seed):
    R = Rotation.random(random_state=seed).as_matrix()
    start, end = np.array(origin), np.array(origin) + 80.0 * R[:, 0]
    place = NominalPath((tuple(start), tuple(end)), tuple(R[:, 2])).place(tuple(start + R @ point))
    np.testing.assert_allclose((place.station_mm, place.lateral_mm, place.height_mm), point, atol=1e-9)


@given(st.tuples(NUMBERS, NUMBERS))
def test_the_nearest_piece_is_taken(point):
    place = CORNER.place((*point, 0.0))
    x, y = point
    to_first = math.hypot(x - min(max(x, 0.0), 100.0), y)
    to_second = math.hypot(x - 100.0, y - min(max(y, 0.0), 50.0))
    assert place.segment == (0 if to_first <= to_second else 1)


@pytest.mark.parametrize(
    ("points", "normal", "message"),
    [
        (((0.0, 0.0, 0.0),), (0.0, 0.0, 1.0), "two points"),
        (((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), (0.0, 0.0, 1.0), "coincide"),
        (((0.0, 0.0, 0.0), (math.nan, 0.0, 0.0)), (0.0, 0.0, 1.0), "not finite"),
        (((0.0, 0.0, 0.0), (0.0, 0.0, 9.0)), (0.0, 0.0, 1.0), "runs along it"),
        (((0.0, 0.0, 0.0), (9.0, 0.0, 0.0)), (0.0, 0.0, 0.0), "runs along it"),
    ],
)
def test_what_is_no_path_is_an_error(points, normal, message):
    with pytest.raises(ValueError, match=message):
        NominalPath(points, normal)
