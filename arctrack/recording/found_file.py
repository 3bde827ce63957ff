"""File of found joints, arctrack-found/1: what `arctrack find` writes and `arctrack shift` reads."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.output import write_keeping
from arctrack.recording.files import blamed_on, read_text
from arctrack.recording.key_errors import wrong_keys
from noise_model.compiled.arrays import Float64
from tracker.find import FoundJoint, Kind

FORMAT: Literal["arctrack-found/1"] = "arctrack-found/1"

Vector = tuple[float | None, float | None, float | None]
Matrix = tuple[Vector, Vector, Vector]
Two = tuple[float | None, float | None]


class FoundPoint(BaseModel):
    """A found joint, or why there is none; `FoundJoint` says what its arrays are. Unknown numbers are null.

    `sigma_mm` and all below it are for people and programs: arctrack does not read them.
    """

    model_config = ConfigDict(extra="ignore")

    name: str
    kind: Kind
    refusal: str
    point_base_mm: Vector
    axes_base: Matrix
    covariance_mm2: Matrix
    direction_covariance: tuple[Two, Two]
    calibration_base_mm: list[Vector]
    calibration: str
    faces_base: tuple[Vector, Vector]
    face_sigmas_rad: Two
    sigma_mm: Vector = (None, None, None)
    direction_sigma_deg: Two = (None, None)
    normal_base: Vector = (None, None, None)
    normal_sigma_deg: float | None = None
    gap_mm: float | None = None
    gap_sigma_mm: float | None = None
    mismatch_mm: float | None = None
    mismatch_sigma_mm: float | None = None
    opening_deg: float | None = None

    @classmethod
    def of(cls, name: str, joint: FoundJoint, opening_deg: float) -> FoundPoint:
        """Return the record of a found joint whose faces open by an angle, degrees."""
        track = joint.track
        measured: dict[str, float] = {} if track is None else {
            "gap_mm": track.gap_mm,
            "gap_sigma_mm": track.shape.gap_sigma_mm,
            "mismatch_mm": track.mismatch_mm,
            "mismatch_sigma_mm": track.shape.mismatch_sigma_mm,
            "opening_deg": opening_deg,
        }  # fmt: skip
        arrays = {
            name: np.asarray(getattr(joint, name)).tolist()
            for name in cls.model_fields
            if hasattr(joint, name)
        }
        # As in the file: what is not known is None.
        given = cls.model_construct(**{**arrays, **measured, "name": name})
        return cls.model_validate_json(given.model_dump_json(warnings=False))

    def to_found(self) -> FoundJoint:
        """Return the joint as it was found, but for its track."""
        return FoundJoint(
            kind=self.kind,
            refusal=self.refusal,
            point_base_mm=_array(self.point_base_mm),
            axes_base=_array(self.axes_base),
            covariance_mm2=_array(self.covariance_mm2, math.inf),
            direction_covariance=_array(self.direction_covariance, math.inf),
            calibration_base_mm=_array(self.calibration_base_mm).reshape(-1, 3),
            calibration=self.calibration,
            faces_base=_array(self.faces_base),
            face_sigmas_rad=_array(self.face_sigmas_rad),
            track=None,
        )


class FoundFile(BaseModel):
    """File of found joints."""

    format: Literal["arctrack-found/1"]
    points: list[FoundPoint]


def read_found(path: Path) -> list[FoundPoint]:
    """Read a file of found joints; ArctrackError names the file and the key that is wrong."""
    with blamed_on(path, "there is no such file; arctrack find --out writes one"):
        text = read_text(path, LIMITS.log_bytes)
    try:
        points = FoundFile.model_validate_json(text).points
    except ValueError as error:
        raise wrong_keys(path, error, FoundFile) from None
    names = [point.name for point in points]
    for name in names:
        if names.count(name) > 1:
            raise in_file(path, f"points: {name} is there twice; leave one of them")
    return points


def add_found(path: Path, points: Iterable[FoundPoint]) -> str:
    """Write points into a file, which keeps its others; return a line on what was written.

    A point of the same name is replaced, and the file before is kept under a number.
    """
    held = {point.name: point for point in read_found(path)} if path.exists() else {}
    held |= {point.name: point for point in points}
    whole = FoundFile(format=FORMAT, points=list(held.values()))
    former = write_keeping(path, whole.model_dump_json(indent=1) + "\n")
    before = "" if former is None else f"; the one before is {former.name}"
    return f"{path}: {len(held)} point{'' if len(held) == 1 else 's'}{before}"


def found_in_both(master: Path, part: Path) -> dict[str, tuple[FoundPoint, FoundPoint]]:
    """Return the points that two files hold by the same name and kind, and that were found in both.

    ArctrackError where there is none, and for a point that is of another kind in the other file.
    """
    on_master = {point.name: point for point in read_found(master) if not point.refusal}
    on_part = {point.name: point for point in read_found(part) if not point.refusal}
    both = {name: (point, on_part[name]) for name, point in on_master.items() if name in on_part}
    if not both:
        raise in_file(part, f"points: none was found that {master} has too; give them the same names")
    for name, (point, other) in both.items():
        if point.kind != other.kind:
            raise in_file(
                part, f"points: {name} is of kind {other.kind}, in {master} {point.kind}; find it anew"
            )
    return both


def _array(numbers: Any, unknown: float = math.nan) -> Float64:
    array = np.array(numbers, dtype=np.float64)
    return np.where(np.isnan(array), unknown, array)
