"""Shift of a part: right within its covariance, or refused with the point that is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calibration.part_shift import PartPoint, PartShift, ShiftError, find_shift
from noise_model.compiled.arrays import Float64
from noise_model.transforms import transform
from tracker.find import FoundJoint, Kind

SIGMA_MM, ANGLE = 0.02, 0.001
CALIBRATION_MM = 0.1 * np.eye(3)


def moved_part(seed: int = 3) -> Float64:
    """A displacement (4, 4) by some 15 mm and 4 deg."""
    rng, T = np.random.default_rng(seed), np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rng.uniform(-2.5, 2.5, 3), degrees=True).as_matrix()
    T[:3, 3] = rng.uniform(-10.0, 10.0, 3)
    return T


def find(
    place_mm: Sequence[float],
    along: Sequence[float],
    T: Float64,
    rng: np.random.Generator | None,
    kind: Kind = "seam",
    *,
    slide_mm: float = 0.0,
    has_angles: bool = True,
) -> FoundJoint:
    """A find on a part displaced by T, in base; without a generator it is exact.

    The place is met `slide_mm` along the seam, and the calibration displaces it by an error common to all.
    """
    x = np.array(along, dtype=np.float64) / np.linalg.norm(along)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    axes = np.array([x, y, np.cross(x, y)]) @ T[:3, :3].T
    first = 1 if kind == "seam" else 0
    noise, turn, lean = np.zeros(3), np.zeros(2), 0.0
    if rng is not None:
        noise[first:] = rng.normal(0.0, SIGMA_MM, 3 - first)
        turn, lean = rng.normal(0.0, ANGLE, 2), rng.normal(0.0, ANGLE)
    covariance = np.diag([np.inf if first else SIGMA_MM**2, SIGMA_MM**2, SIGMA_MM**2])
    direction = axes[0] + turn @ axes[1:]
    face = axes[1] + lean * axes[2]
    return FoundJoint(
        kind=kind,
        refusal="",
        point_base_mm=transform(T, np.array(place_mm) + slide_mm * x)
        + noise @ axes
        + CALIBRATION_MM.sum(axis=0),
        axes_base=np.array([direction / np.linalg.norm(direction), axes[1], axes[2]]),
        covariance_mm2=covariance,
        direction_covariance=np.diag([ANGLE**2] * 2 if has_angles else [np.inf] * 2),
        calibration_base_mm=CALIBRATION_MM,
        calibration="one",
        faces_base=np.array([face, face]),
        face_sigmas_rad=np.array([ANGLE, np.nan]) if has_angles else np.full(2, np.nan),
        track=None,
    )


SEAMS = {
    "a": ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    "b": ((300.0, 0.0, 40.0), (0.0, 1.0, 0.0)),
    "c": ((300.0, 200.0, 0.0), (1.0, 0.2, 0.0)),
    "d": ((20.0, 220.0, 30.0), (0.1, 1.0, 0.3)),
    "e": ((150.0, 90.0, 80.0), (1.0, -1.0, 0.0)),
}


def pairs(T: Float64, seed: int | None = None, names: str = "abcde", kind: Kind = "seam") -> list[PartPoint]:
    rng = None if seed is None else np.random.default_rng(seed)
    return [
        PartPoint(
            name,
            find(*SEAMS[name], np.eye(4), rng, kind),
            find(*SEAMS[name], T, rng, kind, slide_mm=7.0 if kind == "seam" else 0.0),
        )
        for name in names
    ]


def off_mm(shift: PartShift, T: Float64) -> Float64:
    """The program's errors (n, 3) at the seams' places."""
    places = np.array([place for place, _ in SEAMS.values()])
    return np.asarray(transform(shift.T_shift, places) - transform(T, places))


@pytest.mark.parametrize("kind", ["seam", "end"])
def test_exact_points_give_the_exact_shift(kind: Kind) -> None:
    T = moved_part()
    shift = find_shift(pairs(T, kind=kind))
    # The calibration's common error is turned with the part: 0.17 mm by 4 degrees.
    assert np.abs(off_mm(shift, T)).max() < 0.02
    assert shift.wrong is None
    assert shift.chi2 < 1.0


def test_errors_are_those_of_the_covariance() -> None:
    T, squares = moved_part(), []
    for seed in range(60):
        shift = find_shift(pairs(T, seed), within_mm=1.0)
        error = shift.T_shift @ np.linalg.inv(T)
        turn = Rotation.from_matrix(error[:3, :3]).as_rotvec()
        move = transform(error, shift.center_mm) - shift.center_mm
        twist = np.concatenate([turn, move])
        squares.append(twist @ np.linalg.solve(shift.covariance, twist))
    low, high = chi2.ppf([0.001, 0.999], 6 * len(squares))
    assert low < sum(squares) < high


def test_a_calibration_that_was_renewed_in_between_counts_twice() -> None:
    points = pairs(moved_part())
    renewed = [point._replace(part=replace(point.part, calibration="another")) for point in points]
    assert find_shift(points).sigma_mm < 0.05
    assert find_shift(renewed, within_mm=2.0).sigma_mm > 0.1


@pytest.mark.parametrize("wrong", ["a", "c", "e"])
def test_a_wrong_point_is_named_and_left_out(wrong: str) -> None:
    T = moved_part()
    points = pairs(T, 8)
    for n, point in enumerate(points):
        if point.name == wrong:
            moved = point.part.point_base_mm + 0.8 * point.part.axes_base[1]
            points[n] = point._replace(part=replace(point.part, point_base_mm=moved))
    shift = find_shift(points, within_mm=1.0)
    assert shift.wrong is not None
    assert shift.wrong.name == wrong
    assert shift.wrong.p_value < 1e-6
    assert np.abs(off_mm(shift, T)).max() < 0.2


def test_where_too_few_points_disagree_none_is_named() -> None:
    T = np.eye(4)
    ends = [
        PartPoint(
            name,
            *(find((x_mm, 0.0, 0.0), (0.0, 1.0, 0.0), T, None, "end", has_angles=False) for _ in range(2)),
        )
        for name, x_mm in (("p", 0.0), ("q", 100.0))
    ]
    moved = ends[1].part.point_base_mm + np.array([1.0, 0.0, 0.0])
    ends[1] = ends[1]._replace(part=replace(ends[1].part, point_base_mm=moved))
    with pytest.raises(ShiftError, match="which of p, q is wrong cannot be told"):
        find_shift(ends)


def test_parallel_seams_do_not_tell_the_shift_along_them_but_an_end_does() -> None:
    T, rng = moved_part(), None
    parallel = [
        PartPoint(name, *(find((40.0 * n, y_mm, z_mm), (1.0, 0.0, 0.0), M, rng) for M in (np.eye(4), T)))
        for n, (name, y_mm, z_mm) in enumerate([("p", 0.0, 0.0), ("q", 150.0, 0.0), ("r", 80.0, 60.0)])
    ]
    with pytest.raises(ShiftError) as refused:
        find_shift(parallel)
    way = np.round(T[:3, 0], 2)
    assert f"a shift along ({way[0]:.2f}, {way[1]:.2f}, {way[2]:.2f})" in str(refused.value) or (
        f"a shift along ({-way[0] + 0:.2f}, {-way[1] + 0:.2f}, {-way[2] + 0:.2f})" in str(refused.value)
    )
    assert "known not at all" in str(refused.value)
    assert "the start, the end or a corner of the seam at " in str(refused.value)
    end = [PartPoint("s", *(find((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), M, rng, "end") for M in (np.eye(4), T)))]
    assert np.abs(off_mm(find_shift([*parallel, *end]), T)).max() < 0.05


def test_two_corners_leave_the_turn_about_their_line() -> None:
    corners = [
        PartPoint(
            name,
            *(
                find((x_mm, 0.0, 0.0), (0.0, 1.0, 0.0), np.eye(4), None, "corner", has_angles=False)
                for _ in range(2)
            ),
        )
        for name, x_mm in (("p", 0.0), ("q", 200.0))
    ]
    with pytest.raises(
        ShiftError, match=r"a turn about the axis along \(-?1.00, -?0.00, -?0.00\).*away from that axis"
    ):
        find_shift(corners, np.array([[100.0, 80.0, 0.0]]))
    # On a table it does not turn about x.
    assert find_shift(corners, free=("x", "y", "z", "rz")).sigma_mm < 0.1


def test_parts_that_differ_in_shape_make_the_shift_less_sure() -> None:
    points = pairs(moved_part(), 5)
    assert find_shift(points, within_mm=2.0, scatter_mm=0.2).sigma_mm > 3.0 * find_shift(points).sigma_mm


def test_what_a_wrong_point_does_unnoticed_is_within_its_bound() -> None:
    T, rng, largest_mm = np.eye(4), np.random.default_rng(2), 0.0
    points = pairs(T, names="abde")
    bound_mm = find_shift(points).unnoticed_mm
    for _ in range(150):
        n, error_mm = int(rng.integers(4)), rng.normal(size=3) * rng.uniform(0.0, 0.4)
        moved = points[n].part.point_base_mm + error_mm
        given = [*points]
        given[n] = points[n]._replace(part=replace(points[n].part, point_base_mm=moved))
        try:
            shift = find_shift(given, within_mm=2.0)
        except ShiftError:
            continue
        if shift.wrong is None:
            places = np.array([point.master.point_base_mm for point in points])
            largest_mm = max(
                largest_mm, float(np.linalg.norm(transform(shift.T_shift, places) - places, axis=1).max())
            )
    assert 0.2 * bound_mm < largest_mm < bound_mm


def test_without_redundancy_nothing_bounds_a_wrong_point() -> None:
    corner = [
        PartPoint(
            "p",
            *(
                find((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), np.eye(4), None, "corner", has_angles=False)
                for _ in range(2)
            ),
        )
    ]
    shift = find_shift(corner, free=("x", "y", "z"))
    assert (shift.redundancy, shift.unnoticed_mm) == (0, np.inf)
