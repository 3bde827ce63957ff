"""recording.toml's keys and types; what the values must be beyond that is said beside the physics.

The physics is imported once the keys are right: it takes seconds, and a misspelt key needs none of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from arctrack.limits import LIMITS, size_problem
from arctrack.printable import shown
from arctrack.recording.key_errors import held, meant_by, place
from noise_model.arc_source import NO_ARC, Arc
from noise_model.arrays import Float64
from noise_model.setup_keys import COEFFICIENTS, DIMENSIONS, Tolerance
from noise_model.spelling import nearest
from tracker.seam.correction import AtLimit, AxisCorrection, Correction, CorrugationPath, WhenLost

if TYPE_CHECKING:
    from noise_model.instrument.camera import Camera
    from noise_model.instrument.spectrum import Filter, FilterCurve
    from noise_model.setup import Setup
    from noise_model.surface.joint import Joint

FORMAT = "joint-tracking-recording/1"
UNITS = "mm, s, deg, e-, DN"
"""The units that a recording states."""

NAMED_IN_KEYS = ("A", "nm", "px")
"""Units that some keys have in their names: a file may state them as well, but no others."""

_USABLE = f"must be a finite number, {LIMITS.value:g} at most"

# One bound for each type: pydantic leaves out that of a field whose type has its own.
Number = Annotated[FiniteFloat, Field(ge=-LIMITS.value, le=LIMITS.value)]
Focal = Annotated[FiniteFloat, Field(ge=LIMITS.least_focal_px, le=LIMITS.focal_px)]
Center = Annotated[FiniteFloat, Field(ge=-LIMITS.center_px, le=LIMITS.center_px)]
Distortion = Annotated[FiniteFloat, Field(ge=-LIMITS.distortion, le=LIMITS.distortion)]
InTool = Annotated[FiniteFloat, Field(ge=-LIMITS.tool_mm, le=LIMITS.tool_mm)]
InBase = Annotated[FiniteFloat, Field(ge=-LIMITS.length_mm, le=LIMITS.length_mm)]
Gamma = Annotated[FiniteFloat, Field(ge=LIMITS.least_gamma, le=LIMITS.gamma)]
Current = Annotated[FiniteFloat, Field(ge=LIMITS.least_current_a, le=LIMITS.current_a)]
PointInTool = Annotated[list[InTool], Field(min_length=3, max_length=3)]
PointInBase = Annotated[list[InBase], Field(min_length=3, max_length=3)]
Vector3 = Annotated[list[Number], Field(min_length=3, max_length=3)]
Vector4 = Annotated[list[Number], Field(min_length=4, max_length=4)]
Distortions = Annotated[list[Distortion], Field(min_length=min(COEFFICIENTS), max_length=max(COEFFICIENTS))]


class Table(BaseModel):
    """A table of the file: strict types, unknown keys kept."""

    model_config = ConfigDict(strict=True, extra="allow")


class RigidPoseTable(Table):
    """A rigid pose: translation in mm, quaternion x y z w."""

    translation_mm: PointInTool
    quaternion_xyzw: Vector4

    def matrix(self, place: str) -> Float64:
        """Return the pose as a 4x4 matrix; ValueError names `place` if it is no rotation."""
        from noise_model.transforms import pose_matrix

        try:
            return pose_matrix(self.translation_mm, self.quaternion_xyzw)
        except ValueError as error:
            raise ValueError(f"[{place}] quaternion_xyzw: {error}") from None


class CameraTable(Table):
    """[camera]."""

    width: int = Field(le=LIMITS.side_px)
    height: int = Field(le=LIMITS.side_px)
    fx: Focal
    fy: Focal
    cx: Center
    cy: Center
    distortion: Distortions
    focal_length_mm: Number
    f_number: Number
    psf_sigma_px: FiniteFloat = Field(le=LIMITS.blur_px)
    exposure_s: Number
    pixel_format: str
    pose_in_tool: RigidPoseTable


class SensorTable(Table):
    """[sensor]."""

    bits: int
    gain_e_per_dn: Number
    black_level_dn: FiniteFloat = Field(ge=-LIMITS.black_dn, le=LIMITS.black_dn)
    read_noise_e: Number
    full_well_e: Number
    gamma: Gamma


class FilterTable(Table):
    """[filter]; a measured curve, where there is one, stands in for centre and width."""

    center_nm: Number
    fwhm_nm: Number
    effective_index: Number
    curve_wavelength_nm: list[Number] | None = None
    curve_transmission: list[Number] | None = None

    def to_filter(self) -> Filter | FilterCurve:
        """Return the filter; ValueError names the key of a curve that cannot be."""
        from noise_model.instrument.spectrum import CurveError, Filter, FilterCurve

        wavelengths, transmission = self.curve_wavelength_nm, self.curve_transmission
        if wavelengths is None and transmission is None:
            return Filter(self.center_nm, self.fwhm_nm, self.effective_index)
        if wavelengths is None or transmission is None:
            raise ValueError(
                "[filter] curve_wavelength_nm, curve_transmission: one is given without the other"
            )
        try:
            return FilterCurve(np.array(wavelengths), np.array(transmission), self.effective_index)
        except CurveError as error:
            raise ValueError(f"[filter] curve_wavelength_nm, curve_transmission: {error}") from None


class LaserTable(Table):
    """[laser]."""

    wavelength_nm: Number
    plane_in_tool: Vector4
    origin_in_tool_mm: PointInTool
    stripe_sigma_mm: Number
    peak_e: Number
    fan_half_angle_deg: Number | None = None


class ArcTable(Table):
    """[arc]."""

    shape: str
    radius_mm: FiniteFloat = Field(le=LIMITS.arc_radius_mm)
    center_in_tool_mm: PointInTool
    on_surface: bool
    radiance_e: Number
    current_a: Current
    current_exponent: FiniteFloat = Field(ge=-LIMITS.current_exponent, le=LIMITS.current_exponent)

    def to_arc(self) -> Arc:
        """Return the arc; ValueError names the key of a value that cannot be."""
        if not self.radiance_e > 0.0:
            raise ValueError(f"[arc] radiance_e = {self.radiance_e}: must be > 0; leave [arc] out for no arc")
        return Arc(**{**_known(self), "center_in_tool_mm": _three(self.center_in_tool_mm)})


class MaterialTable(Table):
    """[material]."""

    name: str
    kappa_diff: Number
    kappa_spec: Number
    c2: Number


class JointTable(Table):
    """[joint]; the dimensions are extra keys, which ones depends on the type."""

    type: str
    seam_in_base_mm: list[PointInBase]
    surface_normal_in_base: Vector3

    def to_joint(self) -> Joint:
        """Return the joint; ValueError names the key of a value that cannot be."""
        from noise_model.surface.joint import Joint

        return Joint(
            type=self.type,
            dimensions=self.dimensions(),
            seam_in_base_mm=tuple(_three(point) for point in self.seam_in_base_mm),
            surface_normal_in_base=_three(self.surface_normal_in_base),
        )

    def dimensions(self) -> dict[str, float]:
        """Return the dimensions that this type of joint needs and the file gives."""
        sizes: dict[str, float] = {}
        for name in DIMENSIONS.get(self.type, ()):
            extras = self.model_extra or {}
            value = extras.get(name)
            if value is None:
                hint = meant_by(name, (key for key in extras if key not in DIMENSIONS[self.type]))
                raise ValueError(f"[joint] {name}: missing, a {self.type} needs it{hint}")
            least = LIMITS.least_pitch_mm if name == "pitch_mm" else -LIMITS.tool_mm
            if not (_is_usable(value) and least <= value <= LIMITS.tool_mm):
                raise ValueError(
                    f"{held(f'[joint] {name}', value)}: must be a finite number from {least:g} to "
                    f"{LIMITS.tool_mm:g}"
                )
            sizes[name] = float(value)
        return sizes


class ToleranceTable(Table):
    """[tolerance], every key optional."""

    arc_level_rel: Number = Tolerance.arc_level_rel
    laser_level_rel: Number = Tolerance.laser_level_rel
    hand_eye_deg: Number = Tolerance.hand_eye_deg
    hand_eye_mm: Number = Tolerance.hand_eye_mm
    black_level_dn: Number = Tolerance.black_level_dn
    read_noise_rel: Number = Tolerance.read_noise_rel
    seam_mm: Number = Tolerance.seam_mm


class FollowAxisTable(Table):
    """[follow.y] and [follow.z], every key optional; without a limit only the gate bounds the axis."""

    enable: bool = AxisCorrection.enable
    gain: Number = AxisCorrection.gain
    bias_mm: Number = AxisCorrection.bias_mm
    limit_mm: Number | None = None
    at_limit: AtLimit = AxisCorrection.at_limit

    def to_axis(self, place: str) -> AxisCorrection:
        """Return the axis; ValueError names `place` and the key of a value that cannot be."""
        values = {name: value for name, value in _known(self).items() if value is not None}
        try:
            return AxisCorrection(**values)
        except ValueError as error:
            raise ValueError(f"[{place}] {error}") from None


class FollowTable(Table):
    """[follow], every key optional."""

    when_lost: WhenLost = Correction.when_lost
    extrapolate_mm: Number = Correction.extrapolate_mm
    extrapolate_sigma_mm: Number = Correction.extrapolate_sigma_mm
    ends_mm: Number = Correction.ends_mm
    corrugation: CorrugationPath = Correction.corrugation
    y: FollowAxisTable = Field(default_factory=FollowAxisTable)
    z: FollowAxisTable = Field(default_factory=FollowAxisTable)

    def to_correction(self) -> Correction:
        """Return the correction; ValueError names the table and key of a value that cannot be."""
        axes = {"y": self.y.to_axis("follow.y"), "z": self.z.to_axis("follow.z")}
        return Correction(**{**_known(self), **axes})


class RobotTable(Table):
    """[robot], optional: what is particular to the controller."""

    controllertool_to_tool: RigidPoseTable | None = None
    can_channel: str | int | None = None


class CalibrationTable(Table):
    """[calibration.NAME]: how well a calibration knows its parameters; any other key is a remark."""

    parameters: list[str]
    sigma: list[Number]
    covariance: list[list[Number]]

    def matrix(self, place: str) -> Float64:
        """Return the covariance (n, n); ValueError names `place` if it has other rows than parameters."""
        n = len(self.parameters)
        if len(self.covariance) != n or any(len(row) != n for row in self.covariance):
            raise ValueError(
                f"[{place}] covariance: must have {n} rows of {n} numbers, one for each of its parameters; "
                "calibrate anew, or leave the table out"
            )
        return np.array(self.covariance, dtype=np.float64).reshape(n, n)


class RecordingToml(Table):
    """The whole file."""

    format: Literal["joint-tracking-recording/1"]
    units: str
    camera: CameraTable
    sensor: SensorTable
    filter: FilterTable | None = None
    laser: LaserTable
    arc: ArcTable | None = None
    material: MaterialTable | None = None
    joint: JointTable
    tolerance: ToleranceTable = Field(default_factory=ToleranceTable)
    follow: FollowTable = Field(default_factory=FollowTable)
    robot: RobotTable | None = None
    calibration: dict[str, CalibrationTable] = Field(default_factory=dict)
    effects: dict[str, Any] = Field(default_factory=dict)

    def to_setup(self) -> Setup:
        """Return the typed setup; ValueError names the table and key of a value that cannot be."""
        from noise_model.effects import checked
        from noise_model.instrument.laser import Laser
        from noise_model.instrument.sensor import Sensor
        from noise_model.setup import Setup
        from noise_model.surface.brdf import UNSTATED_METAL, Material

        known = *_units(UNITS), *NAMED_IN_KEYS
        if any(unit not in known for unit in _units(self.units)):
            raise ValueError(f"{held('units', self.units)}: must be of {UNITS}; convert the file's values")
        joint = self.joint.to_joint()
        stated = Setup(
            camera=self._camera(),
            sensor=Sensor(**_known(self.sensor)),
            laser=Laser(
                wavelength_nm=self.laser.wavelength_nm,
                plane_in_tool=_four(self.laser.plane_in_tool),
                origin_in_tool_mm=_three(self.laser.origin_in_tool_mm),
                stripe_sigma_mm=self.laser.stripe_sigma_mm,
                peak_e=self.laser.peak_e,
                fan_half_angle_deg=self.laser.fan_half_angle_deg,
            ),
            joint=joint,
            filter=None if self.filter is None else self.filter.to_filter(),
            arc=NO_ARC if self.arc is None else self.arc.to_arc(),
            material=UNSTATED_METAL if self.material is None else Material(**_known(self.material)),
            tolerance=Tolerance(**_known(self.tolerance)),
        )
        return replace(stated, effects=checked(self._known_effects(), joint, stated.missing))

    def _known_effects(self) -> dict[str, dict[str, float]]:
        """Return the effects that are known, with their parameters that are; ValueError if they hold else."""
        from noise_model.effects import REGISTRY

        known: dict[str, dict[str, float]] = {}
        for name, table in self.effects.items():
            if name not in REGISTRY:
                continue
            if not isinstance(table, dict):
                raise ValueError(f"[effects] {name} = {shown(table)}: must be a table, [effects.{name}]")
            known[name] = {key: table[key] for key in REGISTRY[name].neutral if key in table}
            for key, value in known[name].items():
                if not _is_usable(value):
                    raise ValueError(f"{held(f'[effects.{name}] {key}', value)}: {_USABLE}")
        return known

    def _camera(self) -> Camera:
        from noise_model.instrument.camera import Camera

        problem = size_problem(self.camera.width, self.camera.height)
        if problem is not None:
            raise ValueError(f"[camera] width, height: {problem}")
        values = _known(self.camera)
        del values["pose_in_tool"]
        values["distortion"] = tuple(self.camera.distortion)
        T_tool_camera = self.camera.pose_in_tool.matrix("camera.pose_in_tool")
        return Camera(T_tool_camera=T_tool_camera, **values)


def _units(text: str) -> list[str]:
    return [unit.strip() for unit in text.split(",")]


def _is_usable(value: Any) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) <= LIMITS.value


def unknown_keys(model: RecordingToml) -> dict[str, str | None]:
    """Return the keys that mean nothing here, as `[table] key`, each with the known key nearest to it."""
    from noise_model.effects import REGISTRY

    unknown = {place(location): near for location, near in _unknown(model, ())}
    for name, table in model.effects.items():
        if name not in REGISTRY:
            key = f"[effects.{name}]" if isinstance(table, dict) else f"[effects] {name}"
            unknown[key] = nearest(name, REGISTRY)
            continue
        parameters = REGISTRY[name].neutral
        unknown |= {
            f"[effects.{name}] {key}": nearest(key, parameters) for key in table if key not in parameters
        }
    return unknown


def _unknown(
    table: Table, location: tuple[str | int, ...]
) -> Iterator[tuple[tuple[str | int, ...], str | None]]:
    extras = table.model_extra or {}
    known = {*type(table).model_fields}
    if isinstance(table, JointTable):
        known |= {*DIMENSIONS.get(table.type, ())}
    for name in extras:
        if name not in known:
            yield (*location, name), nearest(name, known)
    for name in type(table).model_fields:
        value = getattr(table, name)
        if isinstance(value, Table):
            yield from _unknown(value, (*location, name))


def _known(table: Table) -> dict[str, Any]:
    return {name: getattr(table, name) for name in type(table).model_fields}


def _three(values: list[float]) -> tuple[float, float, float]:
    return (values[0], values[1], values[2])


def _four(values: list[float]) -> tuple[float, float, float, float]:
    return (values[0], values[1], values[2], values[3])
