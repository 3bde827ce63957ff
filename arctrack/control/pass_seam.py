"""Seam of a pass: recorded as it is tracked, and laid along the nominal line of a pass that follows it again.

Measurements are averaged over each millimetre and kept in base, so a later pass may have another joint, and
may go the other way. No file, thread or clock is in here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.control.frame_tracking import PassFrame
from arctrack.recording.seam_file import MIN_STATIONS, KeptSeam
from noise_model.compiled.arrays import Float64
from noise_model.transforms import transform
from tracker.geometry import SensorGeometry
from tracker.judge import MAX_OFF_MM
from tracker.seam.earlier_pass import EarlierPass, tool_tilt_deg
from tracker.seam.expected import torch_station_mm
from tracker.seam.gaussian_process import MODEL_SIGMA_MM, SPACING_MM, SeamHistory
from tracker.seam.locate import ridge_mm

if TYPE_CHECKING:
    from arctrack.control.cell_file.choices import AgainChoice

JOINT_WITHIN_MM = 2
"""Distance from a station within which its gap and area count, whole mm.

Chosen: at 50 mm/s and 25 frames a second there is a frame each 2 mm. A gap changes by some hundredths on it.
"""


@dataclass
class _Average:
    """Weighted average of a station's measurements; NaN where there are none."""

    weight: float = 0.0
    total: Float64 = field(default_factory=lambda: np.zeros(1))

    def add(self, value: Float64, sigma: float) -> float:
        """Take a value (n,) with its 1 sigma, and return its weight; 0 for one that is not known."""
        if not (math.isfinite(sigma) and np.isfinite(value).all()):
            return 0.0
        weight = 1.0 / max(sigma, MODEL_SIGMA_MM) ** 2
        self.weight += weight
        self.total = self.total + weight * value
        return weight

    @property
    def value(self) -> Float64:
        """The average (n,)."""
        return self.total / self.weight if self.weight > 0.0 else np.full_like(self.total, math.nan)


@dataclass
class _Station:
    """Averages over one millimetre of a seam: the path's point in base, its variances, gap and area."""

    point_base_mm: _Average = field(default_factory=_Average)
    spread: Float64 = field(default_factory=lambda: np.zeros(2))
    gap_mm: _Average = field(default_factory=_Average)
    area_mm2: _Average = field(default_factory=_Average)

    @property
    def variance_mm2(self) -> Float64:
        """Variances (2,) of the point across the seam and in height, mm^2."""
        return self.spread / self.point_base_mm.weight**2 + MODEL_SIGMA_MM**2


class PassRecorder:
    """Recorder of a pass's seam from its tracks."""

    def __init__(self, geometry: SensorGeometry) -> None:
        self._geometry = geometry
        self._stations: dict[int, _Station] = {}
        self._tools: dict[int, Float64] = {}
        self._calibration_mm2 = np.zeros(2)

    @property
    def is_empty(self) -> bool:
        """True before anything was measured."""
        return not self._stations

    def add(self, frame: PassFrame) -> None:
        """Take a frame whose pose is trusted."""
        track, seam, T_base_tool = frame.track, frame.seam, frame.T_base_tool
        _, torch_mm = torch_station_mm(self._geometry.seam_source, T_base_tool.tolist())
        self._tools[_bin(torch_mm)] = T_base_tool[:3, :3]
        if seam is None or not track.valid:
            return
        if not math.isfinite(math.hypot(*seam.sigma_mm, *frame.calibration_variance_mm2)):
            return
        up_base = np.array(seam.axes_base[1])
        seam_base_mm = transform(T_base_tool, np.array(track.seam_tool_mm))
        station = self._stations.setdefault(_bin(seam.station_mm), _Station())
        path_base_mm = seam_base_mm - self._geometry.seam_source.height_mm * up_base
        weight = station.point_base_mm.add(path_base_mm, math.hypot(*seam.sigma_mm))
        station.spread += (weight * np.array(seam.sigma_mm)) ** 2
        station.gap_mm.add(np.array([track.gap_mm]), track.shape.gap_sigma_mm)
        station.area_mm2.add(np.array([track.shape.area_mm2]), track.shape.area_sigma_mm2)
        self._calibration_mm2 = np.maximum(self._calibration_mm2, frame.calibration_variance_mm2)

    def joint_at(self, station_mm: float) -> tuple[float, float]:
        """Return gap, mm, and area, mm^2, measured within JOINT_WITHIN_MM of a station; NaN for unknown."""
        here = _bin(station_mm)
        near = sorted(range(here - JOINT_WITHIN_MM, here + JOINT_WITHIN_MM + 1), key=lambda n: abs(n - here))
        stations = [self._stations[n] for n in near if n in self._stations]
        gaps_mm = (float(station.gap_mm.value[0]) for station in stations)
        areas_mm2 = (float(station.area_mm2.value[0]) for station in stations)
        return next(filter(math.isfinite, gaps_mm), math.nan), next(
            filter(math.isfinite, areas_mm2), math.nan
        )

    def kept(self, kept_at: datetime | None) -> KeptSeam | None:
        """Return the seam that was recorded, None where too little was."""
        if len(self._stations) < MIN_STATIONS:
            return None
        places = sorted(self._stations)
        stations = [self._stations[place] for place in places]
        passed = np.array(sorted(self._tools))
        nearest = [passed[np.argmin(np.abs(passed - place))] for place in places]
        tools = Rotation.from_matrix(np.array([self._tools[int(place)] for place in nearest]))
        sigma_y_mm, sigma_z_mm = np.sqrt(self._calibration_mm2).tolist()
        return KeptSeam(
            kept_at=kept_at,
            calibration=self._geometry.calibration_digest,
            calibration_sigma_mm=(sigma_y_mm, sigma_z_mm),
            points_base_mm=np.array([station.point_base_mm.value for station in stations]),
            quaternions_xyzw=tools.as_quat(),
            sigmas_mm=np.sqrt([station.variance_mm2 for station in stations]),
            gaps_mm=np.array([station.gap_mm.value[0] for station in stations]),
            areas_mm2=np.array([station.area_mm2.value[0] for station in stations]),
        )


def _bin(station_mm: float) -> int:
    return math.floor(station_mm / SPACING_MM)


@dataclass(frozen=True)
class LaidSeam:
    """A kept seam along a pass's nominal line, its n stations rising.

    `earlier` is what the tracker follows. `gaps_mm` and `areas_mm2` (n,) are the joint's, NaN where they were
    not measured. `segments` are those of the nominal line. `R_joint_tools` (n, 3, 3) are the tool's rotations
    in the joint frame of the present pass, as that pass should have them. `kept_at` is the kept seam's.
    """

    earlier: EarlierPass
    gaps_mm: Float64
    areas_mm2: Float64
    segments: tuple[int, ...]
    R_joint_tools: Float64
    kept_at: datetime | None

    def joint_at(self, station_mm: float) -> tuple[float, float]:
        """Return gap, mm, and area, mm^2, of the nearest station; NaN past the seam's ends."""
        stations_mm = self.earlier.history.stations_mm
        if not stations_mm[0] - SPACING_MM <= station_mm <= stations_mm[-1] + SPACING_MM:
            return math.nan, math.nan
        nearest = int(np.argmin(np.abs(stations_mm - station_mm)))
        return float(self.gaps_mm[nearest]), float(self.areas_mm2[nearest])


def lay_seam(kept: KeptSeam, geometry: SensorGeometry, again: AgainChoice) -> LaidSeam:
    """Return a kept seam along the nominal line of a pass that follows it again.

    Raises ValueError, which names the key, for a seam of another sensor and for one of another place.
    """
    if kept.calibration != geometry.calibration_digest:
        raise ValueError(
            f"calibration = {kept.calibration!r}: the setup's is {geometry.calibration_digest!r}; "
            "keep the seam anew with the present calibration"
        )
    source = geometry.seam_source
    corrugation = source.scene.shape.corrugation
    segments = [source.segment_near(point) for point in kept.points_base_mm.tolist()]
    places = np.array(
        [
            transform(source.T_joint_base[n], point)
            for n, point in zip(segments, kept.points_base_mm, strict=True)
        ]
    )
    places[:, 2] -= [ridge_mm(x_mm, corrugation) for x_mm in places[:, 0].tolist()]
    off_mm = np.abs(places[:, 1:]).max(axis=1)
    if not off_mm.max() <= MAX_OFF_MM:
        raise ValueError(
            f"stations[{int(off_mm.argmax())}] point_base_mm: lies {off_mm.max():.1f} mm off the job's "
            "nominal seam; follow the seam of the same part"
        )
    R_base_tools = Rotation.from_quat(kept.quaternions_xyzw).as_matrix()
    R_joint_tools = np.array(
        [source.T_joint_base[n][:3, :3] @ R for n, R in zip(segments, R_base_tools, strict=True)]
    )
    if again.reverse:
        # The sensor leads the other way, and the torch drags or pushes as before: mirrored along the seam.
        R_joint_tools = np.diag([-1.0, 1.0, 1.0]) @ R_joint_tools @ np.diag([1.0, -1.0, 1.0])
    R_joint_tools = Rotation.from_euler("x", again.tilt_deg, degrees=True).as_matrix() @ R_joint_tools
    order = np.argsort(places[:, 0], kind="stable")
    history = SeamHistory(
        np.ascontiguousarray(places[order, 0]),
        np.ascontiguousarray(places[order, 1:]),
        np.ascontiguousarray(kept.sigmas_mm[order] ** 2),
    )
    y_mm2, z_mm2 = np.square(kept.calibration_sigma_mm).tolist()
    tilts_deg = np.array([tool_tilt_deg(R) for R in R_joint_tools[order]])
    earlier = EarlierPass(history, again.sigma_mm, (y_mm2, z_mm2), tilts_deg, again.laser)
    return LaidSeam(
        earlier,
        kept.gaps_mm[order],
        kept.areas_mm2[order],
        tuple(segments[n] for n in order.tolist()),
        R_joint_tools[order],
        kept.kept_at,
    )
