"""A laser profiler: its profiles as codes, and the camera, sheet and sensor that it amounts to.

A profiler gives height over place in its laser's sheet. So does a pinhole camera whose optical axis is the
sheet's normal: from a distance D it sees the sheet's points at u = y f / D and v = -z f / D, with D / f the
pitch of the columns, and no perspective within the sheet. A column is a scan line, the height in pitches the
stripe's centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64, Integers
from noise_model.instrument.camera import Camera
from noise_model.instrument.laser import Laser
from noise_model.instrument.sensor import Sensor

NOTHING, LAST_CODE = 0, 65535
"""The code of a column without a height, and the highest one."""

SIGMA_STEP = 2.0**-20
"""Share of the range that one code of a sigma is: a sixteenth of a height's code."""

AWAY_MM = 100.0
"""Distance of the equivalent camera from the sheet: any one gives the same points."""

MAX_ROWS = 16384
"""Most rows of the equivalent image: 16 bits resolve a quarter of a pitch in it."""


@dataclass(frozen=True)
class Profiler:
    """A laser profiler as stated: the grid of its profiles and its pose.

    A profile is an array (2, columns) of uint16: the height's code, 0 for none, and the intensity. Code c is
    the height z = ((c - 1) / 65534 - 1/2) `range_mm`; `pitch_mm` parts the columns. The laser's window stands
    `stand_off_mm` over z = 0. `T_tool_profile` (4, 4), mm, is the pose of the profile's frame: y along the
    columns from their middle, z up, x along the sheet's normal. `sigma_mm` is a height's 1 sigma by itself:
    what it scatters beyond is learned. With `point_sigma` a profile has a third row, each height's own sigma:
    code c is c / 2^20 of `range_mm`, 0 says that `sigma_mm` holds. Raises ValueError for a value out of its
    range; it names the key.
    """

    columns: int
    pitch_mm: float
    range_mm: float
    stand_off_mm: float
    T_tool_profile: Float64
    sigma_mm: float = 0.0
    exposure_s: float = 0.001
    point_sigma: bool = False

    def __post_init__(self) -> None:
        for name in ("pitch_mm", "range_mm", "stand_off_mm", "exposure_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"[camera] {name} = {getattr(self, name)}: must be > 0")
        if not self.sigma_mm >= 0.0:
            raise ValueError(f"[camera] sigma_mm = {self.sigma_mm}: must be >= 0")
        if self.range_mm > MAX_ROWS * self.pitch_mm:
            raise ValueError(f"[camera] range_mm = {self.range_mm:g}: must be {MAX_ROWS} pitch_mm at most")

    @property
    def step_mm(self) -> float:
        """Height of one code, mm."""
        return self.range_mm / (LAST_CODE - 1)

    @property
    def y_mm(self) -> Float64:
        """Places of the columns (n,), mm."""
        return np.asarray((np.arange(self.columns) - 0.5 * (self.columns - 1)) * self.pitch_mm, np.float64)

    def codes(self, z_mm: Float64) -> Integers:
        """Return the codes (n,) of heights (n,), mm; NaN, and what lies beyond the range, has none."""
        exact = np.rint(z_mm / self.step_mm + 0.5 * (LAST_CODE - 1)) + 1.0
        inside = (exact >= 1.0) & (exact <= LAST_CODE)
        return np.where(inside, exact, NOTHING).astype(np.uint16)

    def z_mm(self, codes: Integers) -> Float64:
        """Return the heights (n,) of codes (n,), mm, NaN where there is none."""
        z_mm = (codes - 1.0 - 0.5 * (LAST_CODE - 1)) * self.step_mm
        return np.where(codes == NOTHING, np.nan, z_mm)

    def profile(self, z_mm: Float64, intensity: Float64 | Integers, sigma_mm: Float64 | None) -> Integers:
        """Return the profile (2 or 3, columns) of heights, mm, intensities and sigmas (columns,), mm.

        A sigma is NaN where it is not known. One above a sixteenth of the range counts as that.
        """
        codes = self.codes(z_mm)
        rows = [codes, np.clip(np.rint(np.nan_to_num(intensity)), 0, LAST_CODE).astype(np.uint16)]
        if self.point_sigma:
            own_mm = np.full(self.columns, np.nan) if sigma_mm is None else sigma_mm
            exact = np.rint(own_mm / (SIGMA_STEP * self.range_mm))
            is_known = (codes > NOTHING) & np.isfinite(exact)
            rows.append(np.where(is_known, np.clip(exact, 1, LAST_CODE), NOTHING).astype(np.uint16))
        return np.stack(rows)

    def own_sigmas_mm(self, profile: Integers) -> Float64:
        """Return the sigmas (n,) that a profile (2 or 3, n) has for its heights, mm, NaN where unknown."""
        if not self.point_sigma:
            return np.full(self.columns, np.nan)
        return np.where(profile[2] == NOTHING, np.nan, SIGMA_STEP * self.range_mm * profile[2])

    def rows_px(self, z_mm: Float64) -> Float64:
        """Return the rows (n,) of heights (n,) in the equivalent image, px."""
        return np.asarray(0.5 * (self.camera.height - 1) - z_mm / self.pitch_mm)

    @property
    def camera(self) -> Camera:
        """The equivalent camera: opposite the window, so that it sees what the laser lights."""
        T_profile_camera = np.array(
            [[0.0, 0.0, -1.0, AWAY_MM], [1.0, 0, 0, 0], [0.0, -1.0, 0, self.stand_off_mm], [0, 0, 0, 1.0]]
        )
        height = math.ceil(self.range_mm / self.pitch_mm) + 1
        return Camera(
            width=self.columns,
            height=height,
            fx=AWAY_MM / self.pitch_mm,
            fy=AWAY_MM / self.pitch_mm,
            cx=0.5 * (self.columns - 1),
            cy=0.5 * (height - 1) - self.stand_off_mm / self.pitch_mm,
            T_tool_camera=self.T_tool_profile @ T_profile_camera,
            exposure_s=self.exposure_s,
            pixel_format="mono16",
        )

    @property
    def laser(self) -> Laser:
        """The sheet, from the window down; its brightness plays no part."""
        n_x, n_y, n_z = normal = self.T_tool_profile[:3, 0]
        origin_mm = self.T_tool_profile[:3, 3] + self.stand_off_mm * self.T_tool_profile[:3, 2]
        x, y, z = origin_mm.tolist()
        return Laser(
            wavelength_nm=660.0,
            plane_in_tool=(float(n_x), float(n_y), float(n_z), -float(normal @ origin_mm)),
            origin_in_tool_mm=(x, y, z),
            stripe_sigma_mm=self.pitch_mm,
            peak_e=1.0,
        )


SENSOR = Sensor(bits=16, gain_e_per_dn=1.0, black_level_dn=0.0, read_noise_e=1.0, full_well_e=65535.0)
"""The sensor of a profiler: its codes are no charge."""
