"""Where columns change faces: by the heights that they show, and by how often either face misses them."""

from __future__ import annotations

import numpy as np
import pytest

from noise_model.compiled.arrays import Bool
from tracker.joint.face_change import Columns, FaceChange, change_of_faces

PITCH_MM = 0.1


def change(
    before: Bool, n_open: int, behind: Bool, hidden_mm: float = 0.0, sigma_mm: float = 0.0
) -> FaceChange:
    """The change past the last column of the face before, mm, with so many open columns up to that behind."""
    seen = np.concatenate([before, np.zeros(n_open, np.bool_), behind])
    is_before, y_mm = np.arange(len(seen)) < len(before), PITCH_MM * np.arange(len(seen))
    off_before, off_behind = np.where(is_before, 0.0, 25.0), np.where(is_before, 25.0, 0.0)
    found = change_of_faces(Columns(seen, y_mm, y_mm, off_before, off_behind, PITCH_MM), hidden_mm, sigma_mm)
    return FaceChange(found.y_mm - PITCH_MM * (len(before) - 1), found.variance_mm2)


def missing(n: int, every: int, run: int) -> Bool:
    """Columns of a face of which a run is missed again and again; both ends are shown."""
    seen = np.arange(n) % every >= run
    seen[[0, -1]] = True
    return seen


@pytest.mark.parametrize("n_open", [0, 1, 8, 15])
def test_faces_that_miss_alike_leave_all_places_as_likely(n_open: int) -> None:
    face = missing(600, 30, 10)
    found, open_mm = change(face, n_open, face[::-1]), (n_open + 1) * PITCH_MM
    assert found.y_mm == pytest.approx(0.5 * open_mm, abs=0.1 * open_mm)
    assert found.variance_mm2 == pytest.approx(open_mm**2 / 12.0, rel=0.25)


def test_a_face_that_misses_nothing_ends_where_it_is_last_seen() -> None:
    whole, often = np.ones(600, np.bool_), missing(600, 30, 10)
    found, mirrored = change(whole, 10, often), change(often, 10, whole)
    # Of eleven columns in which the edge may lie.
    assert found.y_mm < 3.0 * PITCH_MM
    assert mirrored.y_mm > 8.0 * PITCH_MM
    assert max(found.variance_mm2, mirrored.variance_mm2) < (3.0 * PITCH_MM) ** 2


def test_what_the_edge_hides_is_open_for_sure() -> None:
    face = missing(600, 30, 10)
    found = change(face, 9, face[::-1], hidden_mm=0.9)
    assert found.y_mm == pytest.approx(0.5 * PITCH_MM, abs=0.4 * PITCH_MM)
    wider = change(face, 9, face[::-1], hidden_mm=0.9, sigma_mm=0.3)
    assert wider.variance_mm2 > 2.0 * found.variance_mm2


def test_no_place_is_known_better_than_a_column() -> None:
    whole = np.ones(100, np.bool_)
    found = change(whole, 0, whole)
    assert found.y_mm == pytest.approx(0.5 * PITCH_MM)
    assert found.variance_mm2 == pytest.approx(PITCH_MM**2 / 12.0)


def test_two_false_heights_do_not_move_an_edge() -> None:
    n = 200
    y_mm, is_before = PITCH_MM * np.arange(n), np.arange(n) < 100
    off_before, off_behind = np.where(is_before, 0.0, 25.0), np.where(is_before, 25.0, 0.0)
    for k in (60, 140):
        off_before[k], off_behind[k] = off_behind[k], off_before[k]
    found = change_of_faces(
        Columns(np.ones(n, np.bool_), y_mm, y_mm, off_before, off_behind, PITCH_MM), 0.0, 0.0
    )
    assert found.y_mm == pytest.approx(99.5 * PITCH_MM, abs=0.01)
