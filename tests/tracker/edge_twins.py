"""Plain NumPy twins of what places an upright edge between the faces that points lie on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from profiles import Profile

from noise_model.compiled.arrays import Bool, Float64
from tracker.joint.measured import OnFace
from tracker.joint.upright_edge import EdgeScatter
from tracker.stripe.light import NEXT_TO_NOTHING, WINDOW_SIGMAS, StripeLight


@dataclass(frozen=True)
class FacesBeside:
    """Heights (2, n), mm, and slopes (2, n) of the faces before and behind an edge at points (n,)."""

    heights_mm: Float64
    slopes: Float64

    def met(self, profile: Profile, before: int) -> OnFace:
        """Where points' rays meet the face before, up to the point `before`, or that behind."""
        which = (np.arange(len(profile.y_mm)) > before).astype(int), np.arange(len(profile.y_mm))
        y_per_z = profile.dy_mm / (profile.dz_mm - self.slopes[which] * profile.dy_mm)
        return OnFace(profile.y_mm - y_per_z * (profile.z_mm - self.heights_mm[which]), y_per_z)

    def change(self, profile: Profile, near: Bool, bent_mm: float, before: int, behind: int) -> EdgeScatter:
        """`change_of` of points that are `near` (n,), all in one row."""
        first, last = np.flatnonzero(near)[[0, -1]]
        rows = slice(first, last + 1)
        moved_px = moved_by_background_px(profile.light, profile.scan[rows], profile.sigma_px[rows])
        across = profile.dz_mm[rows] - self.slopes[:, rows] * profile.dy_mm[rows]
        sigma_mm = np.hypot(across * np.hypot(profile.sigma_px[rows], moved_px), bent_mm)
        squares = np.minimum(((profile.z_mm[rows] - self.heights_mm[:, rows]) / sigma_mm) ** 2, 25.0)
        # All changes at once: the points up to one lie before, the others behind.
        up_to = np.tri(last - first + 1)[:-1]
        chi2 = up_to @ squares[0] + (1.0 - up_to) @ squares[1]
        y_per_z = profile.dy_mm[rows] / across
        met_mm = profile.y_mm[rows] - y_per_z * (profile.z_mm[rows] - self.heights_mm[:, rows])
        wide_mm = profile.column_mm * np.abs(np.diff(profile.scan[rows]))
        off_mm = 0.5 * (met_mm[0, :-1] + met_mm[1, 1:])
        off_mm = off_mm - 0.5 * (met_mm[0, before - first] + met_mm[1, behind - first])
        weight = wide_mm * np.exp(-0.5 * (chi2 - chi2.min()))
        weight /= weight.sum()
        square = off_mm**2 + wide_mm**2 / 12.0
        seems_mm = profile.column_mm * abs(profile.scan[behind] - profile.scan[before])
        clear = np.abs(off_mm) > 0.5 * seems_mm + wide_mm
        return EdgeScatter(weight @ square, (weight * square)[clear].sum())


def moved_by_background_px(light: StripeLight, scan: Float64, sigma_px: Float64) -> Float64:
    """By how much the centres of lines (n,) move where their background is the next line's, px."""
    n = len(scan)
    if len(light.position_px) == 0:
        return np.zeros(n)
    lines = scan.astype(int)
    centres, widths = light.position_px[lines], light.width_px[lines]
    pixels = np.arange(light.charge_e.shape[1], dtype=float)
    change = np.zeros(light.background_e.shape)
    change[1:-1] = 0.5 * (light.background_e[2:].astype(float) - light.background_e[:-2])
    nearest = np.round(centres).astype(int)
    residual = light.charge_e[lines, nearest].astype(float) - light.background_e[lines, nearest]
    bell = np.exp(-0.5 * ((nearest - centres) / widths) ** 2)
    usual = np.median(np.maximum(residual, 0.0) / bell)
    moved = np.zeros(n)
    for i, (s, centre, width) in enumerate(zip(lines, centres, widths, strict=True)):
        window = (pixels >= np.floor(centre - WINDOW_SIGMAS * width)) & (
            pixels <= np.ceil(centre + WINDOW_SIGMAS * width)
        )
        r, d = (pixels[window] - centre) / width, change[s][window]
        slope = r / width * np.exp(-0.5 * r**2)
        scale = 2.0 * width / (usual * np.sqrt(np.pi))
        if np.ptp(d) * scale >= NEXT_TO_NOTHING * sigma_px[i]:
            moved[i] = abs((d - 0.5 * (d.min() + d.max())) @ slope) * scale
    return moved
