"""Sensor designs: positions of camera and laser relative to the torch, and the setup of such a design.

A design is counted from the stripe's foot, the point of the laser plane on a plate at tool height straight
ahead of the torch. The lens stays and is refocused: the image lies f (1 + m) behind it, so from nearby the
focal length in pixels is longer, and less of a radiance arrives, as through the working f-number N (1 + m).
The laser keeps its power and its distance to the foot. Whatever the user's setup has beyond a design's few
numbers (the camera's roll, a point aimed at next to the foot, a skewed sheet) is carried along, so that a
setup's own design gives that setup back.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from noise_model.compiled.arrays import Float64
from noise_model.instrument.spectrum import (
    MIN_TRANSMISSION,
    ArcSpectrum,
    Filter,
    FilterCurve,
    laser_transmission,
    passed_continuum,
    passed_lines,
    transmission,
)
from noise_model.setup import Setup
from noise_model.stripe import stripe_reference
from noise_model.transforms import transform

PROFILE_NODES = 61

LINE_LEAK = "argon_line_leak"
"""The effect that adds the argon lines to an arc's level that is the continuum's alone."""

CONTINUUM = ArcSpectrum(line_width_nm=0.0)

NOZZLE_HEIGHT_MM = 10.0
"""Height of the torch's nozzle above the plate."""


@dataclass(frozen=True)
class SensorDesign:
    """The few numbers that a user may choose.

    `tilt_deg` of the camera's axis from the plate's normal, >= 0; `azimuth_deg` of the camera about that
    normal as seen from the stripe, 0 ahead (it looks back at the torch), 90 to the left of travel, 180
    behind; `preview_mm` from the torch ahead to the stripe; `stand_off_mm` from the camera to the plate along
    its axis; `lean_deg` of the laser's sheet, its upper end ahead; `filter_fwhm_nm`; `exposure_s`.
    """

    tilt_deg: float
    azimuth_deg: float
    preview_mm: float
    stand_off_mm: float
    lean_deg: float
    filter_fwhm_nm: float
    exposure_s: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.tilt_deg < 85.0:
            raise ValueError(f"tilt {self.tilt_deg:g} deg: must be 0 to below 85")
        if not -85.0 < self.lean_deg < 85.0:
            raise ValueError(f"lean {self.lean_deg:g} deg: must be within 85 deg of upright")
        for name in ("stand_off_mm", "filter_fwhm_nm", "exposure_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} = {getattr(self, name)}: must be > 0 and finite")
        if not (math.isfinite(self.azimuth_deg) and math.isfinite(self.preview_mm)):
            raise ValueError("azimuth_deg, preview_mm: must be finite")

    @property
    def triangulation_deg(self) -> float:
        """Triangulation angle between the camera's axis and the laser's plane, deg."""
        tilt, lean = math.radians(self.tilt_deg), math.radians(self.lean_deg)
        forward = math.sin(tilt) * math.cos(math.radians(self.azimuth_deg))
        return math.degrees(math.asin(abs(forward * math.cos(lean) - math.cos(tilt) * math.sin(lean))))


def design_of(setup: Setup) -> SensorDesign:
    """Read a setup's own design.

    Raises ValueError where the camera does not look down or the laser plane lies along the seam.
    """
    plane = setup.laser.plane
    if abs(plane[0]) < 0.2:
        raise ValueError("[laser] plane_in_tool: the stripe runs along the seam; it must cross it")
    axis, origin = setup.camera.T_tool_camera[:3, 2], setup.camera.T_tool_camera[:3, 3]
    if not (axis[2] < -0.05 and origin[2] > 0.0):
        raise ValueError("[camera.pose_in_tool]: the camera does not look down on the plate")
    # An axis that looks straight down has no azimuth; -180 is 180, and zeros have no sign.
    azimuth_deg = math.degrees(math.atan2(-axis[1], -axis[0])) if axis[2] > -1.0 + 1e-12 else 0.0
    return SensorDesign(
        tilt_deg=math.degrees(math.acos(min(1.0, -axis[2]))),
        azimuth_deg=180.0 if azimuth_deg <= -180.0 + 1e-9 else azimuth_deg + 0.0,
        preview_mm=float(-plane[3] / plane[0]),
        stand_off_mm=float(-origin[2] / axis[2]),
        # The sheet rises along n x y: (-n_z, 0, n_x).
        lean_deg=math.degrees(math.atan2(-plane[2] * np.sign(plane[0]), abs(plane[0]))) + 0.0,
        filter_fwhm_nm=setup.stated_filter.fwhm_nm,
        exposure_s=float(setup.camera.exposure_s),
    )


def clears_torch(design: SensorDesign, torch_radius_mm: float) -> bool:
    """Return True if the camera's axis clears an upright torch of this radius that begins at the nozzle.

    The axis leads from the stripe's foot to the camera; below `NOZZLE_HEIGHT_MM` it may pass the electrode.
    """
    rise = math.cos(math.radians(design.tilt_deg))
    aside = math.sin(math.radians(design.tilt_deg))
    azimuth = math.radians(design.azimuth_deg)
    low, high = NOZZLE_HEIGHT_MM / rise, design.stand_off_mm
    if low >= high or torch_radius_mm == 0.0:
        return True
    # The distance to the torch's axis is least where the way along the plate is -preview cos(azimuth).
    nearest = -design.preview_mm * math.cos(azimuth) / aside if aside > 0.0 else low
    way = aside * min(max(nearest, low), high)
    x, y = design.preview_mm + way * math.cos(azimuth), way * math.sin(azimuth)
    return math.hypot(x, y) > torch_radius_mm


def filter_of(setup: Setup, fwhm_nm: float) -> Filter | FilterCurve:
    """Return the setup's own filter if that is its width, else a Gaussian one about the same centre."""
    own = setup.stated_filter
    return own if fwhm_nm == own.fwhm_nm else Filter(own.center_nm, fwhm_nm, own.effective_index)


def passes_laser(setup: Setup, fwhm_nm: float) -> bool:
    """Return True if a filter of this width, as of `filter_of`, passes the setup's laser on its axis."""
    passed = transmission(filter_of(setup, fwhm_nm), setup.laser.wavelength_nm)
    return bool(passed > MIN_TRANSMISSION)


def magnification(setup: Setup, stand_off_mm: float) -> float:
    """Return m = f / (Z - f) of a thin lens focused on the plate; 1 for what stands closer than 2 f."""
    f = setup.camera.focal_length_mm
    return f / max(stand_off_mm - f, f)


def with_design(setup: Setup, design: SensorDesign, spectrum: ArcSpectrum | None = None) -> Setup:
    """Return the setup that a design makes of the user's: poses, levels, filter, exposure.

    The stripe's charge per irradiance and reflectance stays, times what the filter passes of the laser; the
    arc's goes with what it passes of the arc's light. Both go with 1 / (1 + m)^2, the working aperture's, and
    the focal length in pixels with 1 + m. What effects state in e- stays as it is, and so does the
    distortion. Raises ValueError if the laser would stand below the tool's height or its light does not pass
    the filter.
    """
    spectrum = spectrum or ArcSpectrum()
    own = design_of(setup)
    foot, own_foot = np.array([[d.preview_mm, 0.0, 0.0] for d in (design, own)])
    T_tool_camera = _camera_pose(setup, own, own_foot, design, foot)
    turn = Rotation.from_euler("y", design.lean_deg - own.lean_deg, degrees=True).as_matrix()
    normal = turn @ setup.laser.plane[:3]
    origin = turn @ (setup.laser.origin_mm - own_foot) + foot
    if not origin[2] > 1.0:
        raise ValueError(f"lean {design.lean_deg:g} deg: the laser would stand below the plate")
    optics = filter_of(setup, design.filter_fwhm_nm)
    # What is to come behind the design's filter, as `argon_line_leak`, is no part of the level.
    of_level = CONTINUUM if LINE_LEAK in setup.effects else spectrum
    laser_gain, arc_gain = filter_gains(setup.stated_filter, optics, setup.laser.wavelength_nm, of_level, 0.0)
    longer = (1.0 + magnification(setup, design.stand_off_mm)) / (
        1.0 + magnification(setup, own.stand_off_mm)
    )
    brighter = design.exposure_s / own.exposure_s / longer**2
    made = replace(
        setup,
        camera=replace(
            setup.camera,
            fx=longer * setup.camera.fx,
            fy=longer * setup.camera.fy,
            T_tool_camera=T_tool_camera,
            exposure_s=design.exposure_s,
        ),
        filter=optics,
        laser=replace(
            setup.laser,
            plane_in_tool=(float(normal[0]), float(normal[1]), float(normal[2]), float(-normal @ foot)),
            origin_in_tool_mm=(float(origin[0]), float(origin[1]), float(origin[2])),
        ),
        arc=replace(setup.arc, radiance_e=setup.arc.radiance_e * float(arc_gain) * brighter),
    )
    # A tilted sheet spreads its power over 1 / cos(tilt) of the plate.
    spread = math.cos(math.radians(design.lean_deg)) / math.cos(math.radians(own.lean_deg))
    level = setup.laser.peak_e / stripe_reference(setup) * float(laser_gain) * brighter * spread
    return replace(made, laser=replace(made.laser, peak_e=level * stripe_reference(made)))


def _camera_pose(
    setup: Setup, own: SensorDesign, own_foot: Float64, design: SensorDesign, foot: Float64
) -> Float64:
    """Return T_tool_camera of a design, with the roll and the aim that the setup's camera has."""
    T_tool_camera = setup.camera.T_tool_camera
    roll = _axes(own).T @ T_tool_camera[:3, :3]
    aim = transform(T_tool_camera, np.array([0.0, 0.0, own.stand_off_mm])) - own_foot
    T_made = np.eye(4)
    T_made[:3, :3] = _axes(design) @ roll
    T_made[:3, 3] = foot + aim - design.stand_off_mm * T_made[:3, 2]
    return T_made


def _axes(design: SensorDesign) -> Float64:
    """Return a camera's axes (3, 3) in the tool for a design, the stripe along its rows."""
    tilt, azimuth = math.radians(design.tilt_deg), math.radians(design.azimuth_deg)
    z_axis = -np.array(
        [math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)]
    )
    x_axis = -np.array([0.0, 1.0, 0.0]) + z_axis[1] * z_axis
    x_axis /= np.linalg.norm(x_axis)
    return np.column_stack([x_axis, np.cross(z_axis, x_axis), z_axis])


def gains_over_effects(
    setup: Setup, optics: Filter | FilterCurve, spectrum: ArcSpectrum, theta: npt.ArrayLike
) -> tuple[Float64, Float64]:
    """Return `filter_gains` of a filter for light that has met the setup's effects behind the setup's own.

    Where they are with `argon_line_leak` the arc's light holds the lines that pass the setup's filter at
    theta already, (B + L) / B of a level that is the continuum's: what another filter passes is set against
    those.
    """
    own, laser_nm = setup.stated_filter, setup.laser.wavelength_nm
    leak = setup.effects.get(LINE_LEAK)
    if leak is None:
        return filter_gains(own, optics, laser_nm, spectrum, theta)
    leaking = replace(spectrum, line_width_nm=leak.get("line_width_nm", 0.0))
    laser, arc = filter_gains(own, optics, laser_nm, leaking, theta)
    _, held = filter_gains(own, own, laser_nm, leaking, theta)
    _, continuum = filter_gains(own, own, laser_nm, CONTINUUM, theta)
    return laser, arc / held * continuum


def filter_gains(
    stated: Filter | FilterCurve,
    optics: Filter | FilterCurve,
    laser_nm: float,
    spectrum: ArcSpectrum,
    theta: npt.ArrayLike,
) -> tuple[Float64, Float64]:
    """Return a filter's transmission of laser and arc at field angles theta (...,), over that of `stated`.

    theta in rad; `stated` is the filter that the setup's levels belong to, met on the axis; of the arc pass
    continuum and lines. Off the axis the passband moves to shorter wavelengths and leaves the laser behind,
    the sooner the narrower it is: without that the narrowest filter would always be the best.
    """
    angles, laser, arc = _profile(stated, optics, laser_nm, spectrum)
    theta = np.asarray(theta, dtype=np.float64)
    return np.interp(theta, angles, laser), np.interp(theta, angles, arc)


@functools.lru_cache(maxsize=64)
def _profile(
    stated: Filter | FilterCurve, optics: Filter | FilterCurve, laser_nm: float, spectrum: ArcSpectrum
) -> tuple[Float64, Float64, Float64]:
    # Largest angle from the axis, rad, at which a filter's passband is computed.
    angles = np.linspace(0.0, 0.6, PROFILE_NODES)

    def passed(glass: Filter | FilterCurve, theta: Float64) -> Float64:
        return passed_continuum(glass, spectrum, theta) + passed_lines(glass, spectrum, theta)

    on_axis = float(transmission(optics, laser_nm)) / float(transmission(stated, laser_nm))
    laser = on_axis * laser_transmission(optics, laser_nm, angles)
    return angles, laser, passed(optics, angles) / passed(stated, np.zeros(1))
