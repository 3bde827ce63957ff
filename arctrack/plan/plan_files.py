"""plan.csv and path.csv: what `arctrack plan` found, for a spreadsheet or a script."""

import csv
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

from arctrack.errors import in_file
from noise_model.plan.plan import Plan
from noise_model.plan.remedies import Cure
from noise_model.plan.search import DesignCandidate

PLAN, PATH, PLAN_PICTURE, PATH_PICTURE = "plan.csv", "path.csv", "plan.png", "path.png"

DIGITS = 6

Row = Mapping[str, str | float]


def write_tables(plan: Plan, folder: Path) -> None:
    """Write both tables; ArctrackError if the folder cannot be written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / PLAN, designs(plan))
        _write(folder / PATH, stations(plan))
    except OSError as error:
        raise in_file(folder, f"cannot be written: {error.strerror}") from None


def designs(plan: Plan) -> list[Row]:
    """Return the user's design and those that none beats, a row each."""
    return [_design(plan.own, "yours"), *(_design(candidate, "front") for candidate in plan.front)]


def _design(candidate: DesignCandidate, kind: str) -> Row:
    design = candidate.design
    return {
        "design": kind,
        "sigma_mm": candidate.sigma_mm,
        "sigma_y_mm": candidate.sigma_y_mm,
        "sigma_z_mm": candidate.sigma_z_mm,
        "tilt_deg": design.tilt_deg,
        "azimuth_deg": design.azimuth_deg,
        "preview_mm": design.preview_mm,
        "stand_off_mm": design.stand_off_mm,
        "lean_deg": design.lean_deg,
        "filter_fwhm_nm": design.filter_fwhm_nm,
        "exposure_s": design.exposure_s,
        "triangulation_deg": design.triangulation_deg,
        "sigma_px": candidate.sigma_px,
        "arc_over_stripe": candidate.arc_over_stripe,
        "blind_share": candidate.blind_share,
        "saturated_share": candidate.saturated_share,
    }


def stations(plan: Plan) -> list[Row]:
    """Return the stations along the path, a row each, with what cures a blind one."""
    rows: list[Row] = []
    for n, (station_mm, noise) in enumerate(zip(plan.along.path.station_mm, plan.along.noise, strict=True)):
        cure = next((cure for cure in plan.cures if cure.first <= n <= cure.last), None)
        rows.append(
            {
                "station_mm": float(station_mm),
                "sigma_mm": noise.sigma_mm,
                "sigma_y_mm": noise.sigma_y_mm,
                "sigma_z_mm": noise.sigma_z_mm,
                "sigma_px": noise.sigma_px,
                "arc_over_stripe": noise.arc_over_stripe,
                "blind_share": noise.blind_share,
                "saturated_share": noise.saturated_share,
                "blind": float(cure is not None),
                **_cure(cure),
            }
        )
    return rows


def _cure(cure: Cure | None) -> Row:
    names = ("exposure_s", "lean_travel_deg", "lean_work_deg", "tilt_deg", "azimuth_deg")
    if cure is None:
        return {"cure_" + name: math.nan for name in (*names, *_CURED)}
    values = (
        cure.exposed.design.exposure_s,
        *cure.lean_deg,
        cure.moved.design.tilt_deg,
        cure.moved.design.azimuth_deg,
        *(getattr(cure, name.split("_", 1)[0]).sigma_mm for name in _CURED),
    )
    return {"cure_" + name: value for name, value in zip((*names, *_CURED), values, strict=True)}


_CURED = ("exposed_sigma_mm", "leaned_sigma_mm", "moved_sigma_mm")


def _write(path: Path, rows: Iterable[Row]) -> None:
    rows = list(rows)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(rows[0])
        for row in rows:
            writer.writerow(_text(value) for value in row.values())


def _text(value: str | float) -> str:
    """Return a cell: a number that is not known, or a sigma without end, is empty."""
    if isinstance(value, str):
        return value
    return f"{value:.{DIGITS}g}" if math.isfinite(value) else ""
