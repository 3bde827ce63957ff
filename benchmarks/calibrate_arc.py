"""`arctrack calibrate arc` on random arcs and metals of known truth, over a flat plate.

    python benchmarks/calibrate_arc.py [--worlds 400] [--seed 1]

Each world has an arc, a metal and a camera that are off their stated values, a plate off its place, six
poses, texture, flicker and slow fields of brightness. The light is summed here over a hemisphere's nodes in
NumPy, with lens, reflectance and plate of this file alone: no line of the estimator's model draws it. Bias,
coverage and error are those of what was not refused. The bound is the Bayesian one of Cramer and Rao at the
true values, with the estimator's derivatives there.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from calibration_tally import Tally, judge_worlds
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from arctrack.nominal import nominal_setup
from calibration.arc.calibrate import KEYS, calibrate_arc
from calibration.arc.problem import (
    ARC,
    C2,
    PART_SIGMAS,
    RADIUS,
    RATIO,
    ArcProblem,
    PartPlacement,
    X,
    Y,
    Z,
)
from calibration.hand_eye_arc import FIELD_SIGMA
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.brdf import Material
from noise_model.surface.joint import Joint
from tracker.state import Frame

WIDTH, HEIGHT, GRID_PX = 320, 240, 10
POLAR, AZIMUTHS = 24, 48
"""Nodes over the hemisphere."""

POSES, CLEAR_MM, MAX_TRIES = 6, 3.0, 18
"""A world's poses, how far from the arc's surface their views end at least, and how many poses are tried."""

NEARER_MM = 12.0
"""By so much at most a world's view is nearer to the arc than that of the nominal setup."""

PEAK_E = 12000.0
"""The brightest pixel of a world's first frame."""


@dataclass(frozen=True, eq=False)
class World:
    """What is stated, what is true, and the frames with their poses."""

    stated: Setup
    true: Setup
    frames: list[tuple[Frame, Float64]]
    texture: float
    flicker: float


def light(true: Setup, T_base_tool: Float64, plate: tuple[float, float]) -> Float64 | None:
    """Return the arc's light (H / GRID, W / GRID), e-, over a plate z = height + slope x.

    None where the view comes near to the arc itself.
    """
    camera, arc, metal = true.camera, true.arc, true.material
    u, v = np.meshgrid(np.arange(0.0, WIDTH + GRID_PX, GRID_PX), np.arange(0.0, HEIGHT + GRID_PX, GRID_PX))
    xy = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    T_base_camera = T_base_tool @ camera.T_tool_camera
    rays = xy @ T_base_camera[:3, :3].T
    eye = T_base_camera[:3, 3]
    height, slope = plate
    normal = np.array([-slope, 0.0, 1.0]) / math.hypot(1.0, slope)
    on_plate = np.array([0.0, 0.0, height])
    way = ((on_plate - eye) @ normal) / (rays @ normal)
    points = eye + way[..., None] * rays
    # Below the tool's point, along base's z, on the plate; then up along the plate's normal.
    foot = T_base_tool[:3, 3] + T_base_tool[:3, :3] @ np.asarray(arc.center_in_tool_mm)
    foot[2] = height + slope * foot[0]
    center = foot + arc.center_in_tool_mm[2] * normal
    if np.linalg.norm(points - center, axis=-1).min() < arc.radius_mm + CLEAR_MM:
        return None
    cosines, weights = np.polynomial.legendre.leggauss(POLAR)
    cosines, weights = 0.5 * (cosines + 1.0), 0.5 * weights
    azimuths = 2.0 * np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    sines = np.sqrt(1.0 - cosines**2)
    across = np.cross(normal, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    aside = np.cross(normal, across)
    out = (
        sines[:, None, None] * (np.cos(azimuths)[:, None] * across + np.sin(azimuths)[:, None] * aside)
        + cosines[:, None, None] * normal
    ).reshape(-1, 3)
    area = arc.radius_mm**2 * np.repeat(weights, AZIMUTHS) * 2.0 * np.pi / AZIMUTHS
    P = points.reshape(-1, 3)
    to_eye = eye - P
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    total = np.zeros(len(P))
    for direction, dA in zip(out, area, strict=True):
        way_to = center + arc.radius_mm * direction - P
        r = np.sqrt(np.einsum("ij,ij->i", way_to, way_to))
        way_to /= r[:, None]
        cos_phi, cos_i = -way_to @ direction, way_to @ normal
        half = way_to + to_eye
        half /= np.sqrt(np.einsum("ij,ij->i", half, half))[:, None]
        cos_alpha, cos_r = half @ normal, to_eye @ normal
        cos_beta = np.einsum("ij,ij->i", way_to, half)
        G = np.minimum(1.0, 2.0 * cos_alpha * np.minimum(cos_i, cos_r) / cos_beta)
        alpha = np.arccos(np.clip(cos_alpha, -1.0, 1.0))
        f_r = metal.kappa_diff + metal.kappa_spec * G / cos_r * np.exp(-metal.c2 * alpha**2)
        total += np.where((cos_phi > 0.0) & (cos_i > 0.0), f_r * cos_phi * cos_i / r**2, 0.0) * dA
    fall = (1.0 + xy[..., 0] ** 2 + xy[..., 1] ** 2) ** -2.0
    return np.asarray(arc.radiance_e * fall * total.reshape(u.shape))


def draw(rng: np.random.Generator) -> World:
    """Draw a world: what is stated is off the truth by about what a user may be off."""
    setup = nominal_setup("butt", "mild_steel", width=WIDTH, height=HEIGHT)
    setup = replace(setup, joint=Joint("flat", {}, setup.joint.seam_in_base_mm))
    T_tool_camera = setup.camera.T_tool_camera.copy()
    # Some look nearer to the arc than others.
    T_tool_camera[0, 3] -= rng.uniform(0.0, NEARER_MM)
    setup = replace(setup, camera=replace(setup.camera, T_tool_camera=T_tool_camera))
    is_broad = rng.random() < 0.6
    c2 = rng.uniform(3.0, 10.0) if is_broad else rng.uniform(60.0, 120.0)
    ratio = math.exp(rng.uniform(math.log(0.3), math.log(3.0)))
    metal = Material("drawn", 1.0 / (1.0 + ratio), ratio / (1.0 + ratio), c2)
    arc = replace(
        setup.arc,
        radius_mm=rng.uniform(1.5, 4.0),
        center_in_tool_mm=(rng.normal(0.0, 0.3), rng.normal(0.0, 0.3), rng.uniform(0.3, 1.5)),
        on_surface=True,
    )
    tolerance = setup.tolerance
    turn = Rotation.from_rotvec(rng.normal(0.0, tolerance.hand_eye_deg, 3), degrees=True)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), rng.normal(0.0, tolerance.hand_eye_mm, 3)
    camera = replace(setup.camera, T_tool_camera=setup.camera.T_tool_camera @ T)
    true = replace(setup, arc=arc, material=metal, camera=camera)
    plate = (rng.normal(0.0, PART_SIGMAS[1]), rng.normal(0.0, PART_SIGMAS[3]))
    poses, maps = [], []
    for _ in range(MAX_TRIES):
        if len(poses) == POSES:
            break
        T_base_tool = np.eye(4)
        turn = Rotation.from_euler("xyz", rng.uniform(-10.0, 10.0, 3), degrees=True)
        T_base_tool[:3, :3] = turn.as_matrix()
        T_base_tool[:3, 3] = rng.uniform(-10.0, 10.0), rng.uniform(-5.0, 5.0), rng.uniform(1.0, 12.0)
        image = light(replace(true, arc=replace(arc, radiance_e=1.0)), T_base_tool, plate)
        if image is not None:
            poses.append(T_base_tool)
            maps.append(image)
    if len(poses) < POSES:
        return draw(rng)
    radiance_e = PEAK_E / max(float(image.max()) for image in maps)
    texture, flicker = rng.uniform(0.01, 0.03), rng.uniform(0.003, 0.03)
    true = replace(true, arc=replace(arc, radiance_e=radiance_e))
    frames = exposed(true, poses, [radiance_e * image for image in maps], texture, flicker, rng)
    return World(misstated(true, setup, rng), true, frames, texture, flicker)


def misstated(true: Setup, setup: Setup, rng: np.random.Generator) -> Setup:
    """Return the setup as a user would state it: the kappas' sum is right, for no frame tells it."""
    arc, metal = true.arc, true.material
    x, y, z = np.asarray(arc.center_in_tool_mm) + rng.normal(0.0, 0.1, 3)
    ratio = metal.kappa_spec / metal.kappa_diff * math.exp(rng.normal(0.0, 0.1))
    return replace(
        setup,
        arc=replace(
            arc,
            radius_mm=arc.radius_mm * math.exp(rng.normal(0.0, 0.1)),
            center_in_tool_mm=(float(x), float(y), float(z)),
            radiance_e=arc.radiance_e * math.exp(rng.normal(0.0, 0.3)),
        ),
        material=replace(
            metal,
            kappa_diff=1.0 / (1.0 + ratio),
            kappa_spec=ratio / (1.0 + ratio),
            c2=metal.c2 * math.exp(rng.normal(0.0, 0.1)),
        ),
    )


def exposed(
    true: Setup,
    poses: list[Float64],
    maps: list[Float64],
    texture: float,
    flicker: float,
    rng: np.random.Generator,
) -> list[tuple[Frame, Float64]]:
    """Return frames (H, W) of 8 bits of maps, with texture, flicker, fields, shot and read noise."""
    sensor, tolerance = true.sensor, true.tolerance
    u, v = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
    du, dv = ((u - 0.5 * WIDTH) / (0.5 * WIDTH), (v - 0.5 * HEIGHT) / (0.5 * WIDTH))
    fields = rng.normal(0.0, FIELD_SIGMA, 5)
    factor = 1.0 + np.tensordot(fields, [du, dv, du * du, du * dv, dv * dv], axes=1)
    black_dn = sensor.black_level_dn + rng.normal(0.0, tolerance.black_level_dn)
    frames = []
    for n, (T_base_tool, coarse) in enumerate(zip(poses, maps, strict=True)):
        spline = RectBivariateSpline(
            np.arange(0, HEIGHT + GRID_PX, GRID_PX), np.arange(0, WIDTH + GRID_PX, GRID_PX), np.log(coarse)
        )
        image = np.exp(spline(np.arange(HEIGHT), np.arange(WIDTH))) * math.exp(rng.normal(0.0, flicker))
        # A block of five by five has a fifth of its pixels' texture.
        image = image * factor * (1.0 + 5.0 * texture * rng.standard_normal(image.shape))
        e = rng.poisson(np.maximum(image, 0.0)) + rng.normal(0.0, sensor.read_noise_e, image.shape)
        dn = np.clip(np.rint(black_dn + e / sensor.gain_e_per_dn), 0, sensor.max_dn).astype(np.uint8)
        frames.append(
            (Frame(n, 0.1 * n, dn, true.camera.exposure_s, true.arc.current_a, False, True), T_base_tool)
        )
    return frames


def bound(world: World, held: tuple[str, ...]) -> Float64:
    """Return the least 1 sigma (7,) of `ARC` at the true values, with the true texture and flicker.

    What is `held` is known as it is stated.
    """
    stated = replace(world.true, camera=world.stated.camera)
    problem = ArcProblem.of(
        stated, world.frames, PartPlacement.without_stripes(stated, 0.0), world.texture, world.flicker
    )
    problem = replace(problem, held=held)
    x = np.zeros(len(problem.names))
    sigma_e = problem.sigma_e(x, problem.light(problem.named(x)))
    J = problem.derivatives(x, sigma_e)
    prior = np.array([parameter.prior_sigma for parameter in problem.parameters])
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(J.T @ J + np.diag(prior**-2.0)))[: len(ARC)]))


def judge(worlds: int, seed: int) -> None:
    tally, refusals, failed = Tally(), Counter[str](), 0
    for n in range(worlds):
        world = draw(np.random.default_rng([seed, n]))
        try:
            result = calibrate_arc(world.stated, world.frames)
        except ValueError as error:
            failed += 1
            print(f"world {n}: {error}")
            continue
        refusals.update(result.refused)
        limits = dict(zip(ARC, bound(world, tuple(result.refused)), strict=True))
        arc, metal = world.true.arc, world.true.material
        truth = [
            arc.radius_mm,
            *arc.center_in_tool_mm,
            arc.radiance_e,
            metal.kappa_diff,
            metal.kappa_spec,
            metal.c2,
        ]
        of_key = dict(zip(KEYS, (RADIUS, X, Y, Z, "ln_radiance", RATIO, RATIO, C2), strict=True))
        for key, value, sigma, true in zip(KEYS, result.values, result.sigmas, truth, strict=True):
            name = of_key[key]
            if name in result.refused or key == "kappa_spec":
                continue
            scale = {RADIUS: true, "ln_radiance": true, C2: true}.get(name, 1.0)
            if name == RATIO:
                scale = metal.kappa_diff * metal.kappa_spec / (metal.kappa_diff + metal.kappa_spec)
            error = float(value) - float(true)
            tally.add(
                key,
                error,
                float(sigma),
                abs(error) < -float(ndtri(0.025)) * float(sigma),
                limits[name] * scale,
            )
    tally.report()
    print(f"failed {failed}; refused: {dict(refusals)}")


if __name__ == "__main__":
    judge_worlds(judge, __doc__)
