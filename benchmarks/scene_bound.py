"""How well a scene's frame can show its seam point at best: Cramer and Rao's bound, speckle included.

The frame's mean is rendered with the joint moved a little to either side, up and down, and with each of its
dimensions, its roll and the light's levels a little off: the differences are the derivatives J. The pixels
scatter by photons, reading and rounding, V, and with the stripe's light s by speckle of contrast C, which two
pixels share by rho, the correlation of grains of 1 sigma g at their distance:

    covariance_ij = V_i delta_ij + s_i s_j ((1 + C^2)^rho_ij - 1).

What is not known beforehand is its prior's; the bound is the inverse of J^T covariance^-1 J and the priors'
information, for the seam's y and z (Van Trees 1968, Detection, Estimation, and Modulation Theory, 2.4.3).
It is that of a fit which knows each bell's flanks to parts in a thousand, for there speckle says most. Beside
it stands what least squares make of the same frame and model with the photons' weights 1 / V:
H^-1 (J^T W covariance W J + priors) H^-1, H = J^T W J + priors (Huber 1967, Proc. 5th Berkeley Symp. 1, 221).
Saturated pixels tell nothing. Dim ones beside the stripe are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from noise_model.compiled.arrays import Float64, Int64
from validation.anywhere.random_scene import RandomScene, world_of
from validation.anywhere.swept_joint import SweptJoint, outline
from validation.anywhere.swept_light import with_ghost
from validation.anywhere.swept_world import SpeckleField, SweptWorld

MOVED_MM, MOVED_DEG = 0.05, 0.5
"""How far the joint is moved, or a dimension changed, to either side for a derivative."""

SIZE_SIGMA_MM, SIZE_SIGMA_DEG, ROLL_SIGMA_DEG, LEVEL_SIGMA = 0.3, 2.0, 2.0, 1.0
"""What is known beforehand, 1 sigma: lengths, angles, the plates' roll, the light's levels, relative."""

SEEN_SHARE = 0.003
"""A pixel with less of the stripe's brightest light is left out."""

GRAIN_REACH_PX = 3
"""Grains are taken to end so far from their middles: speckle of pixels twice as far apart is unlike."""

Change = Callable[[float], tuple[SweptJoint, Float64]]
"""What world and pose become where something is off by so much."""


class SeamBound(NamedTuple):
    """1 sigma of a seam point's y and z (2,), mm, tool frame: the bound, and that of least squares."""

    bound_mm: Float64
    least_squares_mm: Float64


def seam_bound(scene: RandomScene, n: int) -> SeamBound:
    """Return how well a frame of a scene shows its seam point."""
    T, sensor = scene.poses[n], scene.setup.sensor
    world = world_of(scene)
    background, stripe = _light(scene, world, scene.world, T)
    mean = background + stripe
    rows, columns = np.nonzero((stripe > SEEN_SHARE * stripe.max()) & (mean < sensor.full_well_e))
    if np.ptp(columns) > np.ptp(rows):
        # In order of the stripe's scan lines, neighbours are few pixels apart.
        order = np.lexsort((rows, columns))
        rows, columns = rows[order], columns[order]
    derivatives, priors = [], []
    for change, step, sigma in _changes(scene, T):
        ahead, behind = (sum(_light(scene, world, *change(side * step))) for side in (1.0, -1.0))
        derivatives.append((ahead - behind)[rows, columns] / (2.0 * step))
        priors.append(sigma)
    for light in (stripe, background):
        derivatives.append(light[rows, columns])
        priors.append(LEVEL_SIGMA)
    variance = (mean + sensor.read_noise_e**2 + sensor.gain_e_per_dn**2 / 12.0)[rows, columns]
    J = np.column_stack(derivatives)
    known = np.diag(np.array(priors) ** -2.0)
    banded = _covariance(rows, columns, variance, stripe[rows, columns], scene.speckle)
    bound = np.linalg.inv(J.T @ solveh_banded(banded, J, lower=True) + known)
    weighed = J / variance[:, None]
    inverse = np.linalg.inv(J.T @ weighed + known)
    scatter = inverse @ (weighed.T @ _times(banded, weighed) + known) @ inverse
    return SeamBound(*(np.sqrt(np.diagonal(squares)[:2]) for squares in (bound, scatter)))


def _light(scene: RandomScene, world: SweptWorld, joint: SweptJoint, T: Float64) -> tuple[Float64, Float64]:
    """Return what the rest and what the stripe, with its ghost, sends to the pixels (H, W), e-."""
    changed = copy(world)
    changed.joint = joint
    background, stripe = changed.mean_light(T, True, scene.arc_on)
    ghost = scene.around.ghost
    return background, stripe if ghost is None else with_ghost(stripe, ghost)


def _changes(scene: RandomScene, T: Float64) -> Iterator[tuple[Change, float, float]]:
    """Yield what may be off, the step of its derivative and its prior 1 sigma; y and z of the seam first."""

    def moved(axis: int, by_mm: float) -> tuple[SweptJoint, Float64]:
        there = T.copy()
        there[:3, 3] -= by_mm * T[:3, axis]
        return scene.world, there

    def rolled(by_deg: float) -> tuple[SweptJoint, Float64]:
        seam_tool, there = scene.world.seam_tool_mm(scene.setup, T), T.copy()
        there[:3, :3] = T[:3, :3] @ Rotation.from_euler("x", -by_deg, degrees=True).as_matrix()
        there[:3, 3] += (T[:3, :3] - there[:3, :3]) @ seam_tool
        return scene.world, there

    def resized(name: str, by: float) -> tuple[SweptJoint, Float64]:
        size = joint.dimensions | {name: joint.dimensions[name] + by}
        corners, seam = outline(replace(joint, dimensions=size))
        # The seam point stays where it is.
        return replace(scene.world, corners=corners - seam + scene.world.seam), T

    joint = scene.setup.joint
    yield partial(moved, 1), MOVED_MM, math.inf
    yield partial(moved, 2), MOVED_MM, math.inf
    yield rolled, MOVED_DEG, ROLL_SIGMA_DEG
    if scene.joint in ("plate", "closed_butt"):
        return
    for name, value in joint.dimensions.items():
        # A closed root cannot be narrower, and ridges are no part of the section.
        if value == 0.0 or (joint.has_ridges and name != "thickness_mm"):
            continue
        is_angle = name.endswith("_deg")
        step, sigma = (MOVED_DEG, SIZE_SIGMA_DEG) if is_angle else (MOVED_MM, SIZE_SIGMA_MM)
        yield partial(resized, name), step, sigma


def _covariance(
    rows: Int64, columns: Int64, variance: Float64, stripe: Float64, speckle: SpeckleField
) -> Float64:
    """Return the covariance of pixels (n,), its diagonals from the main one down."""
    n, reach = len(rows), 2 * GRAIN_REACH_PX
    index = np.full(np.array([rows.max(), columns.max()]) + 1 + 2 * reach, -1)
    index[rows + reach, columns + reach] = np.arange(n)
    grain = np.exp(-0.5 * (np.arange(-GRAIN_REACH_PX, GRAIN_REACH_PX + 1) / speckle.grain_px) ** 2)
    alike = np.correlate(grain, grain, "full") / (grain @ grain)
    spread_2 = math.log1p(speckle.contrast**2)
    pairs = []
    for down in range(-reach, reach + 1):
        for across in range(-reach, reach + 1):
            other = index[rows + reach + down, columns + reach + across]
            first = np.flatnonzero(other > np.arange(n))
            # The field is normal, the light its exponential.
            shared = math.expm1(spread_2 * alike[reach + down] * alike[reach + across])
            pairs.append((first, other[first], shared))
    width = max(int((second - first).max(initial=0)) for first, second, _ in pairs)
    banded = np.zeros((width + 1, n))
    banded[0] = variance + (speckle.contrast * stripe) ** 2
    for first, second, shared in pairs:
        banded[second - first, first] = shared * stripe[first] * stripe[second]
    return banded


def _times(banded: Float64, values: Float64) -> Float64:
    """Return a symmetric matrix of diagonals (k, n) times values (n, p)."""
    n = len(values)
    product = banded[0][:, None] * values
    for k, diagonal in enumerate(banded[1:], 1):
        if diagonal.any():
            product[k:] += diagonal[: n - k, None] * values[: n - k]
            product[: n - k] += diagonal[: n - k, None] * values[k:]
    return np.asarray(product)
