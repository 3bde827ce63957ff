"""Light that bounces between the faces of a joint before it goes to the camera.

The joint's absolute reflectance is scale f_r, and direct light is stated with the scale taken into the
source's radiance. So light that met n more faces on its way goes with scale^n (the Neumann series of the
rendering equation, Kajiya 1986, SIGGRAPH Comput. Graph. 20(4) 143):

    L_n(P -> omega) = integral f_r(omega_PQ, omega) L_(n-1)(Q -> P) cos(theta_P) d(omega_PQ),

L_0 being what the source's own light makes of Q. f_r is used in full at every bounce. As printed it is not
reciprocal, so light is always followed from the source to the camera.

The once-bounced light is gathered over everything that a point sees (`nodes`), at points
spread over the faces (`lattice`), and interpolated to the pixels' own. For the further
bounces the points of a coarser lattice remember from where how much light comes to them; what they send on
follows from f_r, and what points between them send is interpolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from noise_model.compiled.arrays import Bool, Float32, Float64, Int32
from noise_model.interreflection.bounces import ORDERS, arriving, gather_first, gather_further
from noise_model.interreflection.first_bounce import Place, place
from noise_model.interreflection.lattice import Lattice, interpolate, lattice, stations
from noise_model.interreflection.nodes import Focus, GaussRules, rules, stripe_at
from noise_model.stripe import stripe_reference
from noise_model.surface.brdf import Material
from noise_model.surface.faces import strip
from noise_model.surface.joint import Joint, corrugation_height, section
from noise_model.view import View


@dataclass(frozen=True)
class Grain:
    """Spacing of the points to which light is followed.

    `across` points on a bounded face and on one that runs on, and stations `near_mm` apart where the light is
    brightest and no more than `far_mm` elsewhere, nor than `bends` pieces of a corrugation's width. There
    each face has `across_bent` points: it is lit from along the seam more than from across it.
    """

    across: tuple[int, int]
    near_mm: float
    far_mm: float
    bends: int
    across_bent: int


@dataclass(frozen=True)
class Grains:
    """The points that send once-bounced light to the camera, those of all other, those that pass it on."""

    seen: Grain
    seen_further: Grain
    passing: Grain


FINE = Grains(
    Grain((10, 14), 0.5, 2.0, 24, 10), Grain((8, 12), 1.0, 4.0, 8, 7), Grain((7, 14), 1.0, 4.0, 8, 7)
)
COARSE_GRAINS = Grains(
    Grain((6, 8), 1.0, 4.0, 16, 7), Grain((5, 7), 2.0, 8.0, 8, 6), Grain((5, 8), 2.0, 8.0, 8, 6)
)
"""The points of a view as it is predicted, and of a coarse one: 0.5 to 1 % of the brightest bounced light off
on a V or a lap, 5 % on a corrugation, in half the time."""

COARSE = rules(3, 4, 2, 2, 4, False)
"""Nodes for what bounces more than once."""

BEYOND_MM, BEYOND_ALONG_MM = 40.0, 15.0
"""Reach of light that bounces further, from the corner, and beyond the source and the camera's footprint.

Along a corrugation it is followed half a pitch far if that is more.
"""

MAX_FACES = 12
"""Largest number of a section's faces: a U's rounding has more, and the paths between all of them are too
many.
"""

PAD_MM = 0.05
"""Margin of the lattice around the pixels' points across a face."""


@dataclass(frozen=True, eq=False)
class BouncedLight:
    """Light of a view's pixels (...,) that bounced at least once, each source computed when needed.

    e- for `camera.exposure_s` at the sources' nominal output, before the point-spread function, 0 past the
    workpiece. `scale` is the absolute reflectance over the stated, relative f_r: the light is a polynomial
    in it, of `ORDERS` terms.
    """

    view: View

    def arc_e(self, scale: float) -> Float32:
        """Return the arc's bounced light (...,), e-."""
        return _sum(self.arc_orders_e, scale)

    def laser_e(self, scale: float) -> Float32:
        """Return the laser's bounced light (...,), e-."""
        return _sum(self.laser_orders_e, scale)

    @cached_property
    def arc_orders_e(self) -> Float32:
        """The coefficients (ORDERS, ...) of scale, scale^2, … of the arc's light."""
        where = self.view.scene
        focus = Focus(
            float(where.center_mm[0]), float(where.center_mm[1]), 2.0 * self.view.setup.arc.radius_mm
        )
        return _orders(self.view, focus, False, self.view.setup.arc.radiance_e)

    @cached_property
    def laser_orders_e(self) -> Float32:
        """The coefficients (ORDERS, ...) of scale, scale^2, … of the laser's light.

        It is a hundredth of the arc's: in a coarse view only its first bounce is followed, two thirds of it
        in a twentieth of the time.

        Raises ValueError for a sheet that runs along the seam.
        """
        setup = self.view.setup
        k = place(setup, self.view.scene)
        x, _ = stripe_at(k, len(k.vertices) - 2, 0.0)
        if np.isnan(x):
            raise ValueError("[laser] plane_in_tool: interreflection needs a sheet that crosses the seam")
        focus = Focus(x, float(k.vertices[-2, 0]), 4.0)
        return _orders(self.view, focus, True, setup.laser.peak_e / stripe_reference(setup))


def is_followed(joint: Joint) -> bool:
    """Return True if light is followed between a joint's faces: not between more than `MAX_FACES`."""
    return len(section(joint).vertices) - 1 <= MAX_FACES


def bounced_light(view: View, near: BouncedLight | None = None) -> BouncedLight:
    """Return the light that bounces between the faces on its way to the pixels of a view, which keeps it.

    `near` is that of a view with almost the same direction, used for this one's.
    """
    return view.cached(f"bounced_light, {view.coarse}", lambda: near or BouncedLight(view))


def _sum(orders_e: Float32, scale: float) -> Float32:
    total = np.zeros_like(orders_e[0])
    for order_e in orders_e[::-1]:
        total += order_e
        total *= np.float32(scale)
    return np.asarray(total)


def _orders(view: View, focus: Focus, of_laser: bool, output_e: float) -> Float32:
    """Return each order's light (ORDERS, ...), e-, of one source.

    Raises ValueError for a joint between whose faces light is not followed.
    """
    if not is_followed(view.setup.joint):
        joint_type = view.setup.joint.type
        raise ValueError(
            f"[effects.interreflection]: light is not followed between the faces of a {joint_type}"
        )
    k, grains = place(view.setup, view.scene), COARSE_GRAINS if view.coarse else FINE
    points, faces = view.surface[0].reshape(-1, 3), view.surface[2].reshape(-1)
    image = np.zeros((ORDERS, len(faces)), dtype=np.float32)
    facing = _facing(k)
    if facing[faces[faces >= 0]].any():
        camera = np.ascontiguousarray(view.scene.T_joint_camera[:3, 3])
        seen = _seen(k, points, faces, facing, focus, grains.seen)
        first = gather_first(k, seen, camera, focus, of_laser, _first_rules(view.setup.material))
        interpolate(seen, first, points, faces, k.vertices, k.corrugation, image[:1])
        if not (of_laser and view.coarse):
            passing = _passing(k, points[:, 0], facing, focus, grains.passing)
            remembered = arriving(k, passing, focus, of_laser, COARSE)
            seen = _seen(k, points, faces, facing, focus, grains.seen_further)
            further = gather_further(k, seen, camera, focus, passing, COARSE, *remembered)
            interpolate(seen, further, points, faces, k.vertices, k.corrugation, image[1:])
    image *= np.float32(output_e) * view.rays.cos4.reshape(-1)
    return np.asarray(image.reshape(ORDERS, *view.shape))


def _facing(k: Place) -> Bool:
    """Return for each face whether any part of the joint lies in front of it."""
    if k.corrugation[0] > 0.0:
        return np.ones(len(k.vertices) - 1, dtype=np.bool_)
    along = np.diff(k.vertices, axis=0)
    ahead = k.vertices[np.newaxis] - k.vertices[:-1, np.newaxis]
    above = along[:, np.newaxis, 0] * ahead[..., 1] - along[:, np.newaxis, 1] * ahead[..., 0]
    return np.asarray((above > 1e-9).any(axis=1))


def _seen(k: Place, points: Float64, faces: Int32, facing: Bool, focus: Focus, grain: Grain) -> Lattice:
    """Return the lattice over what the pixels show of the faces that get bounced light."""
    n_faces = len(k.vertices) - 1
    ranges = np.full((n_faces, 2), np.nan)
    hit = faces >= 0
    for face in np.flatnonzero(facing):
        here = points[faces == face]
        if not len(here):
            continue
        y_0, z_0, ty, tz, width = strip(int(face), k.vertices)
        c = corrugation_height(here[:, 0], k.corrugation)
        s = (here[:, 1] - y_0) * ty + (here[:, 2] - c - z_0) * tz
        ranges[face] = max(0.0, float(s.min()) - PAD_MM), min(width, float(s.max()) + PAD_MM)
    x = points[hit, 0]
    x_range = float(x.min()) - 2.0 * grain.far_mm, float(x.max()) + 2.0 * grain.far_mm
    stations = _stations(k, focus, x_range, grain)
    return lattice(stations, ranges, _counts(k, grain), k.vertices, k.corrugation)


def _counts(k: Place, grain: Grain) -> list[int]:
    """Return a lattice's number of points across each face."""
    n_faces = len(k.vertices) - 1
    if k.corrugation[0] > 0.0:
        return [grain.across_bent] * n_faces
    return [grain.across[face in (0, n_faces - 1)] for face in range(n_faces)]


def _first_rules(material: Material) -> GaussRules:
    """Return the nodes for the once-bounced light, no farther apart than the lobe is wide."""
    c2 = material.c2 * math.exp(abs(material.lobe.anisotropy))
    # A half vector's angle alpha of 1 / sqrt(2 c2) is twice as much of the direction's.
    lobe_deg = 2.0 * math.degrees(1.0 / math.sqrt(2.0 * c2))
    per_third = min(8, max(3, math.ceil(30.0 / lobe_deg)))
    return rules(max(8, 3 * per_third), per_third, 3, 5, 6, True)


def _stations(k: Place, focus: Focus, x_range: tuple[float, float], grain: Grain) -> Float64:
    """Return a lattice's stations over a range."""
    coarsest = grain.far_mm
    if k.corrugation[0] > 0.0:
        coarsest = min(coarsest, float(k.corrugation[1]) / grain.bends)
    return stations(focus.x, x_range, min(grain.near_mm, coarsest), coarsest)


def _passing(k: Place, x_seen: Float64, facing: Bool, focus: Focus, grain: Grain) -> Lattice:
    """Return the lattice over the faces that pass light on more than once."""
    n_faces = len(k.vertices) - 1
    ranges = np.zeros((n_faces, 2))
    for face in np.flatnonzero(facing):
        width = strip(int(face), k.vertices)[4]
        ranges[face] = 0.0, width
        if face == 0:
            ranges[face, 0] = width - min(width, BEYOND_MM)
        elif face == n_faces - 1:
            ranges[face, 1] = min(width, BEYOND_MM)
    low, high = min(focus.x, float(np.nanmin(x_seen))), max(focus.x, float(np.nanmax(x_seen)))
    beyond = max(BEYOND_ALONG_MM, 0.5 * float(k.corrugation[2]) if k.corrugation[0] > 0.0 else 0.0)
    stations = _stations(k, focus, (low - beyond, high + beyond), grain)
    return lattice(stations, ranges, _counts(k, grain), k.vertices, k.corrugation)
