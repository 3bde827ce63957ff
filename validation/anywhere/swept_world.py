"""A plain world to be judged in: swept joints, cast ray by ray, with speckle on the metal.

Nothing of the forward model is in it: `swept_joint` meets the rays, and the arc is a sum over points of its
half-sphere with a shadow ray each. Only records (setup, its parts) are shared. What real pictures show beside
stripe and arc is in `swept_light`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from noise_model.compiled.arrays import Bool, Float64, Integers
from noise_model.setup import Setup
from noise_model.transforms import invert, transform
from validation.anywhere.swept_joint import (
    ACROSS_MM,
    SweptJoint,
    departure,
    first_hit,
    first_hits,
    hit_near,
    is_open,
    normal_at,
    place,
)
from validation.anywhere.swept_light import Look, SceneSurroundings, glints, seen_metal, texture, with_ghost
from validation.anywhere.swept_welding import glare, mirrored_stripe, streaks

ARC_POINTS, ARC_COARSER = 32, 4
"""Points of the arc's upper half, and by how much coarser its light is computed than the image."""

PARTS = 3
"""A pixel's light is the mean of so many by so many of its parts."""

SHEET_REACH, NEIGHBOURS_PX = 6.0, 3
SHEET_COARSER, NEIGHBOURS_COARSE = 4, 2
"""Where the sheet meets the metal is first looked for on a coarser grid, within so many of its cells."""


@njit(cache=True)
def _lobe(n, w_i, w_r, c2):  # type: ignore[no-untyped-def]
    """Return the specular term of unit vectors: min(1, 2 cos a cos t / cos b) exp(-c2 a^2) / cos(theta_r)."""
    cos_i = n[0] * w_i[0] + n[1] * w_i[1] + n[2] * w_i[2]
    cos_r = n[0] * w_r[0] + n[1] * w_r[1] + n[2] * w_r[2]
    if cos_i <= 0.0 or cos_r <= 0.0:
        return 0.0
    h = w_i + w_r
    h /= math.sqrt(h[0] ** 2 + h[1] ** 2 + h[2] ** 2)
    cos_a = min(n[0] * h[0] + n[1] * h[1] + n[2] * h[2], 1.0)
    cos_b = h[0] * w_i[0] + h[1] * w_i[1] + h[2] * w_i[2]
    a = math.acos(cos_a)
    return min(1.0, 2.0 * cos_a * min(cos_i, cos_r) / cos_b) * math.exp(-c2 * a * a) / cos_r


@njit(cache=True)
def _opens(met, faces, near, corners, bend, origin, opens):  # type: ignore[no-untyped-def]
    """Write whether the laser at `origin` sees the metal (n,): 1 or 0, -1 where it is not `near` or none."""
    for i in range(met.shape[0]):
        opens[i] = -1
        if near[i] and faces[i] >= 0:
            n = normal_at(met[i], faces[i], corners, bend)
            opens[i] = is_open(met[i], n, origin, corners, bend)


@njit(cache=True)
def _stripe(rays, eye, met, faces, opens, corners, bend, origin, plane, up, stand, sigma, fan, metal, image):  # type: ignore[no-untyped-def]
    """Write the stripe's light (n,) over kappa-free peak for rays (n, 3) from the eye.

    Where all pixels about one see one face alike, `opens` (n,) says how, and `met` (n, 3) where about.
    """
    for i in range(rays.shape[0]):
        image[i] = 0.0
        k, t = faces[i], math.nan
        if opens[i] >= 0:
            t = hit_near(eye, rays[i], met[i], k, corners, bend)
        alike = not math.isnan(t)
        if not alike:
            t, k = first_hit(eye, rays[i], corners, bend, 1.0, 1e4)
        if k < 0 or (alike and opens[i] == 0):
            continue
        p = eye + t * rays[i]
        depth = (origin[0] - p[0]) * up[0] + (origin[1] - p[1]) * up[1] + (origin[2] - p[2]) * up[2]
        if depth <= 0.0:
            continue
        aside = plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] + plane[3]
        across = aside * stand / (sigma * depth)
        if abs(across) > SHEET_REACH:
            continue
        n = normal_at(p, k, corners, bend)
        way = origin - p
        if abs(way @ fan[1]) > fan[2, 0] * (way @ fan[0]):
            continue
        far = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
        cos_i = (n[0] * way[0] + n[1] * way[1] + n[2] * way[2]) / depth
        if cos_i <= 0.0 or not (alike or is_open(p, n, origin, corners, bend)):
            continue
        lit = math.exp(-0.5 * across * across) * (stand / depth) ** 2 * cos_i
        image[i] = lit * (metal[0] + metal[1] * _lobe(n, way / far, -rays[i], metal[2]))


@njit(cache=True)
def _arc(rays, eye, corners, bend, centre, radius, metal, image):  # type: ignore[no-untyped-def]
    """Write the arc's reflected light (n,) over radiance for rays (n, 3) from the eye.

    Nothing shades a level face that no other one rises above, and ridges neither.
    """
    is_free = (corners[:-1, 1] == corners[1:, 1]) & (corners[:-1, 1] >= corners[:, 1].max())
    is_free &= (bend[3] == 0.0) & (bend[9] == 0.0)
    golden = math.pi * (3.0 - math.sqrt(5.0))
    area = 2.0 * math.pi * radius * radius / ARC_POINTS
    for i in range(rays.shape[0]):
        image[i] = 0.0
        t, k = first_hit(eye, rays[i], corners, bend, 1.0, 1e4)
        if k < 0:
            continue
        p = eye + t * rays[i]
        n = normal_at(p, k, corners, bend)
        turn = 2.0 * math.pi * ((i * 0.7548776662466927) % 1.0)
        total = 0.0
        for m in range(ARC_POINTS):
            cos_t = 1.0 - (m + 0.5) / ARC_POINTS
            sin_t = math.sqrt(1.0 - cos_t * cos_t)
            out = np.array([sin_t * math.cos(golden * m + turn), sin_t * math.sin(golden * m + turn), cos_t])
            source = centre + radius * out
            way = source - p
            far = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
            way /= far
            cos_i = n[0] * way[0] + n[1] * way[1] + n[2] * way[2]
            cos_o = -(out[0] * way[0] + out[1] * way[1] + out[2] * way[2])
            if cos_i > 0.0 and cos_o > 0.0 and (is_free[k] or is_open(p, n, source, corners, bend)):
                total += (
                    cos_i * cos_o / (far * far) * (metal[0] + metal[1] * _lobe(n, way, -rays[i], metal[2]))
                )
        image[i] = total * area


@dataclass(frozen=True)
class SpeckleField:
    """Log-normal grains on the stripe's light: their contrast, 0 for none, and the field's sigma, px."""

    contrast: float
    grain_px: float


class SweptWorld:
    """Renders frames of a setup over a swept joint. `setup` has the true values."""

    def __init__(
        self, setup: Setup, joint: SweptJoint, speckle: SpeckleField, around: SceneSurroundings
    ) -> None:
        self.setup, self.joint, self.speckle, self.around = setup, joint, speckle, around
        self._texture = texture(around.look)
        v, u = np.mgrid[: setup.camera.height, : setup.camera.width].astype(np.float64)
        pixels = np.column_stack([u.ravel(), v.ravel()])
        self._xy = setup.camera.normalised(pixels)
        # A pixel integrates over its area: an edge that was looked at in its middle alone would jump.
        parts = (np.arange(PARTS) + 0.5) / PARTS - 0.5
        self._parts = [setup.camera.normalised(pixels + np.array([du, dv])) for du in parts for dv in parts]
        self._lens_px = math.sqrt(max(setup.camera.psf_sigma_px**2 - 1.0 / 12.0, 0.01))
        indices = np.indices((setup.camera.height, setup.camera.width))
        self._coarse = (indices % ARC_COARSER == 0).all(axis=0)
        self._sparse = (indices % SHEET_COARSER == 0).all(axis=0)
        self._peak = self._stripe_on_plate()

    def frame(
        self, T_joint_tool: Float64, laser_on: bool, arc_on: bool, draw: np.random.Generator
    ) -> Integers:
        """Return an image (H, W), DN, of one pose."""
        setup, around = self.setup, self.around
        charge, stripe = self.mean_light(T_joint_tool, laser_on, arc_on)
        if laser_on:
            stripe *= self._grains(stripe.shape, draw)
            charge += stripe if around.ghost is None else with_ghost(stripe, around.ghost)
            charge += glints(stripe, around, setup.sensor.full_well_e, draw)
        if arc_on and around.welding is not None:
            arc_camera = transform(invert(setup.camera.T_tool_camera), np.array(setup.arc.center_in_tool_mm))
            arc_px = setup.camera.project(arc_camera[np.newaxis])[0]
            flying = streaks(charge.shape, around.welding.n_streaks, arc_px, draw)
            charge += setup.laser.peak_e * gaussian_filter(flying, setup.camera.psf_sigma_px)
        sensor = setup.sensor
        noisy = draw.poisson(np.maximum(charge, 0.0)) + sensor.read_noise_e * draw.standard_normal(
            charge.shape
        )
        share = np.minimum(noisy, sensor.full_well_e) / sensor.full_well_e
        over_black = (
            np.sign(share) * np.abs(share) ** sensor.gamma * sensor.full_well_e / sensor.gain_e_per_dn
        )
        codes = np.rint(over_black + sensor.black_level_dn).clip(0, 2**sensor.bits - 1)
        return codes.astype(np.uint8 if sensor.bits == 8 else np.uint16)

    def mean_light(self, T_joint_tool: Float64, laser_on: bool, arc_on: bool) -> tuple[Float64, Float64]:
        """Return what arc and hall, and what the stripe sends to the pixels (H, W), e-.

        Without speckle, ghost, glints and noise.
        """
        setup, around = self.setup, self.around
        shape = (setup.camera.height, setup.camera.width)
        welding = around.welding if arc_on else None
        everywhere = around.look != Look() or welding is not None
        met, faces = self._met(T_joint_tool, self.joint, everywhere=everywhere)
        cos4 = ((1.0 + np.sum(self._xy**2, axis=1)) ** -2.0).reshape(shape)
        metal, light = np.ones(shape), np.zeros(shape)
        if around.look != Look():
            metal, sky = seen_metal(met, faces, self.joint, shape, around.look, self._texture)
            light += around.hall_e * sky
        if arc_on:
            light += self.arc_light(T_joint_tool)
        if welding is not None:
            arc_x_mm = float(
                place(transform(T_joint_tool, np.array(setup.arc.center_in_tool_mm)), self.joint.bend)[0]
            )
            seam = glare(
                met, faces, self.joint.bend, arc_x_mm, welding.glare_sigma_mm, welding.glare_reach_mm
            )
            light += setup.laser.peak_e * welding.glare * seam.reshape(shape)
        background = gaussian_filter(light * metal * cos4, setup.camera.psf_sigma_px)
        if not laser_on:
            return background, np.zeros(shape)
        lit = self._stripe(T_joint_tool, self.joint, met, faces, self._parts)
        stripe = lit.reshape(shape) * cos4 * (setup.laser.peak_e / self._peak)
        if welding is not None:
            stripe += setup.laser.peak_e * welding.mirrored * self._mirrored(T_joint_tool, met, faces)
        return background, gaussian_filter(stripe * metal, self._lens_px, truncate=6.0)

    def _grains(self, shape: tuple[int, int], draw: np.random.Generator) -> Float64:
        if self.speckle.contrast == 0.0:
            return np.ones(shape)
        field = gaussian_filter(draw.standard_normal(shape), self.speckle.grain_px, mode="wrap")
        spread = math.sqrt(math.log1p(self.speckle.contrast**2))
        return np.asarray(np.exp(spread * field / field.std() - 0.5 * spread**2))

    def _rays(self, T_joint_tool: Float64, xy: Float64) -> tuple[Float64, Float64]:
        T_joint_camera = T_joint_tool @ self.setup.camera.T_tool_camera
        rays = np.column_stack([xy, np.ones(len(xy))]) @ T_joint_camera[:3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return np.ascontiguousarray(rays), np.ascontiguousarray(T_joint_camera[:3, 3])

    def _stripe(
        self, T_joint_tool: Float64, joint: SweptJoint, met: Float64, faces: Integers, parts: list[Float64]
    ) -> Float64:
        """Return the stripe's light (H W,) over kappa-free peak, the mean over parts of pixels.

        `met` (H W, 3) is where the pixels' rays meet the metal, on `faces` (H W,).
        """
        laser, metal = self.setup.laser, self.setup.material
        normal = T_joint_tool[:3, :3] @ laser.plane[:3]
        plane = np.array([*normal, laser.plane[3] - normal @ T_joint_tool[:3, 3]])
        side = np.cross(T_joint_tool[:3, 2], normal)
        side /= np.linalg.norm(side)
        # Back along the fan's axis, across it, and how wide it is.
        half_deg = laser.fan_half_angle_deg
        wide = math.inf if half_deg is None else math.tan(math.radians(half_deg))
        fan = np.array([np.cross(normal, side), side, [wide, 0.0, 0.0]])
        near = self._near_sheet(T_joint_tool, met, 1, NEIGHBOURS_PX)
        origin = transform(T_joint_tool, laser.origin_mm)
        opens = self._opens(met, faces, near, joint, origin)
        image, lit = np.zeros(len(self._xy)), np.empty(int(near.sum()))
        for xy in parts:
            rays, eye = self._rays(T_joint_tool, xy[near])
            _stripe(
                rays, eye, met[near], faces[near], opens[near], joint.corners, joint.bend, origin=origin,
                plane=plane, up=np.ascontiguousarray(T_joint_tool[:3, 2]), stand=laser.origin_in_tool_mm[2],
                sigma=laser.stripe_sigma_mm, fan=fan,
                metal=np.array([metal.kappa_diff, metal.kappa_spec, metal.c2]), image=lit,
            )  # fmt: skip
            image[near] += lit / len(parts)
        return image

    def _mirrored(self, T_joint_tool: Float64, met: Float64, faces: Integers) -> Float64:
        """Return the stripe's light (H, W) over its peak that one face shows mirrored in another."""
        laser, (rays, _) = self.setup.laser, self._rays(T_joint_tool, self._xy)
        normal = T_joint_tool[:3, :3] @ laser.plane[:3]
        sheet = np.zeros((4, 4))
        sheet[0, :3] = transform(T_joint_tool, laser.origin_mm)
        sheet[1] = *normal, laser.plane[3] - normal @ T_joint_tool[:3, 3]
        sheet[2, :3] = T_joint_tool[:3, 2]
        sheet[3, :2] = laser.origin_in_tool_mm[2], laser.stripe_sigma_mm
        image = np.zeros(len(rays))
        mirrored_stripe(rays, met, faces, self.joint.corners, self.joint.bend, sheet, image)
        return image.reshape(self._coarse.shape)

    def _met(self, T_joint_tool: Float64, joint: SweptJoint, everywhere: bool) -> tuple[Float64, Integers]:
        """Return where pixels' rays meet the metal (H W, 3) and the faces (H W,); NaN and -1 for none.

        Rays are cast near the sheet of light alone unless they are wanted everywhere.
        """
        rays, eye = self._rays(T_joint_tool, self._xy)
        asked = np.ones(len(rays), dtype=bool)
        if not everywhere:
            places, _ = first_hits(rays, eye, joint.corners, joint.bend, self._sparse.ravel())
            asked = self._near_sheet(T_joint_tool, places, SHEET_COARSER, NEIGHBOURS_COARSE)
        places, faces = first_hits(rays, eye, joint.corners, joint.bend, asked)
        return places, faces

    def _near_sheet(self, T_joint_tool: Float64, met: Float64, coarser: int, neighbours: int) -> Bool:
        """Say for each pixel (H W,) whether it, or a neighbour, meets the metal (H W, 3) near the sheet.

        A neighbour is within so many cells of a grid that is coarser than the pixels.
        """
        laser, camera = self.setup.laser, self.setup.camera
        aside = transform(invert(T_joint_tool), met) @ laser.plane[:3] + laser.plane[3]
        # The sheet grows with the way below its origin; nothing is twice as far as the tool's point.
        near = np.abs(aside) < 2.0 * SHEET_REACH * laser.stripe_sigma_mm
        wide = 2 * neighbours * coarser + 1
        return np.asarray(maximum_filter(near.reshape(camera.height, camera.width), wide)).ravel()

    def _opens(
        self, met: Float64, faces: Integers, near: Bool, joint: SweptJoint, origin_mm: Float64
    ) -> Integers:
        """Return whether the laser sees the metal about pixels (H W,), -1 where neighbours are unlike."""
        opens = np.empty(len(met), np.int64)
        _opens(met, faces, near, joint.corners, joint.bend, origin_mm, opens)
        shape = self.setup.camera.height, self.setup.camera.width
        for seen in (opens.copy(), faces):
            image = seen.reshape(shape)
            unlike = minimum_filter(image, 3) != maximum_filter(image, 3)
            opens[unlike.ravel()] = -1
        return opens

    def arc_light(self, T_joint_tool: Float64) -> Float64:
        """Return the arc's light (H, W), e-, before the lens."""
        rays, eye = self._rays(T_joint_tool, self._xy)
        arc, metal = self.setup.arc, self.setup.material
        centre = transform(T_joint_tool, np.asarray(arc.center_in_tool_mm))
        if arc.on_surface:
            station, y, _, _, _ = place(centre, self.joint.bend)
            aside, _, lift, _ = departure(station, self.joint.bend)
            centre = self.joint.base_mm(station, y + aside, arc.center_in_tool_mm[2] + lift)
        kappas = np.array([metal.kappa_diff, metal.kappa_spec, metal.c2])
        coarse = self._coarse.ravel()
        image = np.empty(int(coarse.sum()))
        corners, bend, radius_mm = self.joint.corners, self.joint.bend, arc.radius_mm
        _arc(rays[coarse], eye, corners, bend, centre, radius=radius_mm, metal=kappas, image=image)
        height, width = self._coarse.shape
        small = image.reshape(-(-height // ARC_COARSER), -(-width // ARC_COARSER))
        # Few points are grainy: their mean over some pixels is not.
        small = gaussian_filter(small, 1.0, mode="nearest").astype(np.float32)
        places = (np.arange(n, dtype=np.float32) / ARC_COARSER for n in (width, height))
        u, v = np.meshgrid(*places)
        full = np.asarray(cv2.remap(small, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        return np.asarray(arc.radiance_e * full.astype(np.float64))

    def _stripe_on_plate(self) -> float:
        """Return the stripe's peak on a flat plate at tool height, level pose, middle column."""
        plate = SweptJoint(
            np.array([[-ACROSS_MM, 0.0], [ACROSS_MM, 0.0]]),
            np.zeros(2),
            np.array([0, 1, 0, 0, 1, 1, 0, 0, 0, 0.0]),
        )
        met, faces = self._met(np.eye(4), plate, everywhere=False)
        cos4 = (1.0 + np.sum(self._xy**2, axis=1)) ** -2.0
        return float((self._stripe(np.eye(4), plate, met, faces, [self._xy]) * cos4).max())
