"""How well finds on a displaced part shift its program: displaced parts at random, drawn or rendered finds.

    python benchmarks/part_shift.py --parts 200
    python benchmarks/part_shift.py --parts 10 --rendered

A part is a box of seams on the faces of a block, each with its plates. Its displacement is up to 20 mm and 5
deg. The finds' errors are drawn with the tracker's sigma, or come from the tracker on rendered frames. Torch
errors are those of the program's points by the true displacement, which the estimator never sees.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.nominal import nominal_setup
from arctrack.simulation.simulate import balance
from calibration.part_shift import PartPoint, ShiftError, find_shift
from noise_model.compiled.arrays import Float64
from noise_model.condition import Condition
from noise_model.forward import predict
from noise_model.instrument.sensor import expose
from noise_model.setup_keys import Tolerance
from noise_model.transforms import invert, transform
from tracker.find import Finder, FoundJoint, find_joint
from tracker.geometry import SensorGeometry
from tracker.state import Frame, Pose

SIGMA_MM, DIRECTION_SIGMA, FACE_SIGMA_RAD = 0.012, 0.0007, 0.0002
"""The tracker's own on two places 20 mm apart (`tests/tracker/test_find.py`)."""

CALIBRATED = Tolerance(hand_eye_deg=0.02, hand_eye_mm=0.05)
"""The tolerance that is stated of a calibrated sensor. Its part in both finds is turned by the part alone."""

WITHIN_MM = 0.1


def displacement(rng: np.random.Generator) -> Float64:
    """Draw a displacement of up to 20 mm and 5 deg about the part's middle."""
    T = np.eye(4)
    axis, way = rng.normal(size=(2, 3))
    T[:3, :3] = Rotation.from_rotvec(
        rng.uniform(0, 5) * axis / np.linalg.norm(axis), degrees=True
    ).as_matrix()
    T[:3, 3] = rng.uniform(0, 20) * way / np.linalg.norm(way)
    middle = np.array([200.0, 150.0, 30.0])
    T[:3, 3] += middle - T[:3, :3] @ middle
    return T


def seams(rng: np.random.Generator, count: int) -> list[tuple[Float64, Float64]]:
    """Draw places and axes (along, left, up) of points on seams of a block of 400 x 300 x 60 mm."""
    drawn = []
    for n in range(count):
        along = (
            np.eye(3)[n % 2]
            if n < 2 or rng.random() < 0.7
            else Rotation.random(random_state=rng).as_matrix()[0]
        )
        along = along * np.array([1.0, 1.0, 0.2])
        along /= np.linalg.norm(along)
        left = np.cross([0.0, 0.0, 1.0], along)
        left /= np.linalg.norm(left)
        place = rng.uniform([0, 0, 0], [400, 300, 60])
        drawn.append((place, np.array([along, left, np.cross(along, left)])))
    return drawn


def drawn_find(
    place: Float64, axes: Float64, T: Float64, kind: str, rng: np.random.Generator, slide_mm: float
) -> FoundJoint:
    """Draw the find of a seam's point on a displaced part; `slide_mm` along it the sensor meets the seam."""
    A = axes @ T[:3, :3].T
    C = np.diag([0.02**2, SIGMA_MM**2, SIGMA_MM**2])
    point = T[:3, :3] @ (place + (slide_mm * axes[0] if kind == "seam" else 0.0)) + T[:3, 3]
    noise = rng.normal(size=3) * np.sqrt(np.diag(C))
    if kind == "seam":
        C[0, 0], noise[0] = np.inf, 0.0
    turn = rng.normal(size=2) * DIRECTION_SIGMA
    along = A[0] + turn @ A[1:]
    faces = np.array([A[1] + rng.normal() * FACE_SIGMA_RAD * A[2] for _ in range(2)])
    calibration = np.array([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.2]])
    return FoundJoint(
        kind=kind,
        refusal="",
        point_base_mm=point + noise @ A,
        axes_base=np.array([along / np.linalg.norm(along), A[1], np.cross(along, A[1])]),
        covariance_mm2=C,
        direction_covariance=DIRECTION_SIGMA**2 * np.eye(2),
        calibration_base_mm=calibration,
        calibration="one",
        faces_base=faces,
        face_sigmas_rad=np.full(2, FACE_SIGMA_RAD),
        track=None,
    )


def rendered_find(axes: Float64, place: Float64, T: Float64, finder: Finder, seed: int) -> FoundJoint:
    """Render a seam on a displaced part by two frames, as the nominal seam from displaced poses, and find it.

    The robot drives to where a first search has put the part, to the next 8 mm.
    """
    setup = finder.geometry.setup
    T_part_line = np.eye(4)
    T_part_line[:3, :3], T_part_line[:3, 3] = axes.T, place
    displaced = invert(T_part_line) @ T @ T_part_line
    shown = []
    for n, x_mm in enumerate((165.0, 185.0)):
        T_line_tool = np.eye(4)
        T_line_tool[:3, 3] = x_mm - 210.0, *(8.0 * np.round(displaced[1:3, 3] / 8.0))
        T_seen = invert(displaced) @ T_line_tool
        condition = Condition(laser_level=1.0, arc_level=0.0, exposure_s=setup.camera.exposure_s)
        mean_e = predict(setup, T_seen, condition).mean_e
        image = expose(mean_e, setup.sensor, np.random.default_rng(seed + n))
        frame = Frame(n, 0.1 * n, image, setup.camera.exposure_s, arc_on=False)
        shown.append((frame, Pose(T_line_tool)))
    joint, R = find_joint(finder, shown), T_part_line[:3, :3]
    return replace(
        joint,
        point_base_mm=transform(T_part_line, joint.point_base_mm),
        axes_base=joint.axes_base @ R.T,
        faces_base=joint.faces_base @ R.T,
        calibration_base_mm=joint.calibration_base_mm @ R.T,
    )


class Tally:
    """What became of the shifts of one kind: errors of the torch, mm, ends, and why they were refused."""

    def __init__(self) -> None:
        self.ends: Counter[str] = Counter()
        self.errors_mm: list[float] = []
        self.refusals: Counter[str] = Counter()

    def take(
        self, points: list[PartPoint], program: Float64, T: Float64, wrong: str, within_mm: float
    ) -> None:
        """Shift a part and judge it by its true displacement; `wrong` names the wrong point, or is empty."""
        try:
            shift = find_shift(points, program, within_mm)
        except ShiftError as error:
            text = str(error)
            named = bool(wrong) and text.startswith(f"{wrong} is wrong")
            self.ends["refused, the wrong point named" if named else "refused"] += 1
            self.refusals[
                re.sub(r"\bp\d\b|\(.*?\)", "…", re.split("; | about the axis| along", text)[0])
            ] += 1
            return
        true, got = (transform(M, program) for M in (T, shift.T_shift))
        self.errors_mm.append(float(np.linalg.norm(got - true, axis=1).max()))
        name = "" if shift.wrong is None else shift.wrong.name
        kind = "all points agree" if not name else "named rightly" if name == wrong else "named wrongly"
        self.ends[f"shifted, {kind}"] += 1
        self.ends[f"shifted, torch off by more than {within_mm:g} mm"] += self.errors_mm[-1] > within_mm

    def print(self, name: str) -> None:
        """Print what became of them."""
        print(name)
        for end, times in sorted(self.ends.items()):
            print(f"  {times:4d} {end}")
        if self.errors_mm:
            median, high = np.quantile(self.errors_mm, (0.5, 0.99))
            largest = max(self.errors_mm)
            print(f"  torch error: median {median:.3f}, 99 % {high:.3f}, largest {largest:.3f} mm")
        for text, times in self.refusals.most_common(6):
            print(f"  {times:4d} refused as: {text}")


def with_error(point: PartPoint, rng: np.random.Generator) -> PartPoint:
    """Return a point whose find is off across its seam by 0.5 to 5 mm, at random."""
    axes = point.part.axes_base
    angle, size_mm = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.5, 5.0)
    off_mm = size_mm * (np.cos(angle) * axes[1] + np.sin(angle) * axes[2])
    return point._replace(part=replace(point.part, point_base_mm=point.part.point_base_mm + off_mm))


def main() -> None:
    """Print how many programs were shifted, how well, and what became of wrong finds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--parts", type=int, default=200)
    parser.add_argument("--rendered", action="store_true", help="find in rendered frames")
    parser.add_argument("--joint", default="v_groove", help="of rendered frames")
    parser.add_argument("--within-mm", type=float, default=WITHIN_MM)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    finder = None
    if given.rendered:
        setup = balance(nominal_setup(given.joint, "mild_steel", width=320, height=240))
        setup = replace(setup, tolerance=CALIBRATED)
        finder = Finder(SensorGeometry.of(setup))
    right, wrong, refused = Tally(), Tally(), 0
    for n in range(given.parts):
        rng = np.random.default_rng([given.seed, n])
        T, drawn, points = displacement(rng), seams(rng, int(rng.integers(3, 7))), []
        program = np.array([place + way * axes[0] for place, axes in drawn for way in (-60.0, 0.0, 60.0)])
        for k, (place, axes) in enumerate(drawn):
            kind = "seam" if finder is not None or rng.random() < 0.6 else "end"
            both = [
                drawn_find(place, axes, M, kind, rng, rng.uniform(-20, 20) * m)
                if finder is None
                else rendered_find(axes, place, M, finder, 1000 * n + 10 * k + 5 * m)
                for m, M in enumerate((np.eye(4), T))
            ]
            refused += any(joint.refusal for joint in both)
            if not any(joint.refusal for joint in both):
                points.append(PartPoint(f"p{k}", *both))
        if not points:
            continue
        right.take(points, program, T, "", given.within_mm)
        k = int(rng.integers(len(points)))
        points[k] = with_error(points[k], rng)
        wrong.take(points, program, T, points[k].name, given.within_mm)
    print(f"{given.parts} parts, {refused} finds refused")
    right.print("all finds right")
    wrong.print("one find wrong by 0.5 to 5 mm")


if __name__ == "__main__":
    main()
