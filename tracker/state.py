"""What goes into a step and what comes out of it, and the frozen state that it hands on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from noise_model.arrays import Bool, Float64, Integers
from noise_model.setup import Setup
from tracker import flags
from tracker.checks import Check

NAN = math.nan

Pair = tuple[float, float]
UNKNOWN: Pair = (math.nan, math.nan)


@dataclass(frozen=True)
class JointShape:
    """What a section shows beside seam point, gap and mismatch, with 1 sigma; NaN where it has none.

    Pairs are (left, right). `bevel_angles_deg`: a bevel's angle from upright, joint frame;
    `plate_angles_deg`: a plate's, or sheet's, from level, positive where it rises to the left; `area_mm2`:
    the opening below the line from one plate's edge to the other's, of a butt its gap times the stated
    thickness.
    """

    gap_sigma_mm: float = math.nan
    mismatch_sigma_mm: float = math.nan
    bevel_angles_deg: Pair = UNKNOWN
    bevel_sigmas_deg: Pair = UNKNOWN
    plate_angles_deg: Pair = UNKNOWN
    plate_sigmas_deg: Pair = UNKNOWN
    area_mm2: float = math.nan
    area_sigma_mm2: float = math.nan


NO_SHAPE = JointShape()


@dataclass(frozen=True)
class Frame:
    """One raw frame (H, W), uint8 or uint16, and the condition it was taken under.

    `timestamp_s` is mid-exposure; `current_a`, `exposure_s` are NaN where nobody knows them.
    """

    index: int
    timestamp_s: float
    image_dn: Integers = field(repr=False)
    exposure_s: float
    current_a: float = NAN
    laser_on: bool = True
    arc_on: bool = True

    def __str__(self) -> str:
        size = " x ".join(str(side) for side in reversed(self.image_dn.shape))
        lit = [name for name, on in (("laser", self.laser_on), ("arc", self.arc_on)) if on]
        current = f" at {self.current_a:g} A" if self.arc_on and math.isfinite(self.current_a) else ""
        return (
            f"frame {self.index} at {self.timestamp_s:.3f} s: {size} px {self.image_dn.dtype}, "
            f"{' and '.join(lit) or 'no light'}{current}, {1000 * self.exposure_s:g} ms"
        )


def frame_misfit(shape: tuple[int, ...], dtype: npt.DTypeLike, setup: Setup) -> str | None:
    """Return what is wrong with an image's shape, (H, W) if right, and type for a setup; None if it fits."""
    camera, sensor = setup.camera, setup.sensor
    wanted = (camera.height, camera.width)
    if len(shape) == 3:
        colours = "is a colour picture" if shape[2] in (3, 4) else "has a third axis"
        return (
            f"{colours}, {shape[2]} channels: a raw grey frame of {camera.width} x {camera.height} is needed"
        )
    if len(shape) != 2:
        return f"has {len(shape)} axes: a raw grey frame of {camera.width} x {camera.height} is needed"
    if shape != wanted:
        cure = "; it is turned: swap rows and columns" if shape == wanted[::-1] else ""
        stated = f"[camera] width and height say {camera.width} x {camera.height}"
        return f"is {shape[1]} x {shape[0]}, {stated}{cure}"
    if np.dtype(dtype) != np.dtype(sensor.dtype):
        needed = f"[sensor] bits = {sensor.bits} needs raw codes in {np.dtype(sensor.dtype).name}"
        return f"holds {np.dtype(dtype)}, {8 * np.dtype(dtype).itemsize} bits a pixel: {needed}"
    return None


@dataclass(frozen=True)
class Pose:
    """T_base_tool (4, 4), mm, at a frame's time."""

    T_base_tool: Float64
    extrapolated: bool = False

    def __repr__(self) -> str:
        x_mm, y_mm, z_mm = self.T_base_tool[:3, 3]
        tilt_deg = math.degrees(math.acos(np.clip(self.T_base_tool[2, 2], -1.0, 1.0)))
        how = ", extrapolated" if self.extrapolated else ""
        place = f"({x_mm:.2f}, {y_mm:.2f}, {z_mm:.2f}) mm in base"
        return f"Pose(tool at {place}, {tilt_deg:.1f} deg off its z{how})"


@dataclass(frozen=True)
class Stripe:
    """The stripe per scan line, the image's columns if the stripe runs along its rows.

    `position_px` (n,) is NaN where there is no stripe; `sigma_px` its 1 sigma; `amplitude_e` the peak over
    the background; `saturated` says where pixels were censored. These are the lines' own, and independent
    but for speckle's grains, which reach over a few lines: `beside_px` (n,) is the 1 sigma with which each
    counts among its neighbours. The joint is fitted to them. `smooth_px` and `smooth_sigma_px` (n,) are what
    the neighbours along the stripe make of them (`tracker.stripe.smooth`), NaN also at outliers and where the
    centre stays unsure.
    """

    position_px: Float64
    sigma_px: Float64
    smooth_px: Float64
    smooth_sigma_px: Float64
    amplitude_e: Float64
    saturated: Bool
    along_rows: bool
    beside_px: Float64


@dataclass(frozen=True)
class Track:
    """One frame's result; what is not known is NaN with a flag that says why.

    `seam_tool_mm` is the seam point in the laser plane, tool frame. `sigma_y_mm` and `sigma_z_mm` are its
    1 sigma across and along the surface normal, the stated hand-eye tolerance included. The offsets are the
    seam's displacement from the programmed path in S at the torch's station, valid at `valid_at_s`, as gain,
    bias and limit of the correction leave it; their sigmas say how well the seam is known there, and
    `offset_confidence`, with the hand-eye tolerance, how probably that is within the weld's tolerance.
    `joint_start_mm` and `joint_end_mm` are station and 1 sigma of the joint's ends where they were found.
    `arc_level` is the arc's output over what the setup expects for the frame's current and exposure;
    `map_misfit` is the arc residual over its stated uncertainty, robustly, 1 or less where the map is right.
    `fov_margin_mm` is how far the seam point lies inside the profile's nearer end, negative beyond it;
    `shape` what else the section shows; `checks` all that the step asked of the frame, in its order.
    """

    frame: int
    timestamp_s: float
    flags: int
    seam_tool_mm: tuple[float, float, float] = (NAN, NAN, NAN)
    sigma_y_mm: float = NAN
    sigma_z_mm: float = NAN
    offset_y_mm: float = NAN
    offset_z_mm: float = NAN
    offset_sigma_y_mm: float = NAN
    offset_sigma_z_mm: float = NAN
    offset_confidence: float = NAN
    valid_at_s: float = NAN
    gap_mm: float = NAN
    mismatch_mm: float = NAN
    confidence: float = NAN
    joint_start_mm: tuple[float, float] = (NAN, NAN)
    joint_end_mm: tuple[float, float] = (NAN, NAN)
    arc_level: float = NAN
    map_misfit: float = NAN
    fov_margin_mm: float = NAN
    shape: JointShape = NO_SHAPE
    stripe: Stripe | None = field(default=None, repr=False)
    checks: tuple[Check, ...] = field(default=(), repr=False)

    @property
    def valid(self) -> bool:
        """Whether the seam point may be used."""
        return not self.flags & flags.INVALIDATING and math.isfinite(self.seam_tool_mm[1])

    def __str__(self) -> str:
        raised = ", ".join(self.flag_names) or "none"
        if not self.valid:
            return f"track of frame {self.frame} at {self.timestamp_s:.3f} s: no seam; flags: {raised}"
        _, y_mm, z_mm = self.seam_tool_mm
        return (
            f"track of frame {self.frame} at {self.timestamp_s:.3f} s: "
            f"seam y {y_mm:+.3f} ± {self.sigma_y_mm:.3f}, z {z_mm:+.3f} ± {self.sigma_z_mm:.3f} mm in tool\n"
            f"offset y {self.offset_y_mm:+.3f}, z {self.offset_z_mm:+.3f} mm; "
            f"confidence {self.confidence:.2f}; flags: {raised}"
        )

    @property
    def flag_names(self) -> tuple[str, ...]:
        """The names of the flags that are set."""
        return flags.names(self.flags)
