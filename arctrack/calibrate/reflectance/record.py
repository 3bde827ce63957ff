"""Files of `arctrack calibrate reflectance`: a [material] table, the result in full, the residuals."""

import csv
import json
import math
from pathlib import Path

import tomlkit

from arctrack.calibrate.reflectance.goniometer import GoniometerFile
from arctrack.errors import in_file
from arctrack.recording.toml_text import rounded
from calibration.reflectance import Reflectance, StandardResiduals
from calibration.reflectance_model import NAMES
from noise_model.compiled.arrays import Float64

MATERIAL, RESULT, RESIDUALS, PICTURE = "material.toml", "reflectance.json", "residuals.csv", "reflectance.png"

DIGITS = 6


def material_toml(result: Reflectance) -> str:
    """Return the [material] table of a recording.toml, each value with its interval as a comment."""
    table = tomlkit.table()
    table["name"] = result.material.name
    for name, value, interval in zip(NAMES, result.values, result.intervals, strict=True):
        table[name] = rounded(value, DIGITS)
        table[name].comment(f"95 %: {interval[0]:.4g} to {interval[1]:.4g}")
    document = tomlkit.document()
    document.add(tomlkit.comment(scale_sentence(result)))
    document["material"] = table
    return tomlkit.dumps(document)


def scale_sentence(result: Reflectance) -> str:
    """Return a sentence on what determined the scale of the kappas."""
    if result.absolute:
        return "kappa_diff and kappa_spec in 1/sr, by the white standard"
    total = result.material.kappa_diff + result.material.kappa_spec
    return f"kappa_diff + kappa_spec = {total:g} by convention: only their ratio was measured"


def write_results(
    result: Reflectance, source: GoniometerFile, standard: GoniometerFile | None, folder: Path
) -> None:
    """Write all but the picture; ArctrackError if the folder cannot be written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / MATERIAL).write_text(material_toml(result), encoding="utf-8")
        (folder / RESULT).write_text(_json(result, source), encoding="utf-8")
        _write_residuals(result, source, standard, folder / RESIDUALS)
    except OSError as error:
        raise in_file(folder, f"cannot be written: {error.strerror}") from None


def _json(result: Reflectance, source: GoniometerFile) -> str:
    scatter = result.scatter
    document = {
        "format": "arctrack-reflectance/1",
        "source": str(source.path),
        "names": NAMES,
        "values": result.values.tolist(),
        "sigmas": result.sigmas.tolist(),
        "intervals_95": result.intervals.tolist(),
        "covariance": result.covariance.tolist(),
        "correlation": result.correlation.tolist(),
        "t_freedom": result.fit.t_freedom,
        "absolute": result.absolute,
        "scale": result.scale,
        "chi2_per_freedom": result.fit.chi2,
        "scatter_over_repeats": _or_none(scatter.ratio),
        "p_value": _or_none(scatter.p_value),
        "noise": {"additive_dn": result.noise.additive_dn, "relative": result.noise.relative},
        "between_settings": result.between,
        "settings": len(source.readings.settings),
        "readings": int(source.readings.repeats.sum()),
    }
    return json.dumps(document, indent=2) + "\n"


def _write_residuals(
    result: Reflectance, source: GoniometerFile, standard: GoniometerFile | None, path: Path
) -> None:
    parts: list[tuple[str, GoniometerFile, Reflectance | StandardResiduals]] = [("sample", source, result)]
    if standard is not None and result.white is not None:
        parts.append(("white", standard, result.white))
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        for i, (patch, read, agreement) in enumerate(parts):
            columns = _columns(read, agreement)
            if i == 0:
                writer.writerow([*columns, "patch"])
            for row in zip(*columns.values(), strict=True):
                numbers = ("" if math.isnan(value) else f"{value:.{DIGITS}g}" for value in row)
                writer.writerow([*numbers, patch])


def _columns(read: GoniometerFile, agreement: Reflectance | StandardResiduals) -> dict[str, Float64]:
    settings = read.readings.settings
    return {
        "theta_i_deg": settings.theta_i_deg,
        "theta_r_deg": settings.theta_r_deg,
        "phi_r_deg": settings.phi_r_deg,
        "readings": read.readings.repeats,
        "gray_level": read.readings.gray_level,
        "standard_error": read.readings.standard_error,
        "predicted": agreement.predicted,
        "residual": agreement.residuals,
        "studentised": agreement.studentised,
    }


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value
