"""The robot's pose at the time of a frame, by one causal rule that a replay and a live run share.

A frame waits at most one nominal period for the pose after it. So a later pose counts only if its own time is
within one period of the frame's: a replay, which has every pose, then sees what the live run saw.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from statistics import median
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Float64 = npt.NDArray[np.float64]

ROTATION_TOLERANCE = 1e-3
"""Largest error of a quaternion's norm, and of R Rᵀ against the identity, from a controller's rounding."""


class PoseError(ValueError):
    """A pose that is no pose, or times that run backwards."""


class PoseStatus(Enum):
    """Origin of a pose."""

    INTERPOLATED = "interpolated"
    EXTRAPOLATED = "extrapolated"
    REFUSED = "refused"


class PoseRefusal(Enum):
    """Reason for which there is no pose."""

    TOO_FEW_POSES = "fewer than two poses at or before this time"
    BEFORE_BUFFER = "older than the buffer reaches back"
    GAP = "in or just after a gap between poses"
    POSES_STOPPED = "too long after the last pose"


@dataclass(frozen=True, eq=False)
class PoseAt:
    """Pose at one time; a refused pose is all NaN and says why.

    Attributes
    ----------
    timestamp_s : float
        The time asked for, s.
    status : PoseStatus
        Interpolated, extrapolated or refused.
    refusal : PoseRefusal or None
        Reason of a refusal.
    T_base_tool : array (4, 4)
        The pose: it takes points of the tool frame to base, mm.
    velocity_base_mm_s : array (3,)
        The velocity of the tool's origin, mm/s, base frame.
    angular_velocity_base_rad_s : array (3,)
        The tool's angular velocity, rad/s, base frame.
    period_s : float
        The nominal period of the poses, s.
    """

    timestamp_s: float
    status: PoseStatus
    refusal: PoseRefusal | None
    T_base_tool: Float64
    velocity_base_mm_s: Float64
    angular_velocity_base_rad_s: Float64
    period_s: float


class _Twist(NamedTuple):
    """Two poses, by their places in the buffer, whose steady motion gives the pose at a time, s."""

    first: int
    last: int
    t_s: float
    status: PoseStatus
    period_s: float


class PoseBuffer:
    """The last poses T_base_tool, and the pose at any time among them.

    Parameters
    ----------
    capacity : int
        Number of poses kept, 2 or more.
    max_extrapolation_periods : float
        Largest extrapolation beyond the last pose, in nominal periods.

    Raises
    ------
    ValueError
        For a capacity below 2 and for a negative extrapolation.
    """

    def __init__(self, capacity: int = 1024, max_extrapolation_periods: float = 3.0) -> None:
        if capacity < 2:
            raise ValueError(f"pose buffer capacity {capacity}: two poses are the least to work with")
        if not max_extrapolation_periods >= 0.0:
            raise ValueError(f"max_extrapolation_periods {max_extrapolation_periods}: must not be negative")
        self._capacity = capacity
        self._max_extrapolation_periods = max_extrapolation_periods
        # Twice the room: the poses stay contiguous, and are moved to the front once in `capacity` pushes.
        self._times_s = np.empty(2 * capacity)
        self._positions_base_mm = np.empty((2 * capacity, 3))
        self._quaternions_xyzw = np.empty((2 * capacity, 4))
        self._start = 0
        self._stop = 0
        self._forgot = False

    def __len__(self) -> int:
        return self._stop - self._start

    def push(self, timestamp_s: float, T_base_tool: npt.ArrayLike) -> None:
        """Add a pose as a matrix.

        Parameters
        ----------
        timestamp_s : float
            The pose's time, s.
        T_base_tool : array (4, 4)
            The pose: it takes points of the tool frame to base, mm.

        Raises
        ------
        PoseError
            If it is no rigid pose, or its time is not after that of the last pose.
        """
        pose = np.asarray(T_base_tool, dtype=np.float64)
        if pose.shape != (4, 4):
            raise PoseError(f"pose at {timestamp_s:.6f} s: not a 4x4 matrix with last row 0 0 0 1")
        self.push_all([timestamp_s], pose[np.newaxis])

    def push_all(self, timestamps_s: Sequence[float] | Float64, T_base_tool: Float64) -> None:
        """Add poses `T_base_tool` (n, 4, 4), mm, at `timestamps_s` (n,), faster than by `push`.

        Raises PoseError as `push` does, for the first pose that it refuses, and where the lengths differ.
        """
        if len(timestamps_s) != len(T_base_tool):
            raise PoseError(f"{len(timestamps_s)} times for {len(T_base_tool)} poses")
        rotations = T_base_tool[:, :3, :3]
        with np.errstate(invalid="ignore", over="ignore"):
            off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
            is_turn = (off <= ROTATION_TOLERANCE) & (np.linalg.det(rotations) > 0.0)
        is_whole = (T_base_tool[:, 3] == (0.0, 0.0, 0.0, 1.0)).all(axis=1)
        n_rigid = int(np.append(~(is_turn & is_whole), True).argmax())
        quaternions = Rotation.from_matrix(rotations[:n_rigid]).as_quat() if n_rigid else []
        for timestamp_s, pose, quaternion in zip(timestamps_s, T_base_tool, quaternions, strict=False):
            self.push_quaternion(float(timestamp_s), pose[:3, 3], quaternion)
        if n_rigid < len(is_whole):
            problem = "its 3x3 part is no rotation"
            if not is_whole[n_rigid]:
                problem = "not a 4x4 matrix with last row 0 0 0 1"
            raise PoseError(f"pose at {timestamps_s[n_rigid]:.6f} s: {problem}")

    def push_quaternion(
        self, timestamp_s: float, position_base_mm: npt.ArrayLike, quaternion_xyzw: npt.ArrayLike
    ) -> None:
        """Add a pose as position and quaternion.

        Parameters
        ----------
        timestamp_s : float
            The pose's time, s.
        position_base_mm : array (3,)
            The tool's position, mm, base frame.
        quaternion_xyzw : array (4,)
            The tool's rotation in base, as a unit quaternion x y z w.

        Raises
        ------
        PoseError
            If a value is not finite, the quaternion's norm is not 1, or the time is not after that of the
            last pose.
        """
        position = np.asarray(position_base_mm, dtype=np.float64)
        quaternion = np.asarray(quaternion_xyzw, dtype=np.float64)
        if position.shape != (3,) or quaternion.shape != (4,):
            raise PoseError(f"pose at {timestamp_s:.6f} s: needs 3 coordinates and 4 quaternion components")
        if not (np.isfinite(timestamp_s) and np.isfinite(position).all() and np.isfinite(quaternion).all()):
            raise PoseError(f"pose at {timestamp_s:.6f} s: a value is not finite; leave unknown poses out")
        norm = float(np.linalg.norm(quaternion))
        if abs(norm - 1.0) > ROTATION_TOLERANCE:
            raise PoseError(
                f"pose at {timestamp_s:.6f} s: quaternion norm {norm:.6g} is not 1, so it is no rotation"
            )
        if len(self) and timestamp_s <= self._times_s[self._stop - 1]:
            last_s = self._times_s[self._stop - 1]
            raise PoseError(
                f"pose times run backwards: {timestamp_s:.6f} s after {last_s:.6f} s; sort the poses"
            )
        self._make_room()
        self._times_s[self._stop] = timestamp_s
        self._positions_base_mm[self._stop] = position
        self._quaternions_xyzw[self._stop] = quaternion / norm
        self._stop += 1

    def at(self, t_s: float) -> PoseAt:
        """Return the pose at a time.

        It is interpolated where the next pose is known and lies within one nominal period of `t_s`: the
        position linearly, the rotation along the arc. Else it is extrapolated at constant velocity and
        angular velocity, at most `max_extrapolation_periods` beyond the last pose at or before `t_s`. Else it
        is refused: a lack of poses never raises.

        Parameters
        ----------
        t_s : float
            The time, s, on the clock of the pushed poses.

        Returns
        -------
        PoseAt
            The pose, or why there is none.

        Raises
        ------
        ValueError
            If `t_s` is not finite.
        """
        return self.at_all((t_s,))[0]

    def at_all(self, times_s: Sequence[float]) -> list[PoseAt]:
        """Return the poses of `at` at many times, in any order, in a fraction of its time.

        Raises ValueError if a time is not finite.
        """
        answers = [self._answer(t_s) for t_s in times_s]
        twists = [answer for answer in answers if isinstance(answer, _Twist)]
        moved = iter(self._along(twists))
        return [next(moved) if isinstance(answer, _Twist) else answer for answer in answers]

    def _answer(self, t_s: float) -> PoseAt | _Twist:
        """Return the two poses that give that at a time, or the refusal."""
        if not math.isfinite(t_s):
            raise ValueError(f"pose asked for at {t_s}: the time must be finite")
        times_s = self._times_s[self._start : self._stop]
        known = int(times_s.searchsorted(t_s, side="right"))
        if known < 2:
            refusal = PoseRefusal.BEFORE_BUFFER if self._forgot else PoseRefusal.TOO_FEW_POSES
            return _refusal(t_s, refusal, np.nan)
        # From poses at or before t alone: what comes later must not change the answer for t.
        until_t_s = times_s[max(0, known - 32) : known].tolist()
        period_s = median(after - before for before, after in pairwise(until_t_s))
        last = known - 1
        if known < times_s.size and times_s[known] <= t_s + period_s:
            last = known
        last_s, before_s = float(times_s[last]), float(times_s[last - 1])
        beyond_s = t_s - last_s
        if beyond_s > self._max_extrapolation_periods * period_s:
            return _refusal(t_s, PoseRefusal.POSES_STOPPED, period_s)
        # Poses further apart say nothing of the time between them.
        if last_s - before_s > 4.0 * period_s and beyond_s != 0.0:
            return _refusal(t_s, PoseRefusal.GAP, period_s)
        if beyond_s > 0.0:
            # Two poses almost at once say nothing about speed: over so little time rounding looks like it.
            apart = int(times_s.searchsorted(times_s[last] - 0.5 * period_s, side="right")) - 1
            first = min(apart, last - 1)
            return _Twist(first, last, t_s, PoseStatus.EXTRAPOLATED, period_s)
        return _Twist(last - 1, last, t_s, PoseStatus.INTERPOLATED, period_s)

    def _along(self, twists: Sequence[_Twist]) -> Iterator[PoseAt]:
        if not twists:
            return
        first, last = self._start + np.array([(twist.first, twist.last) for twist in twists]).T
        dt_s = (self._times_s[last] - self._times_s[first])[:, np.newaxis]
        beyond_s = np.array([twist.t_s for twist in twists])[:, np.newaxis] - self._times_s[last, np.newaxis]
        R_last = Rotation.from_quat(self._quaternions_xyzw[last])
        R_first = Rotation.from_quat(self._quaternions_xyzw[first])
        velocities_base_mm_s = (self._positions_base_mm[last] - self._positions_base_mm[first]) / dt_s
        angular_velocities_base_rad_s = (R_last * R_first.inv()).as_rotvec() / dt_s
        T_base_tool = np.tile(np.eye(4), (len(twists), 1, 1))
        T_base_tool[:, :3, :3] = (
            Rotation.from_rotvec(angular_velocities_base_rad_s * beyond_s) * R_last
        ).as_matrix()
        T_base_tool[:, :3, 3] = self._positions_base_mm[last] + velocities_base_mm_s * beyond_s
        for n, twist in enumerate(twists):
            yield PoseAt(
                timestamp_s=twist.t_s,
                status=twist.status,
                refusal=None,
                T_base_tool=T_base_tool[n],
                velocity_base_mm_s=velocities_base_mm_s[n],
                angular_velocity_base_rad_s=angular_velocities_base_rad_s[n],
                period_s=twist.period_s,
            )

    def _make_room(self) -> None:
        if self._stop == 2 * self._capacity:
            for rows in (self._times_s, self._positions_base_mm, self._quaternions_xyzw):
                rows[: self._capacity - 1] = rows[self._stop - self._capacity + 1 : self._stop]
            self._start, self._stop = 0, self._capacity - 1
        elif len(self) == self._capacity:
            self._start += 1
            self._forgot = True


def _refusal(t_s: float, refusal: PoseRefusal, period_s: float) -> PoseAt:
    return PoseAt(
        timestamp_s=t_s,
        status=PoseStatus.REFUSED,
        refusal=refusal,
        T_base_tool=np.full((4, 4), np.nan),
        velocity_base_mm_s=np.full(3, np.nan),
        angular_velocity_base_rad_s=np.full(3, np.nan),
        period_s=period_s,
    )
