"""The picture of the joints' sections and seam points in docs/reference/recording.md, as SVG."""

from __future__ import annotations

import math

import numpy as np

from arctrack.nominal import DIMENSIONS
from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import Joint, section

SEAM = ((0.0, 0.0, 0.0), (100.0, 0.0, 0.0))
REACH_MM, PX_PER_MM = 8.5, 10.0
COLUMNS, WIDTH_PX, HEIGHT_PX = 3, 220.0, 170.0
SURFACE_PX = 70.0
"""Distance of a section's z = 0 from its panel's top."""

HUMP = tuple((float(y), round(2.5 * math.exp(-(((y - 3.0) / 2.5) ** 2)), 3)) for y in range(-9, 10))
"""A section as it may be taught: a bead beside the seam."""


def drawn_joints() -> list[tuple[str, Joint]]:
    """Return each type of joint with nominal dimensions, and its caption."""
    drawn = [(name, Joint(name, size, SEAM)) for name, size in DIMENSIONS.items()]
    t_joint = Joint("fillet", DIMENSIONS["fillet"] | {"gap_mm": 2.0}, SEAM)
    bead = tuple((y, round(z - HUMP[9][1], 3)) for y, z in HUMP)
    free = Joint("free", {}, SEAM, section_mm=bead)
    return [*drawn, ("fillet with gap_mm", t_joint), ("free", free)]


def draw_joints() -> str:
    """Return the picture: a panel a joint, its metal grey, its seam point red."""
    drawn = drawn_joints()
    width, height = COLUMNS * WIDTH_PX, -(-len(drawn) // COLUMNS) * HEIGHT_PX
    panels = [
        _panel(name, joint, WIDTH_PX * (n % COLUMNS), HEIGHT_PX * (n // COLUMNS))
        for n, (name, joint) in enumerate(drawn)
    ]
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" role="img" '
        'aria-label="Cross-sections of the joints with their seam points">\n'
        "<style>text{font:15px sans-serif;fill:#222;text-anchor:middle}.seam{fill:#c0392b}"
        ".metal{fill:#d5d8dc;stroke:#566573;stroke-width:2}</style>\n"
        f'<rect width="{width:g}" height="{height:g}" fill="#fff"/>\n'
    )
    return head + "".join(panels) + "</svg>\n"


def _panel(name: str, joint: Joint, left_px: float, top_px: float) -> str:
    """Return one joint's panel, seen along the travel: y rises to the left."""
    corners = section(joint).vertices
    y = np.clip(corners[:, 0], -REACH_MM, REACH_MM)
    z = np.interp(y, *corners.T)
    z = np.where(np.abs(corners[:, 0]) <= REACH_MM, corners[:, 1], z)
    seam_z = -joint.dimensions["depth_mm"] if "depth_mm" in joint.dimensions else 0.0
    # Plates that rise from a corner have it lower in the panel.
    panel_px = top_px + (0.25 * HEIGHT_PX if joint.type == "fillet" else 0.0)
    x_px, y_px = _place(y, z, left_px, panel_px)
    bottom = top_px + HEIGHT_PX - 15.0
    path = " ".join(f"{a:.1f},{min(b, bottom):.1f}" for a, b in zip(x_px, y_px, strict=True))
    ends = f"{x_px[-1]:.1f},{bottom:.1f} {x_px[0]:.1f},{bottom:.1f}"
    (seam_x,), (seam_y,) = _place(np.zeros(1), np.array([seam_z]), left_px, panel_px)
    return (
        f'<polygon class="metal" points="{path} {ends}"/>\n'
        f'<circle class="seam" cx="{seam_x:.1f}" cy="{seam_y:.1f}" r="5"/>\n'
        f'<text x="{left_px + 0.5 * WIDTH_PX:g}" y="{top_px + 20.0:g}">{name}</text>\n'
    )


def _place(y_mm: Float64, z_mm: Float64, left_px: float, top_px: float) -> tuple[Float64, Float64]:
    """Return the picture's x and y, px, of points of a section."""
    return left_px + 0.5 * WIDTH_PX - PX_PER_MM * y_mm, top_px + SURFACE_PX - PX_PER_MM * z_mm
