"""The true joint of a made recording: its cross-section, the seam's departure, mesh and exact surface.

Joint frame, mm: x along the nominal seam, y to its left, z out of the metal. The true surface is the nominal
cross-section moved at each station x by y = y_amp sin(2 pi x / y_period) and z = z_slope x; a corrugated
sheet tilts by that slope as it is, its ridges lean. Nothing of `noise_model.surface.joint` but the record
of a joint is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64, Int64
from noise_model.surface.joint import Joint

ACROSS_MM = 400.0
"""How far the plates go to either side of the seam."""

CHORD_MM, BENT_CHORD_MM = 0.5, 0.1
"""Stations of the mesh: chords leave a wandering seam by 1e-4 mm, a ridge 8 mm high by 2e-4 mm."""

SLOPE_STEPS = 3
"""Each leaves a hundredth of what a sheet's tilt moves a ridge's place by."""

NEWTON_STEPS = 1
"""From a chord within 2e-4 mm one step ends within 1e-7 mm."""


@dataclass(frozen=True)
class Departure:
    """How the true seam leaves its nominal line: y = y_amp sin(2 pi x / y_period), z = z_slope x."""

    y_amp_mm: float = 0.0
    y_period_mm: float = 100.0
    z_slope: float = 0.0

    def y_mm(self, x_mm: Float64) -> tuple[Float64, Float64]:
        """Return the departure to the left (...,), mm, and its slope (...,)."""
        k = 2.0 * math.pi / self.y_period_mm
        return self.y_amp_mm * np.sin(k * x_mm), self.y_amp_mm * k * np.cos(k * x_mm)

    def rise_mm(self, y_mm: float) -> float:
        """Return how much the cross-section is raised beside the seam, mm."""
        return 0.0


@dataclass(frozen=True)
class OnePlateTilted(Departure):
    """A departure whose plate at `side` y > 0 is turned about the seam: z = tan(roll_deg) y, there alone."""

    roll_deg: float = 0.0
    side: float = 1.0

    def rise_mm(self, y_mm: float) -> float:
        """Return how much the cross-section is raised beside the seam, mm."""
        return math.tan(math.radians(self.roll_deg)) * y_mm if self.side * y_mm > 0.0 else 0.0


@dataclass(frozen=True)
class TrueSurface:
    """The metal as it really is, in the joint frame."""

    joint: Joint
    departure: Departure

    def outline_mm(self) -> Float64:
        """Return the corners (n, 2) of the cross-section, (y, z) from left to right."""
        size, slope = self.joint.dimensions, 0.0
        match self.joint.type:
            case "flat":
                inner = [(0.0, 0.0)]
            case "v_groove":
                half = math.radians(0.5 * size["included_angle_deg"])
                root, depth = 0.5 * size["root_gap_mm"], size["depth_mm"]
                mouth = root + depth * math.tan(half)
                inner = [(-mouth, 0.0), (-root, -depth), (root, -depth), (mouth, 0.0)]
                if root == 0.0:
                    del inner[1]
            case "lap" | "corrugation":
                inner = [(0.0, size["thickness_mm"]), (0.0, 0.0)]
            case "butt":
                half, thickness = 0.5 * size["gap_mm"], size["thickness_mm"]
                inner = [(-half, 0.0), (-half, -thickness), (half, -thickness), (half, 0.0)]
            case "fillet" | "outside_corner":
                inner = [(0.0, 0.0)]
                slope = 1.0 / math.tan(math.radians(0.5 * size["included_angle_deg"]))
                slope = slope if self.joint.type == "fillet" else -slope
            case other:
                raise ValueError(f"[joint] type = {other!r}: this renderer does not draw it")
        (first_y, first_z), (last_y, last_z) = inner[0], inner[-1]
        ends = (
            (-ACROSS_MM, first_z + slope * (ACROSS_MM + first_y)),
            (ACROSS_MM, last_z + slope * (ACROSS_MM - last_y)),
        )
        return np.array([(y, z + self.departure.rise_mm(y)) for y, z in (ends[0], *inner, ends[1])])

    def lift_mm(self, x_mm: Float64) -> tuple[Float64, Float64]:
        """Return by how much a station is raised (...,), mm, and the slope of it: corrugation and z_slope.

        A sheet that rises tilts as it is, and its ridges lean: what is at (s, c(s)) along the sheet lies at
        (s cos(b) - c sin(b), s sin(b) + c cos(b)), z_slope being tan(b).
        """
        x, tilt = np.asarray(x_mm, dtype=np.float64), math.atan(self.departure.z_slope)
        s = x / math.cos(tilt)
        for _ in range(SLOPE_STEPS):
            s = (x + self._ridge_mm(s)[0] * math.sin(tilt)) / math.cos(tilt)
        c, slope = self._ridge_mm(s)
        z = s * math.sin(tilt) + c * math.cos(tilt)
        return z, np.tan(np.arctan(slope) + tilt)

    def _ridge_mm(self, s_mm: Float64) -> tuple[Float64, Float64]:
        """Return the corrugation's height (...,), mm, along the sheet and its slope; 0 without one."""
        if self.joint.type != "corrugation":
            return np.zeros_like(s_mm), np.zeros_like(s_mm)
        size = self.joint.dimensions
        height, width, pitch = size["height_mm"], size["width_mm"], size["pitch_mm"]
        u = np.mod(s_mm + 0.5 * pitch, pitch) - 0.5 * pitch
        ridge = np.abs(u) < 0.5 * width
        turn = 2.0 * math.pi / width
        c = np.where(ridge, 0.5 * height * (1.0 + np.cos(turn * u)), 0.0)
        return c, np.where(ridge, -0.5 * height * turn * np.sin(turn * u), 0.0)

    def seam_point(self, x_mm: float) -> Float64:
        """Return the true seam point (3,), mm, of a station: the root's middle, or the edge's foot."""
        y, _ = self.departure.y_mm(np.asarray(x_mm))
        z, _ = self.lift_mm(np.asarray(x_mm))
        depth = self.joint.dimensions["depth_mm"] if self.joint.type == "v_groove" else 0.0
        return np.array([x_mm, float(y), float(z) - depth])

    def mesh(self, from_x_mm: float, to_x_mm: float) -> tuple[Float64, Int64, Int64]:
        """Return vertices (n, 3), mm, triangles (m, 3) and each triangle's face (m,), left to right."""
        chord = BENT_CHORD_MM if self.joint.type == "corrugation" else CHORD_MM
        x = np.linspace(from_x_mm, to_x_mm, 2 + int((to_x_mm - from_x_mm) / chord))
        aside, lift = self.departure.y_mm(x)[0], self.lift_mm(x)[0]
        outline = self.outline_mm()
        rows = [np.column_stack([x, y + aside, z + lift]) for y, z in outline]
        first = np.arange(len(x) - 1)
        triangles, faces = [], []
        for face in range(len(outline) - 1):
            lower, upper = face * len(x) + first, (face + 1) * len(x) + first
            triangles += [
                np.column_stack([lower, lower + 1, upper + 1]),
                np.column_stack([lower, upper + 1, upper]),
            ]
            faces += [np.full(2 * len(first), face)]
        return np.concatenate(rows), np.concatenate(triangles), np.concatenate(faces)

    def settle(
        self, origin_mm: Float64, directions: Float64, length_mm: Float64, faces: Int64
    ) -> tuple[Float64, Float64]:
        """Return points (n, 3), mm, exactly on faces (n,) along rays (n, 3) from (3,), and the unit normals.

        `length_mm` (n,) is where the mesh was met; the exact length is Newton's root of the face's equation.
        """
        length = length_mm.astype(np.float64)
        for _ in range(NEWTON_STEPS):
            value, gradient = self.level(origin_mm + length[:, np.newaxis] * directions, faces)
            length = length - value / np.sum(gradient * directions, axis=1)
        points = origin_mm + length[:, np.newaxis] * directions
        _, gradient = self.level(points, faces)
        return points, gradient / np.linalg.norm(gradient, axis=1, keepdims=True)

    def level(self, points_mm: Float64, faces: Int64) -> tuple[Float64, Float64]:
        """Return the signed level (n,) of points (n, 3) over their faces' equations and its gradient (n, 3).

        A face is where (y - y_a) (-dz) + (z - z_a) dy = 0 for the edge from a by (dy, dz), y and z counted
        from the departed, raised cross-section; it grows out of the metal.
        """
        outline = self.outline_mm()
        a, step = outline[:-1][faces], np.diff(outline, axis=0)[faces]
        step = step / np.linalg.norm(step, axis=1, keepdims=True)
        x = points_mm[:, 0]
        (aside, aside_slope), (lift, lift_slope) = self.departure.y_mm(x), self.lift_mm(x)
        y, z = points_mm[:, 1] - aside - a[:, 0], points_mm[:, 2] - lift - a[:, 1]
        dy, dz = step[:, 0], step[:, 1]
        gradient = np.column_stack([dz * aside_slope - dy * lift_slope, -dz, dy])
        return -y * dz + z * dy, gradient
