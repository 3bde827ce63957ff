"""The laser sheet: where it lies and how its irradiance falls off."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64, Vector
from noise_model.compiled.kernel import kernel
from noise_model.surface.brdf import LobeNumbers, reflected
from noise_model.transforms import transform

SHEET_REACH = 6.0
"""Half-width of the rendered sheet, in its sigmas: its irradiance has fallen to 1.5e-8 there."""


MAX_BOW = 0.5
"""Largest bow that is no typing error: 30 deg off its axis the fan would stand 10 deg off its plane."""


@dataclass(frozen=True)
class Laser:
    """A sheet of light that fans out from a point along -z of the tool frame.

    Parameters
    ----------
    wavelength_nm : float
        The laser's wavelength, nm.
    plane_in_tool : tuple (4,)
        The sheet (n_x, n_y, n_z, d) with n.p + d = 0, mm, tool frame; the normal's length is 1.
    origin_in_tool_mm : tuple (3,)
        The point that the sheet comes from, mm, tool frame.
    stripe_sigma_mm : float
        1 sigma of half the sheet's thickness at tool height, mm.
    peak_e : float
        The stripe's peak before the point-spread function, e-: on a flat plate at tool height, level pose,
        middle column, whether or not the fan reaches so far.
    fan_half_angle_deg : float, optional
        Where the fan ends to either side of its axis, the steepest line in the sheet: the angle to it in the
        sheet, deg. There the light falls to 0 at once. Without it the fan is wider than any image.
    profile_exponent : float
        How the irradiance falls off across the sheet: exp(-1/2 abs(x' / sigma)^exponent). A stated laser has
        2, a Gaussian.
    bow : float
        How far the sheet leaves its plane: on it n.p + d = bow u^2 / z, with u mm across the fan's axis and z
        mm below the origin along the tool's axis. That is the cone that a line generator makes whose lens
        is not square to its beam; 0 is the plane.

    Raises
    ------
    ValueError
        For a value out of its range; it names the key.
    """

    wavelength_nm: float
    plane_in_tool: tuple[float, float, float, float]
    origin_in_tool_mm: tuple[float, float, float]
    stripe_sigma_mm: float
    peak_e: float
    fan_half_angle_deg: float | None = None
    profile_exponent: float = 2.0
    bow: float = 0.0

    def __post_init__(self) -> None:
        for name in ("wavelength_nm", "stripe_sigma_mm", "peak_e", "profile_exponent"):
            if not getattr(self, name) > 0:
                raise ValueError(f"[laser] {name} = {getattr(self, name)}: must be > 0")
        if not self.origin_in_tool_mm[2] > 0:
            raise ValueError("[laser] origin_in_tool_mm: the laser must stand above the tool's origin")
        norm = float(np.linalg.norm(self.plane_in_tool[:3]))
        if not abs(norm - 1.0) <= 1e-3:
            raise ValueError(f"[laser] plane_in_tool: the normal's length is {norm:.4f}, not 1")
        # A sheet whose normal is nearer to the tool's z than this never meets the plate.
        if np.hypot(*self.plane_in_tool[:2]) < 1e-6:
            raise ValueError("[laser] plane_in_tool: the sheet lies parallel to the plate")
        if not (np.isfinite(self.plane_in_tool).all() and np.isfinite(self.origin_in_tool_mm).all()):
            raise ValueError("[laser] plane_in_tool, origin_in_tool_mm: must be finite")
        if not abs(self.bow) <= MAX_BOW:
            raise ValueError(f"[laser] bow = {self.bow}: must lie between -{MAX_BOW:g} and {MAX_BOW:g}")
        if self.fan_half_angle_deg is not None and not 0.0 < self.fan_half_angle_deg < 90.0:
            raise ValueError(
                f"[laser] fan_half_angle_deg = {self.fan_half_angle_deg}: must lie between 0 and 90"
            )

    def __str__(self) -> str:
        plane = " ".join(f"{value:g}" for value in self.plane_in_tool)
        fan = "" if self.fan_half_angle_deg is None else f", fan of +-{self.fan_half_angle_deg:g} deg"
        fan += "" if self.bow == 0.0 else f", bow {self.bow:g}"
        return (
            f"{self.wavelength_nm:g} nm, plane [{plane}] in tool, stripe sigma {self.stripe_sigma_mm:g} mm, "
            f"peak {self.peak_e:g} e-{fan}"
        )

    @property
    def plane(self) -> Float64:
        """`plane_in_tool` (4,) as an array: one for all who ask, it is not to be written to."""
        return _array(self.plane_in_tool)

    @property
    def origin_mm(self) -> Float64:
        """`origin_in_tool_mm` (3,) as an array: one for all who ask, it is not to be written to."""
        return _array(self.origin_in_tool_mm)

    @property
    def point_mm(self) -> Float64:
        """The sheet's point (3,) at tool height nearest to that below the laser, tool frame, mm.

        It is not to be written to.
        """
        return _point_below(self.plane_in_tool, self.origin_in_tool_mm)

    @property
    def reach_sigmas(self) -> float:
        """Half-width of the rendered sheet, in sigmas: `SHEET_REACH` of a Gaussian, as dim for any other."""
        return float(SHEET_REACH ** (2.0 / self.profile_exponent))

    @property
    def fan(self) -> tuple[Float64, Float64, float]:
        """The fan's axis (3,) and the direction (3,) across it in the sheet, tool frame, and its slope.

        The fan holds what lies no farther across its axis than the slope times the way along it; the slope is
        infinite without an end.
        """
        n_x, n_y, n_z, _ = self.plane_in_tool
        flat = math.hypot(n_x, n_y)
        axis = np.array([n_x * n_z, n_y * n_z, -flat * flat]) / (flat * math.hypot(flat, n_z))
        angle = self.fan_half_angle_deg
        slope = math.inf if angle is None else math.tan(math.radians(angle))
        return axis, np.array([-n_y, n_x, 0.0]) / flat, slope

    def off_mm(self, points_tool: Float64) -> Float64:
        """Return the distance (n,) of points (n, 3) from the sheet along the plane's normal, mm."""
        off = points_tool @ self.plane[:3] + self.plane[3]
        if self.bow == 0.0:
            return np.asarray(off)
        depth_mm = self.origin_in_tool_mm[2] - points_tool[..., 2]
        return np.asarray(off - self.bow * self._across_mm(points_tool) ** 2 / depth_mm)

    def normals(self, points_tool: Float64) -> Float64:
        """Return the normals (n, 3) of the planes that touch the sheet at points (n, 3), tool frame, mm."""
        q = self._across_mm(points_tool) / (self.origin_in_tool_mm[2] - points_tool[..., 2])
        side, up = self.fan[1], np.array([0.0, 0.0, 1.0])
        return self.plane[:3] - self.bow * (2.0 * np.outer(q, side) + np.outer(q**2, up))

    def in_frame(self, T_new_tool: Float64) -> Laser:
        """Return the same sheet in another tool frame; `T_new_tool` (4, 4) is in mm.

        Its fan has another steepest line there, along which its plane touches it.
        """
        plane, up = self.plane, T_new_tool[2, :3]
        for _ in range(2 if self.bow != 0.0 else 0):
            axis = (plane[:3] @ up) * plane[:3] - up
            plane = np.array(tangent_plane(sheet_in_tool(self), self.origin_mm + axis))
            plane /= np.linalg.norm(plane[:3])
        n_x, n_y, n_z, d_mm = plane_in(np.ascontiguousarray(T_new_tool), plane)
        x, y, z = transform(T_new_tool, self.origin_mm).tolist()
        return replace(self, plane_in_tool=(n_x, n_y, n_z, d_mm), origin_in_tool_mm=(x, y, z))

    def _across_mm(self, points_tool: Float64) -> Float64:
        return np.asarray((points_tool - self.origin_mm) @ self.fan[1])


@lru_cache
def _array(values: tuple[float, ...]) -> Float64:
    return np.array(values, dtype=np.float64)


@lru_cache
def _point_below(plane: tuple[float, ...], origin_mm: tuple[float, ...]) -> Float64:
    below, normal = np.array([*origin_mm[:2], 0.0]), np.array([*plane[:2], 0.0])
    return np.asarray(below - (normal @ below + plane[3]) / (normal @ normal) * normal)


class Sheet(NamedTuple):
    """A pose's laser sheet in the joint frame, as the kernels take it; mm.

    `plane` (4,) is n.p + d = 0 and `tool_up` (3,) the tool's z axis; `sigma` the sheet's half-thickness at
    tool height and `stand` the height of its `origin` (3,) over it. `axis`, `side` (3,) and `slope` are the
    laser's `fan`, `exponent` its profile's, `bow` how far it leaves the plane. Of several poses all arrays
    have one more axis before.
    """

    origin: Float64
    plane: Float64
    tool_up: Float64
    sigma: float
    stand: float
    axis: Float64
    side: Float64
    slope: float
    exponent: float
    bow: float


@kernel
def plane_in(T_a_b: Float64, plane_b: Float64) -> tuple[float, float, float, float]:
    """Return a plane (n_x, n_y, n_z, d), n.p + d = 0, of frame b in frame a."""
    T, n = T_a_b, plane_b
    nx = T[0, 0] * n[0] + T[0, 1] * n[1] + T[0, 2] * n[2]
    ny = T[1, 0] * n[0] + T[1, 1] * n[1] + T[1, 2] * n[2]
    nz = T[2, 0] * n[0] + T[2, 1] * n[1] + T[2, 2] * n[2]
    return nx, ny, nz, n[3] - nx * T[0, 3] - ny * T[1, 3] - nz * T[2, 3]


@kernel(allocates=True)
def sheet_in(T_a_b: Float64, sheet_b: Sheet) -> Sheet:
    """Return a sheet of frame b in frame a."""
    origin, plane, up, axis, side = np.empty(3), np.empty(4), np.empty(3), np.empty(3), np.empty(3)
    T, there = T_a_b, sheet_b
    for i in range(3):
        x, y, z = T[i, 0], T[i, 1], T[i, 2]
        origin[i] = x * there.origin[0] + y * there.origin[1] + z * there.origin[2] + T[i, 3]
        up[i] = x * there.tool_up[0] + y * there.tool_up[1] + z * there.tool_up[2]
        axis[i] = x * there.axis[0] + y * there.axis[1] + z * there.axis[2]
        side[i] = x * there.side[0] + y * there.side[1] + z * there.side[2]
    plane[0], plane[1], plane[2], plane[3] = plane_in(T, there.plane)
    return Sheet(
        origin=origin,
        plane=plane,
        tool_up=up,
        sigma=there.sigma,
        stand=there.stand,
        axis=axis,
        side=side,
        slope=there.slope,
        exponent=there.exponent,
        bow=there.bow,
    )


def sheet_in_tool(laser: Laser) -> Sheet:
    """Gather a laser for the kernels, in the tool frame."""
    axis, side, slope = laser.fan
    up, stand = np.array([0.0, 0.0, 1.0]), laser.origin_in_tool_mm[2]
    sigma, exponent = laser.stripe_sigma_mm, laser.profile_exponent
    return Sheet(
        origin=laser.origin_mm,
        plane=laser.plane,
        tool_up=up,
        sigma=sigma,
        stand=stand,
        axis=axis,
        side=side,
        slope=slope,
        exponent=exponent,
        bow=laser.bow,
    )


def sheet_of(laser: Laser, T_joint_tool: Float64) -> Sheet:
    """Put a laser's sheet into the joint frame."""
    return sheet_in(np.ascontiguousarray(T_joint_tool), sheet_in_tool(laser))


def sheets_of(laser: Laser, T_joint_tool: Float64) -> Sheet:
    """Put a laser's sheet into the joint frame of several poses (n, 4, 4)."""
    R, place = T_joint_tool[:, :3, :3], T_joint_tool[:, :3, 3]
    axis, side, slope = laser.fan
    normal = R @ laser.plane[:3]
    return Sheet(
        origin=R @ laser.origin_mm + place,
        plane=np.column_stack([normal, laser.plane[3] - (normal * place).sum(axis=1)]),
        tool_up=np.ascontiguousarray(R[:, :, 2]),
        sigma=laser.stripe_sigma_mm,
        stand=laser.origin_in_tool_mm[2],
        axis=R @ axis,
        side=R @ side,
        slope=slope,
        exponent=laser.profile_exponent,
        bow=laser.bow,
    )


@kernel(allocates=True)
def sheet_at(sheets: Sheet, n: int) -> Sheet:
    """Return the sheet of one of several poses."""
    return Sheet(
        origin=sheets.origin[n],
        plane=sheets.plane[n],
        tool_up=sheets.tool_up[n],
        sigma=sheets.sigma,
        stand=sheets.stand,
        axis=sheets.axis[n],
        side=sheets.side[n],
        slope=sheets.slope,
        exponent=sheets.exponent,
        bow=sheets.bow,
    )


@kernel(inline=True)
def depth_below(sheet: Sheet, Q: Vector) -> float:
    """Return the depth of a point below the laser's origin along the tool's axis, mm."""
    up, origin = sheet.tool_up, sheet.origin
    depth: float = (origin[0] - Q[0]) * up[0] + (origin[1] - Q[1]) * up[1] + (origin[2] - Q[2]) * up[2]
    return depth


@kernel(inline=True)
def off_sheet(sheet: Sheet, Q: Vector) -> float:
    """Return the distance of a point from the sheet along the plane's normal, mm."""
    plane = sheet.plane
    off: float = plane[0] * Q[0] + plane[1] * Q[1] + plane[2] * Q[2] + plane[3]
    if sheet.bow != 0.0:
        side, origin = sheet.side, sheet.origin
        u = side[0] * (Q[0] - origin[0]) + side[1] * (Q[1] - origin[1]) + side[2] * (Q[2] - origin[2])
        off -= sheet.bow * u * u / depth_below(sheet, Q)
    return off


@kernel
def tangent_plane(sheet: Sheet, Q: Vector) -> tuple[float, float, float, float]:
    """Return the plane (n_x, n_y, n_z, d) that touches the sheet on the laser's ray through a point.

    With q = u / z at the point, the gradient of bow u^2 / z is bow (2 q side + q^2 up), the same along the
    ray. At another q' the sheet lies bow (q' - q)^2 z off that plane. Without a bow it is the sheet's own.
    """
    plane, origin, side, up = sheet.plane, sheet.origin, sheet.side, sheet.tool_up
    nx, ny, nz, d = plane[0], plane[1], plane[2], plane[3]
    if sheet.bow != 0.0:
        u = side[0] * (Q[0] - origin[0]) + side[1] * (Q[1] - origin[1]) + side[2] * (Q[2] - origin[2])
        q = u / depth_below(sheet, Q)
        a, b = 2.0 * sheet.bow * q, sheet.bow * q * q
        gx, gy, gz = a * side[0] + b * up[0], a * side[1] + b * up[1], a * side[2] + b * up[2]
        nx, ny, nz = nx - gx, ny - gy, nz - gz
        d += gx * origin[0] + gy * origin[1] + gz * origin[2]
    return nx, ny, nz, d


@kernel
def plane_met(sheet: Sheet, start: Vector, way: Vector) -> tuple[float, float, float, float]:
    """Return the plane (n_x, n_y, n_z, d) that touches the sheet where a line from a start meets it.

    The line meets the sheet where it meets that plane: two of Newton's steps from the sheet's own plane,
    bow q^2 z off. At an angle a to the sheet the first leaves bow^3 q^4 z / sin^2 a, the second
    bow^7 q^8 z / sin^6 a: 5e-5 mm for a bow of 0.15, 30 deg off the fan's axis, at 45 deg and 300 mm.
    """
    met = sheet.plane[0], sheet.plane[1], sheet.plane[2], sheet.plane[3]
    if sheet.bow != 0.0:
        for _ in range(2):
            n_x, n_y, n_z, d = met
            t = -(n_x * start[0] + n_y * start[1] + n_z * start[2] + d)
            t /= n_x * way[0] + n_y * way[1] + n_z * way[2]
            met = tangent_plane(sheet, (start[0] + t * way[0], start[1] + t * way[1], start[2] + t * way[2]))
    return met


@kernel(inline=True)
def is_outside_fan(sheet: Sheet, Q: Vector) -> bool:
    """Return True if a point below the laser's origin lies beyond the fan's end."""
    x, y, z = Q[0] - sheet.origin[0], Q[1] - sheet.origin[1], Q[2] - sheet.origin[2]
    along: float = x * sheet.axis[0] + y * sheet.axis[1] + z * sheet.axis[2]
    across: float = x * sheet.side[0] + y * sheet.side[1] + z * sheet.side[2]
    return abs(across) > sheet.slope * along


@kernel
def sheet_reflected(
    sheet: Sheet, material: LobeNumbers, Q: Vector, normal: Vector, omega_r: Vector, reach: float = math.inf
) -> float:
    """Return the sheet's light that Q reflects along `omega_r`: its irradiance over the peak's, times f_r.

    The irradiance is exp(-1/2 |x' / (sigma z/h)|^p) (h/z)^2 cos(theta_i) / cos(psi): x' the distance from the
    sheet, p the profile's exponent, z the depth below the origin, h the origin's height, psi the angle of the
    point's ray to the tool's axis, theta_i its incidence; 1 on the axis at tool height for a level plate.
    It is 0 more than `reach` sigmas of the sheet away, and beyond the fan's end. Hidden points are the
    caller's to exclude.
    """
    wx, wy, wz = sheet.origin[0] - Q[0], sheet.origin[1] - Q[1], sheet.origin[2] - Q[2]
    depth = depth_below(sheet, Q)
    distance = math.sqrt(wx * wx + wy * wy + wz * wz)
    wx, wy, wz = wx / distance, wy / distance, wz / distance
    cos_i = wx * normal[0] + wy * normal[1] + wz * normal[2]
    # A point past the workpiece is NaN, and dark.
    if not (depth > 0.0 and cos_i > 0.0):
        return 0.0
    off = off_sheet(sheet, Q) / (sheet.sigma * depth / sheet.stand)
    if abs(off) > reach or is_outside_fan(sheet, Q):
        return 0.0
    power = off * off if sheet.exponent == 2.0 else abs(off) ** sheet.exponent
    light: float = math.exp(-0.5 * power) * (sheet.stand / depth) ** 2 * cos_i * distance / depth
    return light * reflected(material, (wx, wy, wz), omega_r, normal)
