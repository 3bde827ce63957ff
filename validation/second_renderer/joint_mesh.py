"""A joint's surface as triangles for a renderer, built from its dimensions alone.

Joint frame, mm. Nothing of `noise_model.surface` is called: what judges the arc map draws its own joint.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64, Int64
from noise_model.surface.joint import Joint

REACH_MM = 400.0
"""How far the mesh goes to either side of its middle, along the seam and across."""

CHORD_MM = 0.02
"""The chords of a corrugation: within 1e-5 mm of it at a height of 8 mm over 30 mm."""


@dataclass(frozen=True)
class FaceMesh:
    """One smooth face: vertices (n, 3), mm, their unit normals (n, 3) out of the metal, triangles (m, 3)."""

    vertices_mm: Float64
    normals: Float64
    triangles: Int64


def joint_mesh(joint: Joint, middle_x_mm: float) -> list[FaceMesh]:
    """Mesh each face of a joint, left to right, about a station of the seam; the seam point is at y = 0.

    The cross-sections are RECORDING.md's: a flat plate; a V-groove, open at the root gap to its full depth;
    a lap's sheet at y < 0; the same with both sheets raised by c(x). Raises ValueError for any other joint.
    """
    if joint.type == "corrugation":
        x = np.linspace(-REACH_MM, REACH_MM, 1 + round(2.0 * REACH_MM / CHORD_MM)) + middle_x_mm
    else:
        x = np.array([-REACH_MM, REACH_MM]) + middle_x_mm
    outline = _outline(joint)
    return [_extrude(joint, x, a, b) for a, b in itertools.pairwise(outline)]


def _outline(joint: Joint) -> list[tuple[float, float]]:
    """Return the corners (y, z) of the cross-section from left to right, mm."""
    size = joint.dimensions
    if joint.type == "flat":
        return [(-REACH_MM, 0.0), (REACH_MM, 0.0)]
    if joint.type == "v_groove":
        root, depth = 0.5 * size["root_gap_mm"], size["depth_mm"]
        mouth = root + depth * math.tan(math.radians(0.5 * size["included_angle_deg"]))
        left_half = [(-REACH_MM, 0.0), (-mouth, 0.0), (-root, -depth)]
        right_half = [(-y, z) for y, z in reversed(left_half)]
        return left_half + right_half if root > 0.0 else left_half + right_half[1:]
    if joint.type not in ("lap", "corrugation"):
        raise ValueError(f"[joint] type = {joint.type!r}: has no mesh here")
    top = size["thickness_mm"]
    return [(-REACH_MM, top), (0.0, top), (0.0, 0.0), (REACH_MM, 0.0)]


def _extrude(joint: Joint, x: Float64, a: tuple[float, float], b: tuple[float, float]) -> FaceMesh:
    """Draw the edge a to b of the cross-section along the stations x (n,)."""
    height, slope = _wave(joint, x)
    vertices = np.empty((len(x), 2, 3))
    for side, (y, z) in enumerate((a, b)):
        vertices[:, side] = np.column_stack([x, np.full_like(x, y), z + height])
    # Tangents (1, 0, c') and (0, dy, dz): the metal lies to the right of a step from a to b.
    dy, dz = b[0] - a[0], b[1] - a[1]
    normal = np.column_stack([-slope * dy, np.full_like(x, -dz), np.full_like(x, dy)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = 2 * np.arange(len(x) - 1)
    triangles = np.concatenate([np.add.outer(first, pair) for pair in ([0, 2, 1], [1, 2, 3])])
    return FaceMesh(vertices.reshape(-1, 3), np.repeat(normal, 2, axis=0), triangles)


def _wave(joint: Joint, x: Float64) -> tuple[Float64, Float64]:
    """Return a corrugation's height (n,), mm, and slope (n,): height cos^2(pi u / width), |u| < width/2."""
    if joint.type != "corrugation":
        return np.zeros_like(x), np.zeros_like(x)
    size = joint.dimensions
    phase = x / size["pitch_mm"]
    u = size["pitch_mm"] * (phase - np.floor(phase + 0.5))
    angle = np.clip(np.pi * u / size["width_mm"], -0.5 * np.pi, 0.5 * np.pi)
    height = size["height_mm"] * np.cos(angle) ** 2
    slope = -size["height_mm"] * np.pi / size["width_mm"] * np.sin(2.0 * angle)
    return height, slope
