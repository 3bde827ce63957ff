"""A setup as the text of recording.toml; what only writes needs no pydantic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np
import tomlkit
from tomlkit.items import Array, Trivia

from arctrack.recording.toml_text import rounded
from noise_model.compiled.arrays import Float64

if TYPE_CHECKING:
    from noise_model.instrument.spectrum import Filter, FilterCurve
    from noise_model.setup import Setup

FILE_NAME = "recording.toml"
UNITS = "mm, s, deg, e-, DN"
"""The units that a recording states."""

GEOMETRY, CERTIFICATE = "geometry", "certificate"
"""The tables of `[calibration]` with the joint covariance of lens, camera pose and sheet, and with the seam's
by it at the point nearest to the tool's axis.
"""


def format_setup(setup: Setup) -> str:
    """Return the text of a recording.toml that reads back as the same setup."""
    document = tomlkit.document()
    document["format"] = "joint-tracking-recording/1"
    document["units"] = UNITS
    for name, table in _tables(setup).items():
        document[name] = table
    if setup.effects:
        document["effects"] = {name: dict(table) for name, table in setup.effects.items()}
    if setup.calibration is not None:
        names, matrix = setup.calibration.names, setup.calibration.matrix
        document["calibration"] = {GEOMETRY: covariance_table(names, matrix)}
    return tomlkit.dumps(document)


def pose_table(T_a_b: Float64) -> dict[str, list[float]]:
    """Return a pose as the file states it: translation in mm, unit quaternion x y z w with w >= 0."""
    from scipy.spatial.transform import Rotation

    # Twelve decimals: what rounding left behind the last ones does not come back the same.
    quaternion = Rotation.from_matrix(T_a_b[:3, :3]).as_quat(canonical=True).round(12)
    return {
        "translation_mm": [float(value) for value in T_a_b[:3, 3]],
        "quaternion_xyzw": [float(value) for value in quaternion],
    }


def covariance_table(parameters: Sequence[str], covariance: Float64) -> dict[str, Any]:
    """Return the covariance (n, n) of parameters as the file states it, a row on each line."""
    rows = Array([], Trivia())
    for row in covariance.tolist():
        rows.append(row)
    return {
        "parameters": list(parameters),
        "sigma": [rounded(value, 4) for value in np.sqrt(np.diag(covariance)).tolist()],
        "covariance": rows.multiline(multiline=True),
    }


def filter_table(of_filter: Filter | FilterCurve | None) -> dict[str, Any]:
    """Return a filter as the file states it, empty for none."""
    from noise_model.instrument.spectrum import FilterCurve

    if of_filter is None:
        return {}
    table: dict[str, Any] = {
        "center_nm": of_filter.center_nm,
        "fwhm_nm": of_filter.fwhm_nm,
        "effective_index": of_filter.effective_index,
    }
    if isinstance(of_filter, FilterCurve):
        table["center_nm"], table["fwhm_nm"] = round(of_filter.center_nm, 3), round(of_filter.fwhm_nm, 3)
        table["curve_wavelength_nm"] = of_filter.wavelength_nm.tolist()
        table["curve_transmission"] = of_filter.transmission.tolist()
    return table


def _stated(record: Any, left_out: str = "") -> dict[str, Any]:
    """Return a record's fields: what it has derived of them since, and keeps, is no part of a setup."""
    return {f.name: getattr(record, f.name) for f in fields(record) if f.name != left_out}


def _tables(setup: Setup) -> dict[str, dict[str, Any]]:
    joint = {
        "type": setup.joint.type,
        **setup.joint.dimensions,
        **(
            {"section_mm": [list(point) for point in setup.joint.section_mm]}
            if setup.joint.section_mm
            else {}
        ),
        "seam_in_base_mm": [list(point) for point in setup.joint.seam_in_base_mm],
        "surface_normal_in_base": setup.joint.surface_normal_in_base,
    }
    if setup.joint.surface_normals_in_base is not None:
        joint["surface_normals_in_base"] = [list(normal) for normal in setup.joint.surface_normals_in_base]
    tables: dict[str, dict[str, Any]] = {
        "camera": _stated(setup.camera, "T_tool_camera"),
        "sensor": _stated(setup.sensor, "bend"),
        "filter": filter_table(setup.filter),
        "laser": {
            name: value
            for name, value in _stated(setup.laser, "profile_exponent").items()
            # A plane needs no bow; a fan without an end no angle.
            if value is not None and (name, value) != ("bow", 0.0)
        },
        "arc": _stated(setup.arc),
        "material": _stated(setup.material, "lobe"),
        "tolerance": _stated(setup.tolerance),
        "joint": joint,
    }
    plain = {
        name: {key: _plain(value) for key, value in table.items()}
        for name, table in tables.items()
        if name not in setup.missing
    }
    plain["camera"]["pose_in_tool"] = pose_table(setup.camera.T_tool_camera)
    if setup.profiler is not None:
        profiler = _stated(setup.profiler, "T_tool_profile")
        plain["camera"] = {"kind": "profile", **profiler}
        plain["camera"]["pose_in_tool"] = pose_table(setup.profiler.T_tool_profile)
        del plain["sensor"], plain["laser"]
    return plain


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return list(value)
    return value.item() if hasattr(value, "item") else value
