"""recording.toml as a whole; what the values must be beyond their bounds is said beside the physics.

The physics is imported once the keys are right: it takes seconds, and a misspelt key needs none of it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from arctrack.limits import size_problem
from arctrack.printable import shown
from arctrack.recording import scene_tables as scene
from arctrack.recording import sensor_tables as sensors
from arctrack.recording.follow_tables import FollowTable
from arctrack.recording.key_errors import held, place
from arctrack.recording.schema import MAX_NUMBER, Table, key, unknown_in
from arctrack.recording.setup_writer import GEOMETRY, UNITS
from noise_model.arc_source import NO_ARC
from noise_model.compiled.arrays import Float64
from noise_model.setup_keys import Tolerance
from noise_model.spelling import nearest

if TYPE_CHECKING:
    from noise_model.calibration_errors import CalibrationCovariance
    from noise_model.instrument.camera import Camera
    from noise_model.setup import Setup


class RobotTable(Table):
    """The robot's controller: its tool frame and its channel."""

    controllertool_to_tool: sensors.RigidPoseTable | None = None
    can_channel: str | int | None = key(
        "The robot's channel, as a CAN log names it, where several are heard", default=None
    )


class CalibrationTable(Table):
    """The uncertainty of a calibration's result; any other key is a remark."""

    parameters: list[str] = key("The keys whose values it found")
    sigma: list[sensors.Number] = key("Their 1 sigma")
    covariance: list[list[sensors.Number]] = key("Their covariance, a row for each")

    @property
    def names(self) -> set[str]:
        """All of its keys."""
        return super().names | {*(self.model_extra or {})}

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

    format: Literal["joint-tracking-recording/1"] = key("The file's format")
    units: str = key(
        f'The units of the whole file, "{UNITS}" or some of these', note="Other units are not converted."
    )
    camera: sensors.CameraTable
    sensor: sensors.SensorTable
    filter: sensors.FilterTable | None = None
    laser: sensors.LaserTable
    arc: scene.ArcTable | None = None
    material: scene.MaterialTable | None = None
    joint: scene.JointTable
    tolerance: scene.ToleranceTable = Field(default_factory=scene.ToleranceTable)
    follow: FollowTable = Field(default_factory=FollowTable)
    robot: RobotTable | None = None
    calibration: dict[str, CalibrationTable] = Field(default_factory=dict)
    effects: dict[str, Any] = Field(default_factory=dict)

    def to_setup(self) -> Setup:
        """Return the typed setup; ValueError names the table and key of a value that cannot be."""
        from noise_model.effects import checked
        from noise_model.setup import Setup
        from noise_model.surface.brdf import UNSTATED_METAL, Material

        # Some keys have units of their own in their names: a file may state these as well.
        known = *_units(UNITS), "A", "nm", "px"
        if any(unit not in known for unit in _units(self.units)):
            raise ValueError(f"{held('units', self.units)}: must be of {UNITS}; convert the file's values")
        joint = self.joint.to_joint()
        stated = Setup(
            **self._instrument(),
            joint=joint,
            filter=None if self.filter is None else self.filter.to_filter(),
            arc=NO_ARC if self.arc is None else self.arc.to_arc(),
            material=UNSTATED_METAL if self.material is None else Material(**self.material.known),
            tolerance=Tolerance(**self.tolerance.known),
            calibration=self._calibration(),
        )
        return replace(stated, effects=checked(self._known_effects(), joint, stated.missing))

    def _calibration(self) -> CalibrationCovariance | None:
        """Return the joint covariance of lens, camera pose and sheet; ValueError if it is none."""
        from noise_model.calibration_errors import CalibrationCovariance

        if GEOMETRY not in self.calibration:
            return None
        place = f"calibration.{GEOMETRY}"
        table = self.calibration[GEOMETRY]
        matrix = table.matrix(place)
        try:
            return CalibrationCovariance.of(table.parameters, matrix)
        except ValueError as error:
            raise ValueError(f"[{place}] {error}; calibrate anew, or leave the table out") from None

    def _known_effects(self) -> dict[str, dict[str, float]]:
        """Return the effects that are known, with their parameters that are; ValueError if they hold else."""
        from noise_model.effects import REGISTRY

        known: dict[str, dict[str, float]] = {}
        for name, table in self.effects.items():
            if name not in REGISTRY:
                continue
            if not isinstance(table, dict):
                raise ValueError(f"[effects] {name} = {shown(table)}: must be a table, [effects.{name}]")
            known[name] = {part: table[part] for part in REGISTRY[name].neutral if part in table}
            for part, value in known[name].items():
                if not scene.is_number(value):
                    where = held(f"[effects.{name}] {part}", value)
                    raise ValueError(f"{where}: must be a finite number, {MAX_NUMBER:g} at most")
        return known

    def _instrument(self) -> dict[str, Any]:
        """Return the setup's fields for camera, sensor and laser."""
        from noise_model.instrument.laser import Laser
        from noise_model.instrument.sensor import Sensor

        n_x, n_y, n_z, d_mm = self.laser.plane_in_tool
        laser = Laser(
            wavelength_nm=self.laser.wavelength_nm,
            plane_in_tool=(n_x, n_y, n_z, d_mm),
            origin_in_tool_mm=scene.three(self.laser.origin_in_tool_mm),
            stripe_sigma_mm=self.laser.stripe_sigma_mm,
            peak_e=self.laser.peak_e,
            fan_half_angle_deg=self.laser.fan_half_angle_deg,
            bow=self.laser.bow,
        )
        return {"camera": self._camera(), "sensor": Sensor(**self.sensor.known), "laser": laser}

    def _camera(self) -> Camera:
        from noise_model.instrument.camera import Camera

        problem = size_problem(self.camera.width, self.camera.height)
        if problem is not None:
            raise ValueError(f"[camera] width, height: {problem}")
        values = self.camera.known
        del values["pose_in_tool"]
        values["distortion"] = tuple(self.camera.distortion)
        T_tool_camera = self.camera.pose_in_tool.matrix("camera.pose_in_tool")
        return Camera(T_tool_camera=T_tool_camera, **values)


class ProfilerToml(RecordingToml):
    """The file of a laser profiler, which needs no tables of light: those have no effect."""

    camera: sensors.ProfilerTable  # type: ignore[assignment]
    sensor: None = None  # type: ignore[assignment]
    laser: None = None  # type: ignore[assignment]
    filter: None = None
    arc: None = None
    material: None = None

    def _instrument(self) -> dict[str, Any]:
        """Return the fields for the camera, sensor and laser to which the profiler amounts."""
        from noise_model.instrument.profiler import SENSOR

        profiler = self.camera.to_profiler()
        return {
            "profiler": profiler,
            "camera": profiler.camera,
            "sensor": SENSOR,
            "laser": profiler.laser,
        }


def model_of(content: dict[str, Any]) -> type[RecordingToml]:
    """Return the model of a file's content, by the kind of its camera."""
    camera = content.get("camera")
    return ProfilerToml if isinstance(camera, dict) and "kind" in camera else RecordingToml


def _units(text: str) -> list[str]:
    return [unit.strip() for unit in text.split(",")]


def unknown_keys(model: RecordingToml) -> dict[str, str | None]:
    """Return the keys that mean nothing here, as `[table] key`, each with the known key nearest to it."""
    from noise_model.effects import REGISTRY

    unknown = {place(location): nearest(location[-1], known) for location, known in unknown_in(model)}
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
