"""Profiles drawn from a setup: the sheet's trace on the joint, what hides it, noise, dropouts and echoes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Bool, Float64, Integers
from noise_model.instrument.profiler import Profiler
from noise_model.setup import Setup
from noise_model.transforms import invert, transform

NOISE_MM, CORRELATED_COLUMNS = 0.01, 3
"""1 sigma of a height where a setup states none, mm; over so many columns speckle's grains reach."""

DROPOUT_SHARE, ECHO_SHARE, RUN_COLUMNS, ECHO_MM = 0.05, 0.03, 12, 5.0
"""Share of columns without a height, and with an echo's, in runs of so many; 1 sigma of an echo's distance.

A reflective groove's profiles have 5 to 10 % and 3 to 6 %.
"""


def trace_heights(setup: Setup, scene: Scene) -> Float64:
    """Return the heights (columns,) of a scene's surface in the profile's frame, mm, NaN where none is lit.

    A section is swept along the seam, so the sheet cuts it in a polyline with the same corners. What another
    part hides from the laser's window is dark.
    """
    profiler = setup.profiler
    assert profiler is not None
    if setup.joint.has_ridges:
        raise ValueError("[joint] type: no profile is drawn of a corrugation; simulate images of it")
    corners = scene.shape.vertices
    T_profile_joint = invert(scene.T_joint_tool @ profiler.T_tool_profile)
    n_x, n_y, n_z = T_profile_joint[0, :3]
    x_mm = -(T_profile_joint[0, 3] + n_y * corners[:, 0] + n_z * corners[:, 1]) / n_x
    line = transform(T_profile_joint, np.column_stack([x_mm, corners]))[:, 1:]
    y_mm, z_mm = profiler.y_mm, np.full(profiler.columns, np.nan)
    for (y_a, z_a), (y_b, z_b) in pairwise(line):
        if y_b > y_a:
            on = (y_mm >= y_a) & (y_mm <= y_b)
            z_mm[on] = np.fmax(z_mm[on], z_a + (z_b - z_a) * (y_mm[on] - y_a) / (y_b - y_a))
    return np.where(_is_lit(y_mm, z_mm, profiler), z_mm, np.nan)


def _is_lit(y_mm: Float64, z_mm: Float64, profiler: Profiler) -> Bool:
    """Return where nothing nearer to the window's column rises over the ray to a point."""
    lit = np.zeros(len(y_mm), np.bool_)
    for side in (1.0, -1.0):
        outward = np.flatnonzero(side * y_mm >= 0.0)[:: int(side)]
        slope = (z_mm[outward] - profiler.stand_off_mm) / np.maximum(side * y_mm[outward], 1e-9)
        lit[outward] = slope >= np.maximum.accumulate(np.nan_to_num(slope, nan=-np.inf)) - 1e-9
    return lit


def draw_profile(setup: Setup, scene: Scene, rng: np.random.Generator) -> Integers:
    """Return a frame (2, columns) of a scene: heights with noise, dropouts and runs of false echoes."""
    assert setup.profiler is not None
    return spoilt_profile(setup.profiler, trace_heights(setup, scene), rng)


def spoilt_profile(profiler: Profiler, trace_mm: Float64, rng: np.random.Generator) -> Integers:
    """Return a frame (2, columns) of a surface's heights (columns,), mm, with noise, dropouts and echoes."""
    n = profiler.columns
    white = rng.standard_normal(n + CORRELATED_COLUMNS - 1)
    noise = np.convolve(white, np.full(CORRELATED_COLUMNS, CORRELATED_COLUMNS**-0.5), "valid")
    z_mm = trace_mm + (profiler.sigma_mm or NOISE_MM) * noise
    for share, is_echo in ((ECHO_SHARE, True), (DROPOUT_SHARE, False)):
        for start in rng.integers(0, n, rng.poisson(share * n / RUN_COLUMNS)):
            run = slice(start, start + 1 + rng.poisson(RUN_COLUMNS - 1))
            z_mm[run] = z_mm[run] + ECHO_MM * rng.standard_normal() if is_echo else np.nan
    intensity = np.where(np.isfinite(z_mm), 1000, 0).astype(np.uint16)
    return np.stack([profiler.codes(z_mm), intensity])
