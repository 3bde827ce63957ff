"""Program of a pass: the torch's places along an earlier pass's seam, for a robot that takes no offsets."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.control.cell_file import CellJob
from arctrack.control.seam_passes import read_laid
from arctrack.recording.weld_schedule import NO_WELD, WeldValues, read_schedule
from noise_model.setup import Setup
from noise_model.transforms import transform
from tracker.geometry import SensorGeometry
from tracker.seam.earlier_pass import KnownSeam
from tracker.seam.gaussian_process import NO_HISTORY
from tracker.seam.locate import ridge_mm

COLUMNS = (
    *("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw", "sigma_y_mm", "sigma_z_mm"),
    *("weld_speed_mm_s", "weld_weave_mm", "weld_wire_m_min", "weld_refusal"),
)


class ProgramPoint(NamedTuple):
    """Place of a pass: the torch's point, mm, and the tool's rotation R_base_tool, in base.

    `sigma_mm` (2,) is 1 sigma across the seam and in height, with what has moved since; the calibration's
    error comes on top.
    """

    point_base_mm: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]
    sigma_mm: tuple[float, float]
    weld: WeldValues


def pass_program(job: CellJob, setup: Setup) -> list[ProgramPoint]:
    """Return the places of a job that follows an earlier pass, along its travel, one a millimetre.

    `setup` is the cell's. Places are displaced as offsets are, by side, height and bias, but without limits.
    Places past the nominal seam's ends are left out. Raises ArctrackError for a seam
    that is unusable and a weld schedule that is wrong.
    """
    again = job.again
    assert again is not None
    geometry = SensorGeometry.of(job.setup_for(setup))
    source = geometry.seam_source
    schedule = None if job.schedule is None else read_schedule(job.schedule)
    laid = read_laid(again, geometry)
    known = KnownSeam(source, NO_HISTORY, laid.earlier)
    start_mm, end_mm = source.ends_mm
    points = []
    for station_mm, segment, R_joint_tool in zip(
        laid.earlier.history.stations_mm.tolist(), laid.segments, laid.R_joint_tools, strict=True
    ):
        seam = known.before(station_mm)
        if seam is None or not start_mm <= station_mm <= end_mm:
            continue
        y_mm, z_mm = seam.displacement_mm
        z_mm += ridge_mm(station_mm, source.scene.shape.corrugation)
        T_base_joint = np.array(source.T_base_joint[segment])
        place_mm = np.array([station_mm, y_mm + job.correction.y.bias_mm, z_mm + job.correction.z.bias_mm])
        base_x, base_y, base_z = transform(T_base_joint, place_mm).tolist()
        qx, qy, qz, qw = (
            Rotation.from_matrix(T_base_joint[:3, :3] @ R_joint_tool).as_quat(canonical=True).tolist()
        )
        weld = NO_WELD if schedule is None else schedule.at(*laid.joint_at(station_mm))
        points.append(ProgramPoint((base_x, base_y, base_z), (qx, qy, qz, qw), seam.sigma_mm, weld))
    return points


def program_csv(points: Sequence[ProgramPoint]) -> str:
    """Return a program as CSV; unknown values are empty."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for point in points:
        numbers = (*point.point_base_mm, *point.quaternion_xyzw, *point.sigma_mm, *point.weld[:3])
        cells = ("" if math.isnan(value) else f"{value:.6f}" for value in numbers)
        table.writerow((*cells, point.weld.refusal))
    return text.getvalue()
