"""The whole nominal setup: each part is defined next to its physics and put together here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from noise_model.arc_source import NO_ARC, Arc
from noise_model.calibration_errors import (
    POSE,
    CalibrationCovariance,
    camera_with_errors,
    laser_with_errors,
)
from noise_model.instrument.camera import Camera
from noise_model.instrument.laser import Laser
from noise_model.instrument.profiler import Profiler
from noise_model.instrument.sensor import Sensor
from noise_model.instrument.spectrum import Filter, FilterCurve
from noise_model.setup_keys import Tolerance
from noise_model.surface.brdf import UNSTATED_METAL, Material
from noise_model.surface.joint import Joint
from noise_model.transforms import moved


@dataclass(frozen=True)
class Setup:
    """Sensor, light and part as known before the first frame.

    Parameters
    ----------
    camera : Camera
        Image size, lens and pose, px and mm.
    sensor : Sensor
        How charge becomes grey levels, e- and DN.
    laser : Laser
        The laser sheet, mm, tool frame.
    joint : Joint
        The joint's type, dimensions and seam line, mm, base frame.
    filter : Filter, FilterCurve or None
        The interference filter, nm; None where none is stated: laser and arc pass equally all the same.
    arc : Arc
        The arc's place, size and brightness, mm and e-, tool frame; `NO_ARC` where none is stated.
    material : Material
        The metal's reflectance, 1/sr; `UNSTATED_METAL` where none is stated.
    tolerance : Tolerance
        How well the values above are known.
    effects : mapping
        Effects that are known to act: parameters by name, by the effect's id (`noise_model.effects`).
    calibration : CalibrationCovariance or None
        The joint covariance of lens, camera pose and sheet; None where only tolerances are stated.
    profiler : Profiler or None
        The laser profiler to which camera, sensor and laser amount; None of a camera that gives images.

    Raises
    ------
    ValueError
        For an arc over a free joint: its light is not predicted there.
    """

    camera: Camera
    sensor: Sensor
    laser: Laser
    joint: Joint
    filter: Filter | FilterCurve | None = None
    arc: Arc = NO_ARC
    material: Material = UNSTATED_METAL
    tolerance: Tolerance = field(default_factory=Tolerance)
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    calibration: CalibrationCovariance | None = None
    profiler: Profiler | None = None

    @property
    def frame_shape(self) -> tuple[int, int]:
        """A frame's shape: rows and columns of an image; codes, intensities and sigmas of a profile."""
        if self.profiler is None:
            return self.camera.height, self.camera.width
        return (3 if self.profiler.point_sigma else 2), self.profiler.columns

    @property
    def calibration_errors(self) -> CalibrationCovariance:
        """The joint covariance of lens, camera pose and sheet, as calibrated or by the tolerance."""
        return self.calibration or CalibrationCovariance.of_tolerance(self.tolerance)

    def with_errors(self, errors: Mapping[str, float]) -> Setup:
        """Return the setup whose camera and sheet are off by errors, by name; others are left out.

        A profiler is one body: its pose is off, with camera and sheet.
        """
        if self.profiler is not None:
            off = [errors.get(name, 0.0) for name in POSE]
            T_tool_profile = moved(self.profiler.T_tool_profile, off[:3], off[3:])
            profiler = replace(self.profiler, T_tool_profile=T_tool_profile)
            return replace(self, profiler=profiler, camera=profiler.camera, laser=profiler.laser)
        return replace(
            self,
            camera=camera_with_errors(self.camera, errors),
            laser=laser_with_errors(self.laser, errors),
        )

    def __post_init__(self) -> None:
        if self.joint.type == "free" and self.arc.shines:
            raise ValueError("[arc]: leave it out, its light is not predicted on the section of a free joint")

    @property
    def missing(self) -> tuple[str, ...]:
        """Those of `arc`, `filter` and `material` that are not stated."""
        is_stated = {
            "arc": self.arc.shines,
            "filter": self.filter is not None,
            "material": self.material != UNSTATED_METAL,
        }
        return tuple(name for name, stated in is_stated.items() if not stated)

    def require(self, purpose: str, *sections: str) -> None:
        """Raise ValueError if one of the sections that a purpose needs is missing."""
        missing = [f"[{name}]" for name in self.missing if name in sections]
        if missing:
            are, them = ("is", "it") if len(missing) == 1 else ("are", "them")
            raise ValueError(
                f"{', '.join(missing)} {are} missing: {purpose} needs {them}; state {them}, "
                "arctrack new writes an example"
            )

    @property
    def stated_filter(self) -> Filter | FilterCurve:
        """The filter; ValueError where none is stated."""
        self.require("light off the axis", "filter")
        assert self.filter is not None
        return self.filter

    def __str__(self) -> str:
        known = f"; known effects: {', '.join(self.effects)}" if self.effects else ""
        return (
            f"{self.joint}\nof {self.material}{known}\n"
            f"camera {self.camera.width} x {self.camera.height} px, {self.sensor.bits} bit, "
            f"{1000 * self.camera.exposure_s:g} ms; laser {self.laser.wavelength_nm:g} nm; "
            f"{f'arc {self.arc.current_a:g} A' if self.arc.shines else 'no arc'}"
        )


def require_setup(setup: object) -> Setup:
    """Return a setup as it is; TypeError says how to come to one from what was given instead."""
    if isinstance(setup, Setup):
        return setup
    kind = type(setup).__name__
    if isinstance(getattr(setup, "setup", None), Setup):
        raise TypeError(f"a Setup is needed, not a {kind}: give its .setup")
    raise TypeError(f"a Setup is needed, not a {kind}: read_setup_file(path).setup is one")
