"""Find of a joint before welding: its place, course and attitude in base from frames at one place or a few.

One frame shows one section. It tells where the seam meets the laser sheet, across the seam and in height, and
how the faces lie in the sheet. It does not tell the seam's direction, for which sections at two stations are
needed: their line is the weighted least squares one (`found_joint`). The joint begins or ends between a frame
with it and one without (`found_end`); two lines meet at a corner (`found_corner`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.transforms import invert, moved, transform
from tracker import flags
from tracker.geometry import SEARCH_REACH_MM, SensorGeometry
from tracker.seam.gaussian_process import MODEL_SIGMA_MM, SLOPE_SIGMA
from tracker.seam.joint_ends import LOOK_MM
from tracker.state import Frame, Pose, Track
from tracker.step import step
from tracker.stripe.read import Work
from tracker.tracker_state import TrackerMemory

Kind = Literal["seam", "start", "end", "corner"]

STEP_MM = 1.4 * SEARCH_REACH_MM
"""Distance between the places that are searched in one frame: the searches overlap."""

UNLIKE = flags.JOINT_MISFIT.mask | flags.JOINT_TYPE_MISMATCH.mask
"""Flags of a joint that does not look as stated: it counts where no other place of the frame shows one."""


class JointSection(NamedTuple):
    """Section of a joint that one frame shows, in base.

    `T_base_joint` (4, 4) is the nominal joint frame, `covariance_mm2` (2, 2) of the point's y and z in it.
    `calibration_base_mm` (m, 3) are the point's displacements by independent errors of the calibration,
    1 sigma each. `faces_base` (2, 3) are unit vectors along the left and the right plate in the laser sheet,
    with `face_sigmas_rad` (2,) about the seam; NaN where a plate was not seen.
    """

    T_base_joint: Float64
    point_base_mm: Float64
    covariance_mm2: Float64
    calibration_base_mm: Float64
    calibration: str
    faces_base: Float64
    face_sigmas_rad: Float64
    track: Track


@dataclass(frozen=True, eq=False)
class FoundJoint:
    """A found joint in base, or why there is none.

    Attributes
    ----------
    kind : str
        "seam" for a point anywhere along a seam; "start", "end" or "corner" for one known along it too.
    refusal : str
        Name of the flag or of the part's fault; "" for a joint that was found.
    point_base_mm : array (3,)
        The seam point.
    axes_base : array (3, 3)
        Unit vectors along the seam, to its left and out of the work, one a row.
    covariance_mm2 : array (3, 3)
        Of the point along these axes, without the calibration's errors; infinite along the seam of a "seam".
    direction_covariance : array (2, 2)
        Of the direction along the seam, to the left and out of the work, rad^2; infinite where one section
        alone was seen: the direction is then that of the nominal line.
    calibration_base_mm : array (m, 3)
        The point's displacements by independent errors of the calibration, 1 sigma each.
    calibration : str
        Name of the calibration that these errors are of: two finds by the same one share them.
    faces_base, face_sigmas_rad : array (2, 3), (2,)
        Unit vectors along the left and the right plate in the laser sheet, and 1 sigma about the seam.
    track : Track or None
        The frame with the smallest sigma, for gap, mismatch and angles.
    """

    kind: Kind
    refusal: str
    point_base_mm: Float64
    axes_base: Float64
    covariance_mm2: Float64
    direction_covariance: Float64
    calibration_base_mm: Float64
    calibration: str
    faces_base: Float64
    face_sigmas_rad: Float64
    track: Track | None

    @classmethod
    def refused(cls, kind: Kind, refusal: str) -> FoundJoint:
        """Return a joint that was not found: nothing of it is known."""
        unknown = np.full((3, 3), np.nan)
        return cls(
            kind=kind,
            refusal=refusal,
            point_base_mm=unknown[0],
            axes_base=unknown,
            covariance_mm2=unknown,
            direction_covariance=unknown[:2, :2],
            calibration_base_mm=np.empty((0, 3)),
            calibration="",
            faces_base=unknown[:2],
            face_sigmas_rad=unknown[0, :2],
            track=None,
        )

    @property
    def sigma_mm(self) -> Float64:
        """1 sigma (3,) along the seam, to the left and out of the work, mm, with the calibration's errors."""
        own = np.diagonal(self.covariance_mm2)
        return np.asarray(np.sqrt(own + np.sum((self.calibration_base_mm @ self.axes_base.T) ** 2, axis=0)))

    @property
    def direction_sigma_deg(self) -> Float64:
        """1 sigma (2,) of the direction to the left and out of the work, degrees."""
        return np.degrees(np.sqrt(np.diagonal(self.direction_covariance)))

    @property
    def normal_base(self) -> Float64:
        """The surface's unit normal (3,) by the faces that were seen: the mean of theirs; NaN without any."""
        normals = np.cross(self.axes_base[0], self.faces_base[np.isfinite(self.face_sigmas_rad)])
        if not len(normals):
            return np.full(3, np.nan)
        total = (normals / np.linalg.norm(normals, axis=1)[:, np.newaxis]).sum(axis=0)
        return np.asarray(total / np.linalg.norm(total))

    @property
    def R_base_found(self) -> Float64:
        """Rotation (3, 3) of the joint's frame in base: x along the seam, y to its left, z the normal.

        Where no face was seen z is the nominal seam's.
        """
        up = self.axes_base[2] if math.isnan(self.normal_sigma_deg) else self.normal_base
        return _axes(self.axes_base[0], up).T

    @property
    def normal_sigma_deg(self) -> float:
        """1 sigma of the surface's normal about the seam, degrees."""
        seen = self.face_sigmas_rad[np.isfinite(self.face_sigmas_rad)]
        return math.degrees(math.sqrt(seen @ seen) / len(seen)) if len(seen) else math.nan


class Finder:
    """Search for a joint in single frames: each is taken as the first of a run.

    Parameters
    ----------
    geometry : SensorGeometry
        The sensor over the nominal joint, `SensorGeometry.of(setup)`.
    """

    def __init__(self, geometry: SensorGeometry) -> None:
        self.geometry = geometry
        self._work = Work.of(geometry)
        self.calibration = geometry.calibration_digest

    def section(self, frame: Frame, pose: Pose) -> tuple[JointSection | None, Track]:
        """Return the section that a frame shows, None if none, and the track that it stands on.

        The joint is sought where the setup's line puts it, then about the place that the sensor points at:
        the robot may search off its programmed path.
        """
        best: tuple[JointSection, Track] | None = None
        refused: Track | None = None
        for T_part in self._displacements(pose.T_base_tool):
            section, track = self.section_of(frame, pose, T_part)
            if section is None:
                refused = refused or track
            elif not track.flags & UNLIKE:
                return section, track
            else:
                best = best or (section, track)
        if best is not None:
            return best
        assert refused is not None
        return None, refused

    def section_of(self, frame: Frame, pose: Pose, T_part: Float64) -> tuple[JointSection | None, Track]:
        """Return the section and the track of a frame for a part's displacement (4, 4) in base.

        The fit's shape leans with the part: an upright edge that leans shows its seam elsewhere.
        """
        T_look = invert(T_part) @ pose.T_base_tool
        looked = Pose(T_look, pose.extrapolated)
        state, track, reading = step(self.geometry, TrackerMemory(), frame, looked, self._work)
        if not track.valid and state.beyond.n > 0:
            # A new gap in doubt waits for a second frame: here that is the find's other frames.
            state, track, reading = step(self.geometry, state, frame, looked, self._work)
        if not track.valid or reading is None or reading.joint is None:
            return None, track
        source, covariance_mm2 = self.geometry.seam_source, reading.joint.covariance_mm2
        R_part_joint = np.array(source.T_base_joint[source.segment_crossed(T_look)])
        seam_tool = np.array(track.seam_tool_mm)
        # What a turn of the seam adds, and the error beyond what a fit says of itself.
        more_mm2 = float(state.history.variances_mm2[-1, 0] - covariance_mm2[0, 0])
        n_x, n_y, n_z = (
            R_part_joint[:3, :3].T @ T_look[:3, :3] @ np.array(source.plane_at(track.seam_tool_mm)[:3])
        )
        angles = np.radians(track.shape.plate_angles_deg)
        y, z = np.cos(angles), np.sin(angles)
        faces = np.column_stack([-(n_y * y + n_z * z) / n_x, y, z])
        faces /= np.linalg.norm(faces, axis=1)[:, np.newaxis]
        T_base_joint = T_part @ R_part_joint
        moves_mm = self.geometry.calibration_field.moves_mm(seam_tool)
        section = JointSection(
            T_base_joint=T_base_joint,
            point_base_mm=transform(pose.T_base_tool, seam_tool),
            covariance_mm2=covariance_mm2 + more_mm2 * np.eye(2),
            calibration=self.calibration,
            calibration_base_mm=moves_mm @ pose.T_base_tool[:3, :3].T,
            faces_base=faces @ T_base_joint[:3, :3].T,
            face_sigmas_rad=np.radians(track.shape.plate_sigmas_deg),
            track=track,
        )
        return section, track

    def displacement(self, joint: FoundJoint) -> Float64:
        """Return the displacement (4, 4) of a part in base that puts the nominal seam where it was found.

        How far it lies off along the seam is not known, and taken as not at all.
        """
        source = self.geometry.seam_source
        T_nominal: Float64 = np.array(source.T_base_joint[source.segment_near(joint.point_base_mm.tolist())])
        station_mm = float(transform(invert(T_nominal), joint.point_base_mm)[0])
        T_nominal[:3, 3] = transform(T_nominal, np.array([station_mm, 0.0, source.height_mm]))
        up = T_nominal[:3, 2] if math.isnan(joint.normal_sigma_deg) else joint.normal_base
        T_found = np.eye(4)
        T_found[:3, :3], T_found[:3, 3] = _axes(joint.axes_base[0], up).T, joint.point_base_mm
        return np.asarray(T_found @ invert(T_nominal))

    def _displacements(self, T_base_tool: Float64) -> Iterable[Float64]:
        """Return displacements (4, 4) that put the seam elsewhere in a frame, the likeliest first."""
        yield np.eye(4)
        source = self.geometry.seam_source
        if T_base_tool.shape != (4, 4) or not np.isfinite(T_base_tool).all():
            return
        T_base_joint = np.array(source.T_base_joint[source.segment_crossed(T_base_tool)])
        aim = (invert(T_base_joint) @ T_base_tool @ np.append(source.ahead_mm, 1.0))[1:3]
        aim = np.array([aim[0], aim[1] - source.height_mm]) if np.linalg.norm(aim) > STEP_MM else np.zeros(2)
        grid = [(y, z) for y in (0, -1, 1) for z in (0, -1, 1)]
        for y, z in sorted(grid, key=lambda place: place[0] ** 2 + place[1] ** 2):
            off_mm = aim + STEP_MM * np.array([y, z])
            if np.linalg.norm(off_mm) >= 1.0:
                T_part = np.eye(4)
                T_part[:3, 3] = T_base_joint[:3, 1:3] @ off_mm
                yield T_part


def find_joint(finder: Finder, shown: Iterable[tuple[Frame, Pose]], kind: Kind = "seam") -> FoundJoint:
    """Find a joint, its start or its end by frames at one place or along some millimetres of the seam.

    Parameters
    ----------
    finder : Finder
        The sensor.
    shown : iterable of (Frame, Pose)
        Frames and the tool's poses. Those nearer than 1 mm along the seam show the same section.
    kind : str
        "seam", or "start" or "end": then some frames must show the joint, and others the place without it.

    Returns
    -------
    FoundJoint
        The joint; its `refusal` names the flag that refused the frames, where none showed the joint.
    """
    sections, looks, missed, refusals = [], [], [], Counter[str]()
    for frame, pose in shown:
        section, track = finder.section(frame, pose)
        if section is not None:
            sections.append(section)
            looks.append((frame, pose))
            continue
        refusals.update(flags.names(track.flags & flags.INVALIDATING))
        if frame.laser_on and not track.flags & (flags.FRAME_UNREADABLE.mask | flags.POSE_REFUSED.mask):
            missed.append(pose.T_base_tool)
    if not sections:
        return FoundJoint.refused(
            kind, refusals.most_common(1)[0][0] if refusals else flags.POSE_REFUSED.name
        )
    joint = found_joint(sections)
    T_part = finder.displacement(joint)
    again = [finder.section_of(*look, T_part)[0] for look in looks]
    sections = [section or before for section, before in zip(again, sections, strict=True)]
    joint = found_joint(sections)
    if not np.isfinite(joint.direction_covariance).all():
        joint = _with_unknown_direction(finder, joint, looks[0], T_part)
    return joint if kind == "seam" else found_end(finder.geometry, joint, sections, missed, kind)


def _with_unknown_direction(
    finder: Finder, joint: FoundJoint, look: tuple[Frame, Pose], T_part: Float64
) -> FoundJoint:
    """Return a found joint whose covariance takes in that its direction is not known.

    Turned by 1 sigma of a seam's slope, a part would show its seam so far off.
    """
    covariance, middle = joint.covariance_mm2.copy(), np.eye(4)
    middle[:3, 3] = joint.point_base_mm
    for axis in joint.axes_base[1:]:
        T_turn = middle @ moved(np.eye(4), np.degrees(SLOPE_SIGMA) * axis, np.zeros(3)) @ invert(middle)
        turned, _ = finder.section_of(*look, T_turn @ T_part)
        if turned is not None:
            off_mm = joint.axes_base[1:] @ (turned.point_base_mm - joint.point_base_mm)
            covariance[1:, 1:] += np.outer(off_mm, off_mm)
    return replace(joint, covariance_mm2=covariance)


def found_joint(sections: Sequence[JointSection]) -> FoundJoint:
    """Return the straight seam through sections: weighted least squares of y and z over the station.

    The sections of one place see the same grains of speckle and count once. However many there are, place and
    ends of the line are known to `MODEL_SIGMA_MM` alone.
    """
    first, best = sections[0], min(sections, key=lambda section: float(np.trace(section.covariance_mm2)))
    T_joint_base = invert(first.T_base_joint)
    places = _places(sections, T_joint_base)
    weights = np.linalg.inv([covariance for _, covariance in places])
    points = np.array([point for point, _ in places])
    traces = np.trace(weights, axis1=1, axis2=2)
    # About the weighted mean station place and direction are uncorrelated.
    middle_mm = float(traces @ points[:, 0] / traces.sum())
    ways_mm = points[:, 0] - middle_mm
    place_cov = np.linalg.inv(weights.sum(axis=0))
    y_z_mm = place_cov @ np.einsum("nij,nj->i", weights, points[:, 1:])
    direction_cov, slopes = np.diag([math.inf, math.inf]), np.zeros(2)
    if len(places) > 1:
        direction_cov = np.linalg.inv(np.einsum("n,nij->ij", ways_mm**2, weights))
        slopes = direction_cov @ np.einsum("n,nij,nj->i", ways_mm, weights, points[:, 1:] - y_z_mm)
    off_mm = points[:, 1:] - y_z_mm - np.outer(ways_mm, slopes)
    # A seam that bends, or poses that are off, scatter by more than the sections' own sigma.
    spread = float(np.einsum("ni,nij,nj->", off_mm, weights, off_mm)) / max(2 * len(places) - 4, 1)
    span_mm = float(np.ptp(ways_mm))
    place_cov = max(spread, 1.0) * place_cov + MODEL_SIGMA_MM**2 * np.eye(2)
    if len(places) > 1:
        direction_cov = max(spread, 1.0) * direction_cov + 2.0 * (MODEL_SIGMA_MM / span_mm) ** 2 * np.eye(2)
    R_base_joint = first.T_base_joint[:3, :3]
    along = R_base_joint @ np.array([1.0, *slopes])
    covariance = np.zeros((3, 3))
    covariance[0, 0], covariance[1:, 1:] = math.inf, place_cov
    return FoundJoint(
        kind="seam",
        refusal="",
        point_base_mm=transform(first.T_base_joint, np.array([middle_mm, *y_z_mm])),
        axes_base=_axes(along, R_base_joint[:, 2]),
        covariance_mm2=covariance,
        direction_covariance=direction_cov,
        calibration_base_mm=np.mean([section.calibration_base_mm for section in sections], axis=0),
        calibration=first.calibration,
        faces_base=best.faces_base,
        face_sigmas_rad=best.face_sigmas_rad,
        track=best.track,
    )


def found_end(
    geometry: SensorGeometry,
    joint: FoundJoint,
    sections: Sequence[JointSection],
    missed: Sequence[Float64],
    kind: Kind,
) -> FoundJoint:
    """Return the start or end of a found joint: evenly likely between frames with the joint and without it.

    `missed` are the poses (4, 4) of frames that showed no joint. It is refused as "start_not_passed" or
    "end_not_passed" where no such frame lies on that side, or some lie between those with the joint.
    """
    along = joint.axes_base[0]
    sign = -1.0 if kind == "start" else 1.0
    seen_mm = [sign * along @ (section.point_base_mm - joint.point_base_mm) for section in sections]
    missed_mm = []
    for T_base_tool in missed:
        n_x, n_y, n_z, off_mm = geometry.seam_source.plane
        normal = T_base_tool[:3, :3] @ np.array([n_x, n_y, n_z])
        beyond_mm = normal @ (joint.point_base_mm - T_base_tool[:3, 3]) + off_mm
        missed_mm.append(sign * float(-beyond_mm / (normal @ along)))
    last_mm = max(seen_mm)
    if not missed_mm or min(missed_mm) <= last_mm:
        return FoundJoint.refused(kind, f"{kind}_not_passed")
    middle_mm, width_mm = 0.5 * (last_mm + min(missed_mm)), min(missed_mm) - last_mm
    covariance = joint.covariance_mm2.copy()
    covariance[0, 0] = width_mm**2 / 12.0
    if np.isfinite(joint.direction_covariance).all():
        covariance[1:, 1:] += middle_mm**2 * joint.direction_covariance
    point = joint.point_base_mm + sign * middle_mm * along
    return replace(joint, kind=kind, point_base_mm=point, covariance_mm2=covariance)


def found_corner(first: FoundJoint, second: FoundJoint) -> FoundJoint:
    """Return the corner at which two found seams meet: the point that both lines explain best.

    Each line tells the point across it, by its place and its direction. It has the axes of the first. It is
    refused as "direction_unknown" where one of the seams was seen at one place alone, and as "seams_parallel"
    where the lines meet at less than 10 degrees.
    """
    for joint in (first, second):
        if joint.refusal:
            return FoundJoint.refused("corner", joint.refusal)
    if not all(np.isfinite(joint.direction_covariance).all() for joint in (first, second)):
        return FoundJoint.refused("corner", "direction_unknown")
    if np.linalg.norm(np.cross(first.axes_base[0], second.axes_base[0])) < math.sin(math.radians(10.0)):
        return FoundJoint.refused("corner", "seams_parallel")
    point = 0.5 * (first.point_base_mm + second.point_base_mm)
    for _ in range(3):
        information, pull = np.zeros((3, 3)), np.zeros(3)
        for joint in (first, second):
            way_mm = joint.axes_base[0] @ (point - joint.point_base_mm)
            across = joint.axes_base[1:]
            weight = np.linalg.inv(joint.covariance_mm2[1:, 1:] + way_mm**2 * joint.direction_covariance)
            information += across.T @ weight @ across
            pull += across.T @ weight @ across @ joint.point_base_mm
        point = np.asarray(np.linalg.solve(information, pull), np.float64)
    covariance = first.axes_base @ np.linalg.inv(information) @ first.axes_base.T
    return replace(first, kind="corner", point_base_mm=point, covariance_mm2=covariance)


def _axes(along: Float64, up: Float64) -> Float64:
    """Return unit vectors (3, 3) along, to the left and up, one a row; `up` is made perpendicular."""
    across = np.cross(up, along)
    axes = np.array([along, across, np.cross(along, across)])
    return np.asarray(axes / np.linalg.norm(axes, axis=1)[:, np.newaxis])


def _places(sections: Sequence[JointSection], T_joint_base: Float64) -> list[tuple[Float64, Float64]]:
    """Return the mean point (3,), joint frame, and covariance (2, 2) of the sections of each place."""
    points = [transform(T_joint_base, section.point_base_mm) for section in sections]
    order = np.argsort([point[0] for point in points], kind="stable")
    places: list[list[int]] = []
    for n in order:
        if places and points[n][0] - points[places[-1][0]][0] < LOOK_MM:
            places[-1].append(int(n))
        else:
            places.append([int(n)])
    return [
        (
            np.mean([points[n] for n in place], axis=0),
            np.mean([sections[n].covariance_mm2 for n in place], axis=0),
        )
        for place in places
    ]
