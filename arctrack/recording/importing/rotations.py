"""Rotations as controllers write them, by name.

Sources: scipy's `Rotation.from_euler` for sequences; Basler's pose formats of robots (KUKA, Fanuc, Yaskawa,
ABB, UR); RoboDK's `robomath` (Stäubli, and all of these); Mech-Mind's table of Euler angles by brand.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.errors import ArctrackError
from arctrack.recording.importing.units import UNSTATED, Units
from noise_model.compiled.arrays import Float64

MATRIX = "matrix"


class NoRotationError(ValueError):
    """Error in the numbers of a rotation; `row`, counted from 0, is its row."""

    def __init__(self, row: int, problem: str) -> None:
        super().__init__(problem)
        self.row = row


@dataclass(frozen=True)
class Convention:
    """Notation of a rotation.

    `columns` are the names that a header may give its numbers, set by set; --column takes the first set.
    `are_angles` says whether they have a unit. `matrices` makes rotations (n, 3, 3) of numbers (n, columns),
    angles in rad, and raises NoRotationError. `units` are those of the controller that is named so.
    """

    columns: tuple[tuple[str, ...], ...]
    are_angles: bool
    matrices: Callable[[Float64], Float64]
    units: Units = UNSTATED


def rotation_matrices(blocks: Float64) -> Float64:
    """Return the nearest rotations of matrices (n, 3, 3); NoRotationError for the first that is none."""
    skew = np.abs(blocks @ blocks.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    # Largest error of R Rᵀ against the identity, as `robot_io.PoseBuffer` takes it.
    for n in np.flatnonzero(skew > 1e-3).tolist():
        raise NoRotationError(n, f"is no rotation: R Rᵀ is off the identity by {skew[n]:.2g}")
    for n in np.flatnonzero(np.linalg.det(blocks) < 0.0).tolist():
        raise NoRotationError(n, "is no rotation: it mirrors")
    return np.asarray(Rotation.from_matrix(blocks).as_matrix())


def _quaternions(xyzw: Float64) -> Float64:
    norms = np.linalg.norm(xyzw, axis=1)
    # Largest error of a quaternion's norm: controllers write a few digits.
    for n in np.flatnonzero(~(np.abs(norms - 1.0) <= 0.01)).tolist():
        raise NoRotationError(n, f"the quaternion's norm is {norms[n]:.4f}, not 1: it is no rotation")
    return np.asarray(Rotation.from_quat(xyzw).as_matrix())


def _by_sequence(sequence: str) -> Callable[[Float64], Float64]:
    def matrices(angles_rad: Float64) -> Float64:
        return np.asarray(Rotation.from_euler(sequence, angles_rad).as_matrix())

    return matrices


def _real_first(numbers: Float64) -> Float64:
    return _quaternions(numbers[:, [1, 2, 3, 0]])


def _by_vector(turns_rad: Float64) -> Float64:
    return np.asarray(Rotation.from_rotvec(turns_rad).as_matrix())


_BY_LETTER = (
    ("qx", "qy", "qz", "qw"),
    ("quat_x", "quat_y", "quat_z", "quat_w"),
    ("q_x", "q_y", "q_z", "q_w"),
)
_REAL_BY_LETTER = tuple((w, x, y, z) for x, y, z, w in _BY_LETTER)
_BY_NUMBER = (("q1", "q2", "q3", "q4"), ("q0", "q1", "q2", "q3"))
_TURNS = (("rx", "ry", "rz"),)
_MM_DEG, _M_RAD = Units(length="mm", angle="deg"), Units(length="m", angle="rad")

BY_ITS_NAMES = Convention(_BY_LETTER, False, _quaternions)
"""A quaternion whose columns say which is which: nothing need be stated."""

CONVENTIONS = {
    "xyzw": Convention((*_BY_LETTER, *_BY_NUMBER), False, _quaternions),
    "wxyz": Convention((*_REAL_BY_LETTER, *_BY_NUMBER), False, _real_first),
    "rotvec": Convention(_TURNS, True, _by_vector),
    "abb": Convention((*_BY_NUMBER, *_REAL_BY_LETTER), False, _real_first, Units(length="mm")),
    "fanuc": Convention((("w", "p", "r"),), True, _by_sequence("xyz"), _MM_DEG),
    "kuka": Convention((("a", "b", "c"),), True, _by_sequence("ZYX"), _MM_DEG),
    "staubli": Convention(_TURNS, True, _by_sequence("XYZ"), _MM_DEG),
    # Universal Robots' client of RTDE has names of its own.
    "ur": Convention(
        (*_TURNS, ("actual_tcp_pose_3", "actual_tcp_pose_4", "actual_tcp_pose_5")), True, _by_vector, _M_RAD
    ),
    "yaskawa": Convention(_TURNS, True, _by_sequence("xyz"), _MM_DEG),
}
"""Named conventions. R takes points of the tool frame to base; primes are axes that have turned along.

xyzw, wxyz: a unit quaternion. rotvec, ur: axis times angle. abb: a quaternion, its real part q1.
fanuc: R = Rz(R) Ry(P) Rx(W). kuka: R = Rz(A) Ry(B) Rx(C), Z Y' X''. staubli: R = Rx Ry Rz, X Y' Z''.
yaskawa: R = Rz Ry Rx.
"""

_SEQUENCE = re.compile(r"(?:([xyz])(?!\1)([xyz])(?!\2)([xyz]))|(?:([XYZ])(?!\4)([XYZ])(?!\5)([XYZ]))")


def convention(name: str) -> Convention:
    """Return the convention of a name, or of a sequence of axes; ArctrackError if there is none.

    A sequence reads as in scipy: xyz turns about base's fixed axes, XYZ about axes that turn along.
    """
    known = CONVENTIONS.get(name)
    if known is not None:
        return known
    if not _SEQUENCE.fullmatch(name):
        names = ", ".join((*CONVENTIONS, MATRIX))
        raise ArctrackError(
            f"--rotation {name}: there are {names}, and sequences of axes such as ZYX (turning along) or xyz "
            "(fixed)"
        )
    axes = tuple(f"r{axis}" for axis in name.lower())
    in_order = ("angle_1", "angle_2", "angle_3")
    columns = (axes, in_order) if len(set(axes)) == 3 else (in_order,)
    return Convention(columns, True, _by_sequence(name))
