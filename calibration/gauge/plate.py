"""The laser sheet from its stripe on any flat plate, at several poses of the robot.

The plate is a gauge of one face. In the camera's frame a point at the ray r is r / (a.r), a the sheet's plane
over its distance, and lies on the plate m.p = c: the stripe is the image line m - c a. Poses change m and c
in a known way: travel tells the plate's tilt, heights the pencil of m and a, tilts of the tool the rest. Both
sheet and plate have a wide prior. The posterior's sigma over the prior's is what the plate has told of each
(Gelman et al., Bayesian Data Analysis, 2013, section 4.3).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.camera.enough import UndeterminedError
from calibration.gauge.adjustment import (
    SHEET,
    STEPS,
    GaugeFit,
    GaugeProblem,
    GaugeState,
    Sighting,
    fit,
    inverse,
)
from calibration.gauge.calibrate import (
    HELD,
    GaugeCalibration,
    fit_consistent,
    small_sample_factor,
    telling_motions,
)
from calibration.gauge.shape import PLATE
from calibration.laser.image_line import FAR_SIGMAS, fit_line
from calibration.laser.plane import foot_on, points_on_sheet
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.transforms import transform

SHEET_PRIOR = np.array([math.radians(2.0), math.radians(2.0), 5.0])
"""1 sigma of a laser that was put back: its leans along and about the stripe, rad, and its place, mm."""

PLATE_TILT, PLATE_MM = math.radians(5.0), 100.0
"""1 sigma of a plate that lies by eye, against the surface that the setup states: tilts, and height."""

PLATE_REACH_MM = 100.0
"""A plate whose height is stated to some mm lies so over that length to either side of the stripe."""

USUAL_MM = (0.1, 0.1)
"""1 sigma of a robot's pose along the plate's normal from pose to pose, and of the plate's form."""

OF_PLATE = [3, 4, 7]
"""Places of the plate's tilts and height among the unknowns; its turn and place in its plane mean nothing."""

ANNEALING = (300.0, 30.0, 5.0)
"""Factors of the usual errors in the robust fits that tell stripes on the plate from others."""

MIN_FRAMES = 3
"""Two frames and the prior fit any plate; the third one says whether it is flat."""

DETERMINED = 0.5
"""A sigma of less than this share of its prior comes from the plate more than from the prior."""

MAX_NOISE = 5.0
"""Largest scatter of the stripes about the plate, in the errors that are usual: more is no plane."""

WORDS = ("lean along the stripe", "lean about the stripe", "place")


@dataclass(frozen=True)
class PlateCalibration(GaugeCalibration):
    """A sheet by a plate, with the covariance (3, 3) of its leans and place.

    `motions` would tell more of it, the most telling first.
    """

    moves_covariance: Float64
    motions: tuple[str, ...]

    @property
    def tilt_offset_covariance(self) -> Float64:
        """Covariance (3, 3) of leans and place."""
        return self.moves_covariance * small_sample_factor(PLATE, len(self.fitted.counts)) ** 2

    @property
    def share_left(self) -> Float64:
        """Share of the sigmas beforehand that leans and place (3,) still have."""
        return np.asarray(np.sqrt(np.diag(self.moves_covariance)) / SHEET_PRIOR)

    @property
    def untold(self) -> list[str]:
        """Those of leans and place of which the plate says little or nothing."""
        return [word for word, share in zip(WORDS, self.share_left, strict=True) if share > DETERMINED]

    @property
    def moved(self) -> Float64:
        """The leans, rad, and the place, mm, (3,) against the sheet as stated."""
        return self.fitted.step[SHEET]


def plate_sighting(name: str, T_base_tool: Float64, rays: Float64, along_rows: bool) -> Sighting:
    """Return a stripe on a plate by its rays (n, 3), camera frame, z = 1, with the robot's pose (4, 4), mm.

    Two points of a parabola stand for it: a sheet's bow bends it, stated or not.
    """
    course = fit_line(rays, along_rows, degree=2)
    ends = [0, -1]
    return Sighting(
        name,
        T_base_tool,
        course.rays[ends],
        np.zeros(2, dtype=np.int64),
        np.tile(course.across, (2, 1)),
        course.covariance[np.ix_(ends, ends)],
    )


def calibrate_by_plate(
    setup: Setup, sightings: Sequence[Sighting], plate_mm: float | None = None, robot_mm: float | None = None
) -> PlateCalibration:
    """Correct a setup's sheet by its stripe on a plate that stands still.

    `plate_mm` is 1 sigma of the plate's distance from the surface that the setup states; without it the plate
    may lie at any height. `robot_mm` is the robot's error from pose to pose as far as it is known.
    UndeterminedError, with what is missing, where too few stripes lie on one plane, and where these say
    nothing of the sheet.
    """
    if len(sightings) < MIN_FRAMES:
        raise UndeterminedError(
            f"frames at {len(sightings)} poses show a stripe, {MIN_FRAMES} poses are needed: scan a flat "
            "plate at two or three heights"
        )
    usual_mm = (robot_mm or USUAL_MM[0], USUAL_MM[1])
    camera = setup.camera
    problem = GaugeProblem(PLATE, camera.T_tool_camera, tuple(sightings), usual_mm)
    start = _start(setup, problem, plate_mm is not None)
    known = np.full(len(STEPS), HELD)
    known[SHEET] = SHEET_PRIOR
    height_mm = PLATE_MM if plate_mm is None else plate_mm
    tilt = min(PLATE_TILT, height_mm / PLATE_REACH_MM)
    known[OF_PLATE] = [tilt, tilt, height_mm]
    problem, left_out = _without_others(problem, start, known)
    problem, fitted = fit_consistent(problem, start, known, left_out)
    scatter_mm = fitted.noise_mm / usual_mm
    if scatter_mm.max() > MAX_NOISE:
        raise UndeterminedError(
            f"the stripes lie {fitted.noise_mm.max():.2g} mm off one plane, 1 σ: the plate is not flat or "
            "has moved, or the poses are not the tool's"
        )
    moves = _moves_covariance(problem, start, fitted, known)
    result = PlateCalibration(problem, fitted, left_out, moves, tuple(telling_motions(problem, fitted)))
    if len(result.untold) == len(WORDS):
        raise UndeterminedError(
            f"the plate says nothing of the sheet: {' and '.join(result.motions)}, or state by --plate-mm "
            "how well the setup's [joint] states the plate's height"
        )
    return result


def _without_others(
    problem: GaugeProblem, start: GaugeState, known: Float64
) -> tuple[GaugeProblem, dict[str, str]]:
    """Return the problem of the stripes on one plane, and the others with the reason: reflections, edges.

    UndeterminedError where most lie on none.
    """
    fitted, sightings = None, problem.sightings
    for factor in ANNEALING:
        wider_mm = factor * np.array(problem.usual_mm)
        fitted = fit(problem, start, wider_mm, known, fitted, loss="cauchy")
    assert fitted is not None
    # In mm: far off, where a ray hardly meets the sheet, the misfit in the image is no measure.
    off_mm = np.abs(problem.distances(fitted.state)).reshape(len(sightings), -1).max(axis=1)
    kept = off_mm <= FAR_SIGMAS * wider_mm.max()
    if 2 * kept.sum() <= len(kept):
        raise UndeterminedError(
            f"{len(kept) - kept.sum()} of {len(kept)} stripes are off the others' plane: the plate must be "
            "flat, stand still and be as long as the stripe"
        )
    names = [each.name for each, is_kept in zip(sightings, kept, strict=True) if not is_kept]
    others = dict.fromkeys(names, "its stripe is far off the plane of the others: a reflection, or an edge")
    on_plane = tuple(each for each, is_kept in zip(sightings, kept, strict=True) if is_kept)
    return replace(problem, sightings=on_plane), others


def _moves_covariance(problem: GaugeProblem, start: GaugeState, fitted: GaugeFit, known: Float64) -> Float64:
    """Return the covariance (3, 3) of the sheet's leans and place about a fit.

    On a given plate they are known almost linearly, but they hang on the plate by products: a lean over a
    height. The plate's errors are carried by sigma points (Julier and Uhlmann, Proc. SPIE 3068, 1997).
    """
    given = known.copy()
    given[OF_PLATE] = HELD
    state, per_plane = fitted.state, np.zeros((3, 4))
    per_plane[:2, :3], per_plane[2] = state.leans, [*state.centre_mm, 1.0]
    covariance = inverse(fitted.information[SHEET, SHEET])
    roots = np.linalg.cholesky(fitted.covariance[np.ix_(OF_PLATE, OF_PLATE)]).T * math.sqrt(len(OF_PLATE))
    for root in (*roots, *-roots):
        of_plate, of_sheet = np.zeros((2, len(known)))
        of_plate[OF_PLATE], of_sheet[SHEET] = fitted.step[OF_PLATE] + root, fitted.step[SHEET]
        before = replace(fitted, step=of_sheet)
        there = fit(problem, start.moved(of_plate), fitted.noise_mm, given, before).state
        move = per_plane @ (there.plane - state.plane)
        covariance += np.outer(move, move) / (2 * len(OF_PLATE))
    return covariance


def _start(setup: Setup, problem: GaugeProblem, is_stated: bool) -> GaugeState:
    """Return the sheet as stated, and the plate as stated or at the height of the stripes on that sheet."""
    T = setup.camera.T_tool_camera
    points, in_base = [], []
    for each in problem.sightings:
        met = points_on_sheet(setup.laser, T[:3, 3], each.rays @ T[:3, :3].T)
        points.append(met)
        in_base.append(transform(each.T_base_tool, met))
    normal = np.array(setup.joint.surface_normal_in_base)
    normal = normal / np.linalg.norm(normal)
    middle = np.median(np.concatenate(in_base), axis=0)
    if is_stated:
        middle = middle - normal * (normal @ (middle - np.array(setup.joint.seam_in_base_mm[0])))
    x = np.linalg.svd(normal[np.newaxis])[2][1]
    T_base_gauge = np.eye(4)
    T_base_gauge[:3] = np.column_stack([x, np.cross(normal, x), normal, middle])
    centre = foot_on(setup.laser.plane, np.median(np.concatenate(points), axis=0))
    return GaugeState(setup.laser, T_base_gauge, centre, PLATE.size_mm)
