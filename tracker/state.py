"""Inputs and outputs of a step, and the frozen state that it hands on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Bool, Float64, Integers
from noise_model.setup import Setup
from tracker import flags
from tracker.checks import Check

NAN = math.nan

Pair = tuple[float, float]
UNKNOWN: Pair = (math.nan, math.nan)


class JointShape(NamedTuple):
    """Shape of the joint's section other than seam point, gap and mismatch; NaN where it has none.

    Pairs are (left, right).

    Attributes
    ----------
    gap_sigma_mm, mismatch_sigma_mm : float
        1 sigma of the track's gap and mismatch, mm.
    bevel_angles_deg : tuple (2,)
        Each bevel's angle from upright, degrees, joint frame.
    bevel_sigmas_deg : tuple (2,)
        1 sigma of `bevel_angles_deg`, degrees.
    plate_angles_deg : tuple (2,)
        The angle of each plate, or sheet, from level, degrees; positive where it rises to the left.
    plate_sigmas_deg : tuple (2,)
        1 sigma of `plate_angles_deg`, degrees.
    area_mm2 : float
        The opening below the line from one plate's edge to the other's, mm^2. Of a butt joint it is the gap
        times the stated thickness.
    area_sigma_mm2 : float
        1 sigma of `area_mm2`, mm^2.
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
    """One raw frame and the condition it was taken under.

    Parameters
    ----------
    index : int
        The frame's number.
    timestamp_s : float
        The middle of the exposure, s, on the poses' clock.
    image_dn : array (H, W)
        Grey levels as the sensor gave them, DN, uint8 or uint16.
    exposure_s : float
        The exposure, s.
    current_a : float
        The welding current, A; NaN where nobody knows it.
    laser_on, arc_on : bool
        Whether laser and arc were on.
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
    """Return the misfit of an image's shape, (H, W) if right, and type to a setup; None if it fits."""
    camera, sensor, wanted = setup.camera, setup.sensor, setup.frame_shape
    if setup.profiler is not None and (shape, np.dtype(dtype)) != (wanted, np.dtype(sensor.dtype)):
        held = " x ".join(map(str, shape))
        return f"holds {held} {np.dtype(dtype)}: a profile of {wanted[0]} x {wanted[1]} uint16 is needed"
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
    """The tool's pose at a frame's time.

    Parameters
    ----------
    T_base_tool : array (4, 4)
        It takes points of the tool frame to base, mm.
    extrapolated : bool
        Whether no later pose was known.
    """

    T_base_tool: Float64
    extrapolated: bool = False

    def __repr__(self) -> str:
        x_mm, y_mm, z_mm = self.T_base_tool[:3, 3]
        tilt_deg = math.degrees(math.acos(np.clip(self.T_base_tool[2, 2], -1.0, 1.0)))
        how = ", extrapolated" if self.extrapolated else ""
        place = f"({x_mm:.2f}, {y_mm:.2f}, {z_mm:.2f}) mm in base"
        return f"Pose(tool at {place}, {tilt_deg:.1f} deg off its z{how})"


class OffsetLookAhead(NamedTuple):
    """Look-ahead of the offset: it is computed for where the torch will be once the correction acts.

    `time_s` is from the capture until then, `way_mm` the torch's travel along the seam meanwhile.
    """

    time_s: float = 0.0
    way_mm: float = 0.0


AT_ONCE = OffsetLookAhead()
"""The offset of where the torch is at the capture."""


CENTRE_PX, AMPLITUDE_E, WIDTH_PX, OWN_PX = range(4)
Y_MM, Z_MM, DY_MM, DZ_MM, SCAN, SIGMA_PX, BESIDE_PX, BIAS_PX, MISFIT_PX, N_LINES = range(10)
N_ROWS = 10
"""The rows of an array of a stripe's scan lines, and of the points that these become.

Of a line, px and e-: centre, amplitude, 1 sigma across the stripe, the centre's 1 sigma by photons alone. Of
a point, mm: y and z in the joint frame, a corrugation's height taken off z, and how it moves when its centre
moves by 1 px. Of both: the scan line; the centre's 1 sigma; that with which it counts among neighbours; by
how much it was corrected for light that is no bell; the 1 sigma that unexpected light adds to neighbours in
common; for how many scan lines it stands. Two lines that were read as one are a point between them.
"""


class Stripe(NamedTuple):
    """The stripe of one frame, scan line by scan line; the joint is fitted to `position_px`.

    The scan lines are the image's columns if the stripe runs along its rows, else its rows. Where the surface
    is smooth two are read as one (`tracker.stripe.neighbours`). Both have its centre, moved along the stripe,
    and its 1 sigma; for the joint's fit they are one point. `tracker.stripe.smooth.smoothed` smooths centres
    with their neighbours.

    Attributes
    ----------
    position_px : array (n,)
        The stripe's centre on each scan line, px; NaN where there is no stripe.
    sigma_px : array (n,)
        1 sigma of `position_px`, px.
    amplitude_e : array (n,)
        The stripe's peak over the background, e-.
    saturated : array (n,)
        Where pixels of the stripe were saturated.
    along_rows : bool
        Whether the stripe runs along the image's rows.
    beside_px : array (n,)
        The 1 sigma with which each centre counts among its neighbours, px. Speckle's grains reach over a few
        lines, and correlate neighbours' errors. Either of two lines that were read as one counts so.
    """

    position_px: Float64
    sigma_px: Float64
    amplitude_e: Float64
    saturated: Bool
    along_rows: bool
    beside_px: Float64


@dataclass(frozen=True)
class Track:
    """The result of one frame; what is not known is NaN, with a flag that says why.

    Attributes
    ----------
    frame : int
        The frame's number.
    timestamp_s : float
        The middle of its exposure, s.
    flags : int
        The flags that are set, as bits; `flag_names` names them.
    seam_tool_mm : tuple (3,)
        The seam point in the laser plane, mm, tool frame.
    sigma_y_mm, sigma_z_mm : float
        1 sigma of the seam point across the seam and along the surface normal, mm. They include the
        calibration's error.
    offset_y_mm, offset_z_mm : float
        The correction at the torch, mm, joint frame: the seam's displacement from the programmed path, as
        gain, bias and limit of `Correction` change it.
    offset_sigma_y_mm, offset_sigma_z_mm : float
        1 sigma of the seam's displacement at the torch, mm.
    offset_confidence : float
        The probability that the displacement at the torch is known within the weld's tolerance, `seam_mm`. It
        includes the calibration's error.
    valid_at_s : float
        The time at which the offset holds, s: that of the capture, or once the correction acts.
    gap_mm, mismatch_mm : float
        The joint's gap and mismatch, mm.
    confidence : float
        The probability that the seam point is known within the weld's tolerance.
    joint_start_mm, joint_end_mm : tuple (2,)
        Station and 1 sigma of the joint's start and end, mm, where they were found.
    arc_level : float
        The arc's output over the output that the setup expects for the frame's current and exposure. Known
        only where the frame is said to have an arc, or shows one.
    arc_level_sigma : float
        1 sigma of `arc_level`; the arc map's own error is in it.
    map_misfit : float
        The residual of the arc map over its stated uncertainty, by a robust measure; 1 or less where the map
        is right.
    fov_margin_mm : float
        How far the seam point lies inside the nearer end of the profile, mm; negative beyond it.
    shape : JointShape
        What else the section shows.
    stripe : Stripe or None
        The stripe that was read, px.
    checks : sequence of Check
        Every check of the frame, in the order in which the step made them.
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
    arc_level_sigma: float = NAN
    map_misfit: float = NAN
    fov_margin_mm: float = NAN
    shape: JointShape = NO_SHAPE
    stripe: Stripe | None = field(default=None, repr=False)
    checks: Sequence[Check] = field(default=(), repr=False)

    @property
    def valid(self) -> bool:
        """True if the seam point may be used."""
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
