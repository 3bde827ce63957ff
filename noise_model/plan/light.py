"""The light of stripe and arc where the stripe meets the joint, at one pose: what a design is judged by.

The laser's fan is followed ray by ray to where it first meets the surface, so that what it does not reach has
no stripe. Only there, and for a few places across the stripe, the arc's light is computed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import arc_at, arc_kernel
from noise_model.arc.scene import Scene, make_scene
from noise_model.compiled.arrays import Bool, Float64
from noise_model.condition import Condition
from noise_model.effects import REGISTRY
from noise_model.effects.light import Light
from noise_model.effects.optics import incidence_on_filter
from noise_model.forward import pass_on
from noise_model.instrument.camera import Rays
from noise_model.setup import Setup
from noise_model.stripe import reflected_sheet, stripe_reference, stripe_runs_along_rows
from noise_model.surface.ray_casting import trace, ways_are_open
from noise_model.transforms import invert, transform
from noise_model.view import View

REACH_MM = 10.0
"""Half-width of the stripe about the seam: beyond, a plate determines its own flatness, not the seam."""

FAN_RAYS = 81
MARGIN_MM = 2.0

HALF_WINDOW_SIGMAS = 4.0
ARC_PLACES = 5
"""Places across a scan line's window, 4 sigmas of the stripe to either side, where the arc is computed."""

STEP_MM = 1e-3

FILTER_SHIFT = "filter_shift"
"""The effect whose share of the shift a tried filter takes: the whole of it where no share is stated."""


@dataclass(frozen=True, eq=False)
class SampledStripe:
    """The stripe as sampled by n rays of the laser's fan, joint frame, mm.

    `points`, `normals` (n, 3); `moves` (n, 3) how a point goes along the laser plane for 1 px of stripe
    centre; `lines` (n,) how many scan lines each ray stands for; `width_px` (n,) the stripe's 1 sigma along
    its scan line, point-spread function included; `stripe_e` (n,) its peak; `arc_e` (n, ARC_PLACES) the arc's
    light across the window; `theta` (n,) the angle, rad, at which the filter is met; `seen` (n,) whether the
    camera sees it in its image. Charges are those of the setup's exposure, as if the filter passed the whole
    field like its axis. `eye` and `source` (3,) are where camera and laser stand.
    """

    points: Float64
    normals: Float64
    moves: Float64
    lines: Float64
    length_mm: Float64
    width_px: Float64
    stripe_e: Float64
    arc_e: Float64
    theta: Float64
    seen: Bool
    eye: Float64
    source: Float64


def stripe_level_e(setup: Setup) -> float:
    """Return the stripe's charge, e-, for irradiance f_r cos^4 of 1, which holds wherever the sensor stands.

    Raises ValueError for a stripe that the setup's camera cannot see on a plate.
    """
    return setup.laser.peak_e / stripe_reference(setup)


def stripe_light(setup: Setup, T_base_tool: Float64, level_e: float) -> SampledStripe:
    """Return the light along the stripe within `REACH_MM` of the nominal seam at a pose.

    `level_e` is the setup's `stripe_level_e`. Raises ValueError for a camera below the surface and a laser
    that does not meet the joint there.
    """
    scene = make_scene(setup, T_base_tool)
    points, normals, stretch = _fan(setup, scene)
    if not len(points):
        raise ValueError("the laser does not meet the joint at this pose")
    looks = _look(setup, scene, points, normals)
    stripe, arc = _light_at(setup, scene, looks, level_e * _stripe(setup, scene, points, normals, looks))
    return SampledStripe(
        points=points,
        normals=normals,
        moves=looks.moves,
        lines=looks.lines_per_mm * stretch,
        length_mm=stretch,
        width_px=looks.width_px,
        stripe_e=np.where(looks.seen, stripe, np.nan),
        arc_e=arc,
        theta=_filter_angle(setup, looks.image),
        seen=looks.seen,
        eye=scene.T_joint_camera[:3, 3],
        source=transform(scene.T_joint_tool, setup.laser.origin_mm),
    )


def _fan(setup: Setup, scene: Scene) -> tuple[Float64, Float64, Float64]:
    """Follow the fan: first points on the surface (n, 3), normals, and the length of stripe (n,) of each.

    Rays beyond the fan's end are left out.
    """
    R = scene.T_joint_tool[:3, :3]
    axis, across, slope = setup.laser.fan
    down, side = R @ axis, R @ across
    origin = transform(scene.T_joint_tool, setup.laser.origin_mm)
    # Where on a level plate the rays o + t (down + s side) come out relative to the seam.
    reach = REACH_MM + MARGIN_MM
    t = -origin[2] / down[2]
    ends = np.array([-reach, reach])
    s_ends = (ends - origin[1] - t * down[1]) / (t * side[1])
    s, step = np.linspace(s_ends[0], s_ends[1], FAN_RAYS, retstep=True)
    fan, T_joint_fan = np.zeros(FAN_RAYS, dtype=np.int64), np.eye(4)[np.newaxis]
    T_joint_fan[0, :3, :3] = np.column_stack([side, np.cross(down, side), down])
    T_joint_fan[0, :3, 3] = origin
    points, normals = np.empty((FAN_RAYS, 3)), np.empty((FAN_RAYS, 3))
    faces = np.empty(FAN_RAYS, dtype=np.int32)
    # As far off the plane as the sheet is, see `Laser.bow`.
    off = np.zeros(FAN_RAYS)
    for _ in range(3):
        off = setup.laser.bow * s**2 / (-axis[2] - off * setup.laser.plane[2])
    rays = np.column_stack([s, off])
    shape = scene.shape
    trace(
        xy=rays,
        which=fan,
        T_joint_camera=T_joint_fan,
        vertices=shape.vertices,
        corrugation=shape.corrugation,
        points=points,
        normals=normals,
        faces=faces,
    )
    d = down + s[:, np.newaxis] * side
    # A neighbouring ray meets the same face at P + dt d + t ds side.
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (points - origin) @ down
        slip = far * (normals @ side) / np.sum(normals * d, axis=1)
        stretch = np.linalg.norm(far[:, np.newaxis] * side - slip[:, np.newaxis] * d, axis=1) * abs(step)
    met = np.isfinite(points).all(axis=1) & np.isfinite(stretch)
    met &= (np.abs(points[:, 1]) <= REACH_MM) & (np.abs(s) <= slope)
    return points[met], normals[met], stretch[met]


class _StripeWindows(NamedTuple):
    """Geometry of the camera's rays to the points: image points (n, 2), and see `SampledStripe`."""

    image: Float64
    position_axis: int
    moves: Float64
    lines_per_mm: Float64
    width_px: Float64
    sheet_share: Float64
    theta: Float64
    seen: Bool


def _look(setup: Setup, scene: Scene, points: Float64, normals: Float64) -> _StripeWindows:
    """Project points and the three directions that matter: along the stripe, the plane and the face."""
    camera, laser = setup.camera, setup.laser
    T_camera_joint = invert(scene.T_joint_camera)
    axis = 1 if stripe_runs_along_rows(setup) else 0
    R, eye = scene.T_joint_camera[:3, :3], np.ascontiguousarray(scene.T_joint_camera[:3, 3])
    plane = laser.normals(transform(invert(scene.T_joint_tool), points)) @ scene.T_joint_tool[:3, :3].T
    ahead = transform(T_camera_joint, points)
    in_front = ahead[:, 2] > 1.0
    ahead[~in_front] = [0.0, 0.0, 1.0]
    image = camera.project(ahead)

    def slides(direction: Float64) -> Float64:
        """Return the image's move (n, 2), px, along directions (n, 3) in the joint frame, for each mm."""
        step = STEP_MM * direction @ R
        return (camera.project(ahead + step) - camera.project(ahead - step)) / (2.0 * STEP_MM)

    # A scan line is the image of a plane through the eye, with this normal.
    scan_plane = np.cross(points - eye, R[:, axis])
    scan_plane /= np.linalg.norm(scan_plane, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        in_plane = np.cross(plane, scan_plane)
        moves = in_plane / slides(in_plane)[:, axis, np.newaxis]
        on_face = np.cross(normals, scan_plane)
        on_face /= np.sum(on_face * plane, axis=1)[:, np.newaxis]
        along = np.cross(plane, normals)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        slide = slides(np.nan_to_num(along))
        depth = laser.origin_in_tool_mm[2] - transform(invert(scene.T_joint_tool), points)[:, 2]
        sheet = laser.stripe_sigma_mm * depth / laser.origin_in_tool_mm[2]
        sheet_px = np.abs(slides(np.nan_to_num(on_face, posinf=0.0, neginf=0.0))[:, axis]) * sheet
        # A stripe that runs aslant is crossed aslant, and so is the point-spread function's width.
        aslant = np.hypot(1.0, slide[:, axis] / slide[:, 1 - axis])
    width = np.hypot(sheet_px, camera.psf_sigma_px * aslant)
    is_free = np.empty(len(points), dtype=np.bool_)
    ways_are_open(points, eye, scene.shape.vertices, scene.shape.corrugation, is_free)
    inside = (image >= 0.0).all(axis=1) & (image <= [camera.width - 1.0, camera.height - 1.0]).all(axis=1)
    seen = in_front & is_free & inside & np.isfinite(width) & (sheet_px > 0.0)
    seen &= np.isfinite(moves).all(axis=1) & (np.sum((eye - points) * normals, axis=1) > 0.0)
    theta = np.arctan(np.linalg.norm(camera.normalised(image), axis=1))
    lines = np.abs(np.nan_to_num(slide[:, 1 - axis]))
    return _StripeWindows(
        image=image,
        position_axis=axis,
        moves=moves,
        lines_per_mm=lines,
        width_px=width,
        sheet_share=sheet_px / width,
        theta=theta,
        seen=seen,
    )


def _stripe(setup: Setup, scene: Scene, points: Float64, normals: Float64, looks: _StripeWindows) -> Float64:
    """Return irradiance f_r cos^4 at the stripe's peak (n,) behind the point-spread function."""
    light = reflected_sheet(setup, points, normals, scene.T_joint_tool)
    return np.asarray(light * np.cos(looks.theta) ** 4 * looks.sheet_share)


def _filter_angle(setup: Setup, image: Float64) -> Float64:
    """Return at which angles (n,), rad, a filter moves as far as `filter_shift` says of it at places (n, 2).

    Where it is not stated, an upright filter moves by its whole shift.
    """
    effect = REGISTRY[FILTER_SHIFT]
    values = effect.complete(setup.effects.get(FILTER_SHIFT, {"shift_share": 1.0}))
    sin = incidence_on_filter(setup.camera.normalised(image), values)
    return np.arcsin(np.minimum(math.sqrt(values["shift_share"]) * sin, 1.0))


def _light_at(
    setup: Setup, scene: Scene, looks: _StripeWindows, stripe_e: Float64
) -> tuple[Float64, Float64]:
    """Return the stripe's peak (n,), e-, and the other light (n, ARC_PLACES), e-, across the windows.

    `stripe_e` (n,) is the peak before the setup's effects on the light; they are applied here, to both, but
    for the filter's shift, which is that of the filter that is tried (`plan.filter_gains`). 0 past the
    workpiece and where it is not seen.
    """
    arc_e = np.zeros((len(looks.seen), ARC_PLACES))
    seen = np.flatnonzero(looks.seen)
    t = np.linspace(-HALF_WINDOW_SIGMAS, HALF_WINDOW_SIGMAS, ARC_PLACES)
    image = np.repeat(looks.image[seen], ARC_PLACES, axis=0)
    image[:, looks.position_axis] += (looks.width_px[seen, np.newaxis] * t).ravel()
    rays = Rays.through(setup.camera, image)
    light, _ = arc_at(arc_kernel(setup, scene), rays.xy, rays.cos4, np.arange(len(image), dtype=np.int64))
    laser = (stripe_e[seen, np.newaxis] * np.exp(-0.5 * t**2)).astype(np.float32)
    of_both = Light.of(np.nan_to_num(light), laser.ravel())
    pixels = View.of_scene(setup, scene, rays)
    before = replace(setup, effects={id_: v for id_, v in setup.effects.items() if id_ != FILTER_SHIFT})
    pass_on(before, of_both, pixels, Condition(1.0, 1.0, setup.camera.exposure_s))
    arc_e[seen] = (of_both.arc + of_both.other).reshape(-1, ARC_PLACES)
    peak_e = np.zeros(len(looks.seen))
    peak_e[seen] = of_both.laser.reshape(-1, ARC_PLACES)[:, ARC_PLACES // 2]
    return peak_e, arc_e
