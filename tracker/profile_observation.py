"""Observation of a profiler's frame about an expected seam: its points become the stripe's scan lines.

A column is a scan line of the equivalent camera (`noise_model.instrument.profiler`), its height the stripe's
centre. What remains of reading a stripe is the choice of the points that are the surface's, and how they
scatter. There is no light: edges lie where points say, and no second stripe is weighed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64, Integers
from noise_model.compiled.median import numbers_for
from noise_model.instrument.profiler import Profiler
from tracker import checks
from tracker.arc.burning import NO_EVIDENCE, ArcEvidence
from tracker.arc.level import UNKNOWN, ArcLevel
from tracker.checks import FrameChecks
from tracker.geometry import SEARCH_REACH_MM, SensorGeometry
from tracker.joint.measured import section_at, shift_of
from tracker.joint.plate_lines import SLACK_MM
from tracker.observation import MIN_HELD_SHARE, WHOLE_SHARE, Aim, FrameInput, section_of
from tracker.profile import MIN_POINTS, EdgeAlongSeam, Section, triangulate
from tracker.seam.locate import straightened
from tracker.state import (
    AMPLITUDE_E,
    BESIDE_PX,
    BIAS_PX,
    CENTRE_PX,
    MISFIT_PX,
    N_LINES,
    N_ROWS,
    OWN_PX,
    SCAN,
    SIGMA_PX,
    Y_MM,
    Z_MM,
    Stripe,
)
from tracker.stripe.frame_scatter import N_SCRATCH, frame_scatter
from tracker.stripe.light import NO_LIGHT
from tracker.stripe.line_fit.lines import N_FITTED
from tracker.stripe.profile_trace import likeliest_trace
from tracker.stripe.scatter import N_NUMBERS, FrameScatter, Scatter, add_frame, line_variance_px2, widen

REACH_MM, SHIFT_STEP_MM = 3.0, 0.2
"""Points count up to so far off the stated section, displaced in such steps: plates and bevels tilt."""

FINE_STEP_MM = 0.02
"""The steps of a second search next to the best of the first.

By half of one a bevel's points lie a third of a column's pitch off, as by their noise. By half of a step of
the first they lie three pitches off, and the trace takes a whole bevel for echoes.
"""


class ProfileReading(NamedTuple):
    """Points of a profile as a stripe, its scan lines (N_ROWS, n), and the scatter up to this frame.

    `left_out` (N_ROWS, n) are the lines whose points are not on the trace.
    """

    stripe: Stripe
    lines: Float64
    left_out: Float64
    scatter: Scatter


class ProfileObservation(NamedTuple):
    """Result of one observation of a profile, as `Observation` is of an image."""

    arc: ArcLevel = UNKNOWN
    evidence: ArcEvidence = NO_EVIDENCE
    stripe: ProfileReading | None = None
    section: Section | None = None


def observe_profile(given: FrameInput, frame_checks: FrameChecks, aim: Aim) -> ProfileObservation:
    """Look for the section about a seam in a profile."""
    geometry = given.geometry
    if not frame_checks.ask_whether(checks.CAMERA_ABOVE, not aim.scene.below_surface):
        return ProfileObservation()
    if not frame_checks.ask_whether(checks.LASER_ON, given.frame.laser_on):
        return ProfileObservation()
    reading = read_profile(given, aim)
    seen = ProfileObservation(stripe=reading)
    edge = EdgeAlongSeam(geometry.seam_source.height_mm, aim.seam.slope_sigma, 1.0)
    seen_points = triangulate(geometry.stripe_source, aim.scene, reading.lines, edge)
    span_mm = geometry.seam_source.aside_mm
    if geometry.setup.joint.type == "edge":
        # Beyond its sheets there is nothing to see.
        span_mm = float(np.abs(aim.scene.shape.vertices[1:-1, 0]).max())
    near = int((np.abs(seen_points.points[Y_MM]) < span_mm).sum())
    share = near * seen_points.column_mm / (2.0 * span_mm) if near > 1 else 0.0
    if not frame_checks.ask(checks.LINES_HELD, share, MIN_HELD_SHARE):
        return seen
    frame_checks.ask(checks.STRIPE_WHOLE, share, WHOLE_SHARE)
    section = section_of(geometry, aim, seen_points, NO_LIGHT)
    left_out = triangulate(geometry.stripe_source, aim.scene, reading.left_out, edge)
    off_trace = straightened(
        geometry.seam_source, aim.scene, aim.seam.station_mm, aim.reach_mm, left_out.points
    )
    return seen._replace(section=section._replace(off_trace=off_trace, n_columns=reading.lines.shape[1]))


def read_profile(given: FrameInput, aim: Aim) -> ProfileReading:
    """Return the points on the trace as scan lines, with the scatter that neighbours and frames show."""
    profiler, codes = given.geometry.setup.profiler, given.frame.image_dn
    assert profiler is not None
    centre_px = profiler.rows_px(profiler.z_mm(codes[0]))
    expected_px = centre_px - off_expected_px(given.geometry, aim, centre_px)
    off_px = centre_px - expected_px
    near = np.flatnonzero(np.abs(off_px) < REACH_MM / profiler.pitch_mm)
    own_px = own_sigmas_px(codes, profiler)
    before, frames = aim.scatter.average.numbers, aim.scatter.frames
    scatter_px2 = line_variance_px2(before) if frames else _neighbours_px(off_px) ** 2
    on_trace = likeliest_trace(near.astype(np.float64), off_px[near], own_px[near] ** 2 + scatter_px2)
    kept = near[on_trace]
    n = len(centre_px)
    fits = np.full((n, N_FITTED), math.nan)
    fits[kept, 0], fits[kept, 2], fits[kept, 3] = centre_px[kept], codes[1, kept], 1.0
    ones, own = np.ones(n), np.where(np.isfinite(fits[:, 0]), own_px, math.nan)
    seen, after = np.empty(N_NUMBERS), np.empty(N_NUMBERS)
    frame_scatter(
        fits=fits,
        expected_px=expected_px,
        width_px=ones,
        sigma_px=own,
        core=np.full(n, math.nan, np.float32),
        n_lines=ones,
        is_smooth=np.ones(n, np.bool_),
        learned=before,
        is_searching=aim.reach_mm >= SEARCH_REACH_MM,
        values=np.empty(numbers_for(n), np.float32),
        scratch=np.empty((N_SCRATCH, n)),
        seen=seen,
    )
    add_frame(before, frames, seen, after)
    lines = np.full((N_ROWS, n), math.nan)
    lines[CENTRE_PX], lines[OWN_PX], lines[SCAN], lines[N_LINES] = fits[:, 0], own, np.arange(n), 1.0
    lines[BIAS_PX], lines[MISFIT_PX] = 0.0, 0.0
    left_out = lines.copy()
    widen(after, own, ones, 0.0, lines[SIGMA_PX], lines[BESIDE_PX])
    widen(after, own_px, ones, 0.0, left_out[SIGMA_PX], left_out[BESIDE_PX])
    left_out[CENTRE_PX] = math.nan
    others = near[~on_trace]
    left_out[CENTRE_PX, others] = centre_px[others]
    stripe = Stripe(
        position_px=lines[CENTRE_PX],
        sigma_px=lines[SIGMA_PX],
        amplitude_e=fits[:, 2],
        saturated=np.zeros(n, np.bool_),
        along_rows=given.geometry.along_rows,
        beside_px=lines[BESIDE_PX],
    )
    return ProfileReading(stripe, lines, left_out, Scatter(FrameScatter.of(after), frames + 1))


def off_expected_px(geometry: SensorGeometry, aim: Aim, centre_px: Float64) -> Float64:
    """Return the distances (n,) of a profile's centres from the stated section's, px; NaN where none is.

    The section is displaced within the look's reach to where most points are near it. That does not place an
    upright edge: near one a point may be of either face.
    """
    n = len(centre_px)
    lines = np.zeros((N_ROWS, n))
    lines[CENTRE_PX], lines[AMPLITUDE_E], lines[SCAN], lines[N_LINES] = centre_px, math.nan, np.arange(n), 1.0
    points, corners = triangulate(geometry.stripe_source, aim.scene, lines).points, aim.scene.shape.vertices
    off_px = np.full(n, math.nan)
    if points.shape[1] < MIN_POINTS:
        return off_px
    y_mm, z_mm = points[Y_MM], points[Z_MM]
    coarse_mm, _ = shift_of(y_mm, z_mm, aim.reach_mm + REACH_MM, corners, 0.0, SHIFT_STEP_MM, REACH_MM)
    fine_mm, up_mm = shift_of(y_mm - coarse_mm, z_mm, SHIFT_STEP_MM, corners, 0.0, FINE_STEP_MM, REACH_MM)
    aside_mm = coarse_mm + fine_mm
    off_mm = section_at(corners, y_mm - aside_mm)[0] + up_mm - z_mm
    for face_mm in faces_of_edges(corners, y_mm - aside_mm):
        other_mm = face_mm + up_mm - z_mm
        off_mm = np.where(np.abs(other_mm) < np.abs(off_mm), other_mm, off_mm)
    assert geometry.setup.profiler is not None
    off_px[points[SCAN].astype(np.int64)] = off_mm / geometry.setup.profiler.pitch_mm
    return off_px


def faces_of_edges(corners_mm: Float64, y_mm: Float64) -> Iterator[Float64]:
    """Yield the heights (n,), mm, of both faces at each upright edge, carried on; NaN farther off it.

    `corners_mm` (k, 2) are a section's, y (n,) places in it.
    """
    for k in np.flatnonzero(np.diff(corners_mm[:, 0]) == 0.0):
        for corner, next_one in ((corners_mm[k], corners_mm[k - 1]), (corners_mm[k + 1], corners_mm[k + 2])):
            slope = (next_one[1] - corner[1]) / (next_one[0] - corner[0])
            away_mm = y_mm - corner[0]
            yield np.where(np.abs(away_mm) < SLACK_MM, corner[1] + slope * away_mm, math.nan)


def own_sigmas_px(profile: Integers, profiler: Profiler) -> Float64:
    """Return 1 sigma of each height (n,) by itself, px: as stated, at least that of the heights' steps."""
    codes = profile[0]
    steps = np.diff(np.sort(codes[codes > 0]))
    apart = steps[steps > 0]
    step_mm = profiler.step_mm * (float(apart.min()) if len(apart) else 1.0)
    own_mm = profiler.own_sigmas_mm(profile)
    own_mm[np.isnan(own_mm)] = profiler.sigma_mm
    return np.maximum(own_mm, step_mm / math.sqrt(12.0)) / profiler.pitch_mm


def _neighbours_px(off_px: Float64) -> float:
    """Return 1 sigma of a height by the differences of neighbours, px, whatever echoes do."""
    differences = np.abs(np.diff(off_px))
    known = differences[np.isfinite(differences)]
    return float(np.median(known)) / 0.954 if len(known) else 0.0
