"""Profiles drawn from a setup: the sheet's trace on the joint, what hides it, noise, dropouts and echoes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Bool, Float64, Integers
from noise_model.instrument.profiler import Profiler
from noise_model.setup import Setup
from noise_model.surface.joint import corrugation_height

NOISE_MM, CORRELATED_COLUMNS = 0.01, 3
"""1 sigma of a height where a setup states none, mm; over so many columns speckle's grains reach."""

DROPOUT_SHARE, ECHO_SHARE, RUN_COLUMNS, ECHO_MM = 0.05, 0.03, 12, 5.0
"""Share of columns without a height, and with an echo's, in runs of so many; 1 sigma of an echo's distance.

A reflective groove's profiles have 5 to 10 % and 3 to 6 %.
"""


MAX_SLOPE = 4.0
"""Steepest slope that a height's sigma grows with: upright edges have none that is lit."""

MAX_STEPS, MET_MM = 100, 1e-9
"""Steps by which a column is met with a corrugation at most, and the last one's length.

A sheet that leans so far that it may meet a ridge thrice is not followed there.
"""


def trace_heights(setup: Setup, scene: Scene) -> Float64:
    """Return the heights (columns,) of a scene's surface in the profile's frame, mm, NaN where none is lit.

    A face is a plane along the seam, raised by the ridges of a corrugation. What another part hides from the
    laser's window is dark.
    """
    profiler = setup.profiler
    assert profiler is not None
    T_joint_profile = scene.T_joint_tool @ profiler.T_tool_profile
    y_mm, z_mm = profiler.y_mm, np.full(profiler.columns, np.nan)
    for corner, next_one in pairwise(scene.shape.vertices):
        face_mm = _heights_on_face(corner, next_one, scene.shape.corrugation, T_joint_profile, y_mm)
        z_mm = np.fmax(z_mm, face_mm)
    return np.where(_is_lit(y_mm, z_mm, profiler), z_mm, np.nan)


def _heights_on_face(
    corner: Float64, next_one: Float64, corrugation: Float64, T_joint_profile: Float64, y_mm: Float64
) -> Float64:
    """Return where columns (n,) meet a face between two corners (2,), mm; NaN beside it, or from below.

    With its plane's normal m a face holds m.(p - corner) = m_z c(x), c the corrugation; c is iterated.
    """
    along = next_one - corner
    (r_xz, r_yz, r_zz), normal = T_joint_profile[:3, 2], np.array([-along[1], along[0]])
    slope = normal[0] * r_yz + normal[1] * r_zz
    if not slope > 0.0:
        return np.full(len(y_mm), np.nan)
    x_0, y_0, z_0 = T_joint_profile[:3, 1:2] * y_mm + T_joint_profile[:3, 3:]
    level = normal[0] * (corner[0] - y_0) + normal[1] * (corner[1] - z_0)
    z_mm, ridge_mm, moved_mm = level / slope, np.zeros(len(y_mm)), np.full(len(y_mm), np.inf)
    for _ in range(MAX_STEPS):
        before_mm, ridge_mm = ridge_mm, corrugation_height(x_0 + r_xz * z_mm, corrugation)
        z_mm, moved_mm = (level + normal[1] * ridge_mm) / slope, np.abs(ridge_mm - before_mm)
        if (moved_mm < MET_MM).all():
            break
    place = (y_0 + r_yz * z_mm - corner[0]) * along[0] + (z_0 + r_zz * z_mm - ridge_mm - corner[1]) * along[1]
    is_on = (place >= 0.0) & (place <= along @ along) & (moved_mm < MET_MM)
    return np.where(is_on, z_mm, np.nan)


def _is_lit(y_mm: Float64, z_mm: Float64, profiler: Profiler) -> Bool:
    """Return where nothing nearer to the window's column rises over the ray to a point."""
    lit = np.zeros(len(y_mm), np.bool_)
    for side in (1.0, -1.0):
        outward = np.flatnonzero(side * y_mm >= 0.0)[:: int(side)]
        slope = (z_mm[outward] - profiler.stand_off_mm) / np.maximum(side * y_mm[outward], 1e-9)
        lit[outward] = slope >= np.maximum.accumulate(np.nan_to_num(slope, nan=-np.inf)) - 1e-9
    return lit


def draw_profile(setup: Setup, scene: Scene, rng: np.random.Generator) -> Integers:
    """Return a frame (2 or 3, columns) of a scene: heights with noise, dropouts and runs of false echoes."""
    assert setup.profiler is not None
    return spoilt_profile(setup.profiler, trace_heights(setup, scene), rng)


def spoilt_profile(profiler: Profiler, trace_mm: Float64, rng: np.random.Generator) -> Integers:
    """Return a frame (2 or 3, columns) of a surface's heights (columns,), mm, with noise, gaps and echoes.

    Where a profile has sigmas, a height's grows with the surface's slope, as does the light's spot on it.
    """
    n = profiler.columns
    white = rng.standard_normal(n + CORRELATED_COLUMNS - 1)
    noise = np.convolve(white, np.full(CORRELATED_COLUMNS, CORRELATED_COLUMNS**-0.5), "valid")
    sigma_mm = np.full(n, profiler.sigma_mm or NOISE_MM)
    if profiler.point_sigma:
        slope = np.nan_to_num(np.gradient(trace_mm, profiler.pitch_mm))
        sigma_mm *= np.hypot(1.0, np.clip(slope, -MAX_SLOPE, MAX_SLOPE))
    z_mm = trace_mm + sigma_mm * noise
    for share, is_echo in ((ECHO_SHARE, True), (DROPOUT_SHARE, False)):
        for start in rng.integers(0, n, rng.poisson(share * n / RUN_COLUMNS)):
            run = slice(start, start + 1 + rng.poisson(RUN_COLUMNS - 1))
            z_mm[run] = z_mm[run] + ECHO_MM * rng.standard_normal() if is_echo else np.nan
    intensity = np.where(np.isfinite(z_mm), 1000, 0).astype(np.uint16)
    return profiler.profile(z_mm, intensity, sigma_mm)
