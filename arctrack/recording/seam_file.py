"""File of a pass's seam, arctrack-seam/1: what one pass has measured, for a later pass to follow again."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field

from arctrack.errors import ArctrackError, in_file
from arctrack.limits import LIMITS
from arctrack.output import write_whole
from arctrack.recording.files import blamed_on, read_text
from arctrack.recording.key_errors import wrong_keys
from noise_model.compiled.arrays import Float64

FORMAT: Literal["arctrack-seam/1"] = "arctrack-seam/1"

MIN_STATIONS = 2
"""Number of stations below which a seam has no direction."""

Coordinate = Annotated[float, Field(ge=-LIMITS.length_mm, le=LIMITS.length_mm)]
Sigma = Annotated[float, Field(gt=0.0, le=LIMITS.length_mm)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class KeptSeam:
    """Seam of a pass at n stations along its travel; NaN where a quantity was not measured.

    - `kept_at`: the time of its end, UTC, None of a recording's pass; `calibration`: the digest of camera,
      laser and their errors.
    - `points_base_mm` (n, 3): the programmed path, moved onto the seam, mm, base frame.
    - `quaternions_xyzw` (n, 4): the tool's rotation R_base_tool as the torch passed each station.
    - `sigmas_mm` (n, 2): 1 sigma of each point across the seam and in height, mm, without the calibration's
      part, which is `calibration_sigma_mm` (2,).
    - `gaps_mm` (n,), `areas_mm2` (n,): the joint's gap and the area of its opening.
    """

    kept_at: datetime | None
    calibration: str
    calibration_sigma_mm: tuple[float, float]
    points_base_mm: Float64
    quaternions_xyzw: Float64
    sigmas_mm: Float64
    gaps_mm: Float64
    areas_mm2: Float64


class SeamFile(BaseModel):
    """File of a pass's seam; see `KeptSeam`. What was not measured is null."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    format: Literal["arctrack-seam/1"]
    kept_at: AwareDatetime | None
    calibration: str
    calibration_sigma_mm: tuple[Annotated[float, Field(ge=0.0)], Annotated[float, Field(ge=0.0)]]
    points_base_mm: list[Point] = Field(min_length=MIN_STATIONS)
    quaternions_xyzw: list[Quaternion]
    sigmas_mm: list[tuple[Sigma, Sigma]]
    gaps_mm: list[float | None]
    areas_mm2: list[float | None]


def write_seam(path: Path, seam: KeptSeam) -> None:
    """Write a pass's seam; ArctrackError if the file cannot be written, which is then as it was."""
    arrays = {name: value.tolist() for name, value in vars(seam).items() if isinstance(value, np.ndarray)}
    for name in ("gaps_mm", "areas_mm2"):
        arrays[name] = [value if math.isfinite(value) else None for value in arrays[name]]
    content = SeamFile.model_validate({"format": FORMAT, **vars(seam), **arrays})
    write_whole(path, content.model_dump_json() + "\n")


def read_seam(path: Path) -> KeptSeam:
    """Read a pass's seam; ArctrackError names the file, the key and the cure of what is wrong."""
    with blamed_on(path, "there is no such file; a job with keep_seam writes it at the end of its pass"):
        text = read_text(path, LIMITS.json_bytes)
    try:
        content = SeamFile.model_validate_json(text)
    except ValueError as error:
        raise wrong_keys(path, error, SeamFile) from None
    lists = {name: value for name, value in content if isinstance(value, list)}
    n = len(content.points_base_mm)
    for name, values in lists.items():
        if len(values) != n:
            raise in_file(path, f"{name}: has {len(values)} stations, points_base_mm {n}; keep the seam anew")
    # An unknown number is None, which is NaN here.
    arrays = {name: np.array(values, dtype=np.float64) for name, values in lists.items()}
    norms = np.linalg.norm(arrays["quaternions_xyzw"], axis=1)
    for wrong in np.flatnonzero(~(np.abs(norms - 1.0) < 0.01)).tolist():
        raise in_file(path, f"quaternions_xyzw[{wrong}]: its norm is not 1; keep the seam anew")
    kept_at = None if content.kept_at is None else content.kept_at.astimezone(UTC)
    return KeptSeam(kept_at, content.calibration, content.calibration_sigma_mm, **arrays)


def check_can_keep(path: Path) -> None:
    """Raise ArctrackError if a pass's seam cannot be kept there, or would take another file's place."""
    if not path.parent.is_dir():
        raise in_file(path, "its folder is missing; make it, or name another file as keep_seam")
    if not path.exists():
        return
    try:
        read_seam(path)
    except ArctrackError as error:
        raise ArctrackError(f"{error}; keep_seam would replace it: name another file, or remove it") from None
