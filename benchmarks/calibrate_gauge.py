"""Judge `arctrack calibrate gauge`: benchmarks/calibrate_gauge.py [--worlds N] [--seed S] [--rendered M]

A random camera and sheet on a tool see a V or a step, 6 to 16 times. The stripe's pieces are lines in the
image whose points scatter by 0.05 to 0.4 px. The robot is off by 0.01 to 0.1 mm, each piece by 0.002 to 0.02
mm, the gauge's size by 0.01 mm, a step's edge by 0.2 mm in each image. The sheet stated beforehand is a
degree and 0.5 mm off. The bound is Cramér and Rao's for these lines, in the image. With --rendered so many
worlds are drawn as pictures by examples/make_gauge.py, whose camera and sheet are always the same.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from calibration_tally import Tally
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from calibration.camera.enough import UndeterminedError
from calibration.camera.lens import Lens
from calibration.gauge.calibrate import GaugeCalibration, calibrate_gauge
from calibration.gauge.shape import Gauge, Shape
from calibration.gauge.sightings import PosedPieces, StatedSensor
from calibration.gauge.stripe_pieces import Piece, Pieces, stripe_pieces
from calibration.laser.image_line import fit_line
from calibration.laser.plane import with_plane
from noise_model.compiled.arrays import Float64
from noise_model.instrument.laser import Laser

sys.path.append(str(Path(__file__).parents[1] / "examples"))

import make_gauge

WIDTH, HEIGHT = 1280, 960
UP = np.array([0.0, 0.0, 1.0])
SIZE_SIGMA_MM, EDGE_SIGMA_MM = 0.01, 0.2
REACH_MM = 12.0
"""How far the stripe reaches to either side of the gauge's middle."""

NAMES = ("lean along", "lean about", "place")
STEPS = np.array([1e-6, 1e-6, 1e-4, *[1e-6] * 3, *[1e-4] * 3])


def laser_in(plane: Float64) -> Laser:
    """Return a laser whose sheet is a plane (4,) of the tool frame."""
    upright = Laser(660.0, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 300.0), 0.25, 1000.0)
    return with_plane(upright, plane)


@dataclass(frozen=True)
class World:
    """What is to be found, and all that it is seen by; lengths in mm.

    `sheet` (4,) is in the tool frame.
    """

    focal_px: float
    T_tool_camera: Float64
    sheet: Float64
    T_base_gauge: Float64
    size: float
    gauge: Gauge

    def faces(self) -> list[tuple[Float64, Float64, float, float]]:
        """Return a point, a normal, and from which y to which each face goes."""
        h = self.size
        if self.gauge.shape is Shape.STEP:
            return [(np.zeros(3), UP, -REACH_MM, 0.0), (np.array([0.0, 0.0, -h]), UP, 0.0, REACH_MM)]
        half = math.radians(0.5 * self.gauge.angle_deg)
        s, c = math.sin(half), math.cos(half)
        mouth, root = h * s / c, np.array([0.0, 0.0, -h])
        reach = mouth + REACH_MM
        return [
            (np.zeros(3), UP, -reach, -mouth),
            (root, np.array([0.0, c, s]), -mouth, 0.0),
            (root, np.array([0.0, -c, s]), 0.0, mouth),
            (np.zeros(3), UP, mouth, reach),
        ]

    def seen(self, T_base_tool: Float64, n: int, y: Float64) -> Float64:
        """Return where the stripe is seen (m, 2), px, on a face, at places across the gauge (m,)."""
        point, m, _, _ = self.faces()[n]
        to_gauge = np.linalg.inv(self.T_base_gauge) @ T_base_tool
        normal = to_gauge[:3, :3] @ self.sheet[:3]
        offset = self.sheet[3] - normal @ to_gauge[:3, 3]
        z = point[2] - m[1] * (y - point[1]) / m[2]
        x = -(offset + normal[1] * y + normal[2] * z) / normal[0]
        to_camera = np.linalg.inv(to_gauge @ self.T_tool_camera)
        places = np.column_stack([x, y, z]) @ to_camera[:3, :3].T + to_camera[:3, 3]
        return self.focal_px * places[:, :2] / places[:, 2:] + 0.5 * np.array([WIDTH - 1.0, HEIGHT - 1.0])

    def moved(self, step: Float64) -> World:
        """Return the world after a step of sheet (3) and gauge (three turns, y, z, and its size)."""
        leans = leans_of(self.sheet)
        n = self.sheet[:3] + step[:2] @ leans
        T = self.T_base_gauge.copy()
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(step[3:6]).as_matrix()
        T[:3, 3] += T[:3, 1:3] @ step[6:8]
        sheet = np.array([*(n / np.linalg.norm(n)), self.sheet[3] + step[2]])
        return replace(self, sheet=sheet, T_base_gauge=T, size=self.size + step[8])


@dataclass(frozen=True)
class Noise:
    """1 sigma of the stripe's points, px, of the robot and of each piece, mm."""

    point_px: float
    robot_mm: float
    form_mm: float


def leans_of(sheet: Float64) -> Float64:
    """Return two directions (2, 3) towards which a sheet leans: along the stripe, and down the sheet."""
    along = np.cross(UP, sheet[:3])
    along = along / np.linalg.norm(along)
    return np.stack([along, np.cross(sheet[:3], along)])


def pose(R: Float64, t: Float64) -> Float64:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def turned(about_x: float, about_y: float, about_z: float) -> Float64:
    return np.asarray(
        Rotation.from_euler("xyz", [about_x, about_y, about_z], degrees=True).as_matrix(), dtype=np.float64
    )


def draw_world(rng: np.random.Generator) -> World:
    """Return a random world: a sheet some 35 mm ahead of the tool, and a camera 100 to 200 mm from there."""
    gauge = (
        Gauge(Shape.STEP, float(rng.uniform(3.0, 10.0)))
        if rng.random() < 0.5
        else Gauge(Shape.V, float(rng.uniform(3.0, 8.0)), float(rng.uniform(60.0, 120.0)))
    )
    sheet_x = rng.uniform(20.0, 50.0)
    lean = turned(0.0, rng.uniform(-15.0, 15.0), rng.uniform(-10.0, 10.0)) @ np.array([1.0, 0.0, 0.0])
    middle = np.array([sheet_x, 0.0, 0.0])
    away, distance = math.radians(rng.uniform(20.0, 45.0)), rng.uniform(100.0, 200.0)
    sight = np.array([-math.sin(away), 0.0, -math.cos(away)])
    right = np.array([0.0, 1.0, 0.0])
    R = np.column_stack([right, np.cross(sight, right), sight]) @ turned(*rng.uniform(-5.0, 5.0, 3))
    camera = pose(R, middle - distance * sight)
    focal = rng.uniform(0.8, 1.2) * 0.7 * WIDTH * distance / (3.0 * REACH_MM)
    T_base_gauge = pose(
        turned(*rng.uniform(-4.0, 4.0, 2), rng.uniform(-20.0, 20.0)), rng.uniform(-300, 300, 3)
    )
    sheet = np.array([*lean, -lean @ middle])
    return World(focal, camera, sheet, T_base_gauge, gauge.size_mm + SIZE_SIGMA_MM * rng.normal(), gauge)


def draw_poses(world: World, rng: np.random.Generator) -> list[Float64]:
    """Return the robot's true poses: raised, tilted, turned, and in half of the worlds by half a turn too."""
    middle = np.array([-world.sheet[3] / world.sheet[0], 0.0, 0.0])
    at = world.T_base_gauge[:3, 3]
    halves = rng.random() < 0.5
    poses = []
    for _ in range(int(rng.integers(6, 17))):
        spin = rng.uniform(-35.0, 35.0) + (180.0 if halves and rng.random() < 0.5 else 0.0)
        R = turned(*rng.uniform(-15.0, 15.0, 2), spin)
        shift = np.array([*rng.uniform(-2.0, 2.0, 2), rng.uniform(-8.0, 8.0)])
        poses.append(pose(R, at + shift - R @ middle))
    return poses


def draw_shown(
    world: World, T: Float64, noise: Noise, name: str, rng: np.random.Generator
) -> tuple[PosedPieces, Float64]:
    """Return an image's pieces with the pose stated, and its information (9, 9) of the unknowns."""
    pieces, rows, variances, by_form = [], [], [], []
    lens = Lens.simple(WIDTH, HEIGHT, world.focal_px)
    count = len(world.faces())
    for n, (_, _, low, high) in enumerate(world.faces()):
        ends = world.seen(T, n, np.array([low, high]))
        first, last = sorted(ends[:, 0].tolist())
        columns = np.arange(math.ceil(first) + 3.0, math.floor(last) - 2.0)
        slope = (ends[1, 1] - ends[0, 1]) / (ends[1, 0] - ends[0, 0])
        image = np.column_stack([columns, ends[0, 1] + slope * (columns - ends[0, 0])])
        risen = replace(world, T_base_gauge=world.T_base_gauge @ pose(np.eye(3), 1e-3 * world.faces()[n][1]))
        middle = np.array([0.5 * (low + high)])
        per_mm = 1e3 * float((risen.seen(T, n, middle) - world.seen(T, n, middle))[0] @ [-slope, 1.0])
        by_form.append(per_mm)
        image[:, 1] += (
            noise.point_px * rng.standard_normal(len(image)) + noise.form_mm * per_mm * rng.normal()
        )
        line = fit_line(lens.rays(image), along_rows=True)
        ordered = ends[np.argsort(ends[:, 0])]
        spread = float(np.std(columns))
        places = np.mean(columns) + spread * np.array([-1.0, 1.0])
        rows.append((n, places))
        variances += [2.0 * noise.point_px**2 / len(columns)] * 2
        if world.gauge.shape is Shape.STEP and n == 0:
            # The edge is broken: the stripe's end is off along the piece.
            edge = world.seen(T, 0, np.array([EDGE_SIGMA_MM * rng.normal()]))[0]
            ordered[int(np.argmin(np.abs(ordered[:, 0] - ends[1, 0])))] = edge
        pieces.append(Piece(image, line, ordered[0], ordered[-1]))
    pieces.sort(key=lambda piece: float(piece.points_px[:, 0].mean()))
    stated = T.copy()
    stated[:3, 3] += noise.robot_mm * rng.standard_normal(3)
    if world.gauge.shape is Shape.STEP:
        px = float(np.diff(world.seen(T, 0, np.array([-0.5, 0.5]))[:, 0])[0])
        variances.append((EDGE_SIGMA_MM * px) ** 2)

    def predicted(other: World, T_base_tool: Float64) -> Float64:
        values = []
        for n, places in rows:
            _, _, low, high = other.faces()[n]
            (u1, v1), (u2, v2) = other.seen(T_base_tool, n, np.array([low, high]))
            values += [v1 + (v2 - v1) / (u2 - u1) * (u - u1) for u in places]
        if count == 2:
            values.append(other.seen(T_base_tool, 0, np.zeros(1))[0, 0])
        return np.array(values)

    def slopes(steps: Float64, what: str) -> Float64:
        columns = []
        for n, size in enumerate(steps):
            sides = []
            for sign in (1.0, -1.0):
                step = np.zeros(len(steps))
                step[n] = sign * size
                if what == "world":
                    sides.append(predicted(world.moved(step), T))
                else:
                    moved = T.copy()
                    moved[:3, 3] += step
                    sides.append(predicted(world, moved))
            columns.append((sides[0] - sides[1]) / (2.0 * size))
        return np.column_stack(columns)

    J, by_robot = slopes(STEPS, "world"), slopes(np.full(3, 1e-4), "robot")
    C = np.diag(variances) + noise.robot_mm**2 * by_robot @ by_robot.T
    for n, per_mm in enumerate(by_form):
        C[2 * n : 2 * n + 2, 2 * n : 2 * n + 2] += (noise.form_mm * per_mm) ** 2
    return PosedPieces(name, Pieces(tuple(pieces), True, 3.0), stated), J.T @ np.linalg.solve(C, J)


def judge(seed: int, tally: Tally, reasons: Counter[str]) -> None:
    """Draw a world, find its sheet, and add the errors."""
    rng = np.random.default_rng(seed)
    world = draw_world(rng)
    robot_mm, form_mm = np.exp(rng.uniform(np.log([0.01, 0.002]), np.log([0.1, 0.02]))).tolist()
    noise = Noise(float(rng.uniform(0.05, 0.4)), robot_mm, form_mm)
    drawn = [draw_shown(world, T, noise, f"{n}", rng) for n, T in enumerate(draw_poses(world, rng))]
    off = np.array([*(np.radians(1.0) * rng.standard_normal(2)), 0.5 * rng.normal(), *np.zeros(6)])
    stated = world.moved(off).sheet
    lens = Lens.simple(WIDTH, HEIGHT, world.focal_px)
    shown = [posed for posed, _ in drawn]
    try:
        result = calibrate_gauge(
            shown, world.gauge, StatedSensor(lens, world.T_tool_camera, laser_in(stated)), UP
        )
    except UndeterminedError as error:
        reasons[str(error).split(":")[0][-60:]] += 1
        return
    reasons["images left out"] += len(result.left_out)
    F = sum(information for _, information in drawn)
    F[8, 8] += SIZE_SIGMA_MM**-2.0
    # `moved` shifts d; the place is that amid the points.
    rows = rows_of(world.sheet, result.fitted.state.centre_mm)
    per_step = np.zeros((4, 9))
    for n in range(3):
        step = np.zeros(9)
        step[n] = STEPS[n]
        per_step[:, n] = (world.moved(step).sheet - world.moved(-step).sheet) / (2.0 * STEPS[n])
    bound = np.sqrt(np.diag(rows @ per_step @ np.linalg.inv(F) @ per_step.T @ rows.T))
    add(tally, result, world.sheet, bound)


def rows_of(sheet: Float64, centre_mm: Float64) -> Float64:
    """Return rows (3, 4) that make leans and place amid the points of a plane's errors."""
    rows = np.zeros((3, 4))
    rows[:2, :3], rows[2] = leans_of(sheet), [*centre_mm, 1.0]
    return rows


def add(tally: Tally, result: GaugeCalibration, sheet: Float64, bound: Float64 | None) -> None:
    rows = rows_of(sheet, result.fitted.state.centre_mm)
    error = rows @ (result.plane - sheet)
    sigma = np.sqrt(np.diag(rows @ result.covariance @ rows.T))
    half = norm.isf(0.025)
    for n, name in enumerate(NAMES):
        tally.add(
            name,
            float(error[n]),
            float(sigma[n]),
            bool(abs(error[n]) <= half * sigma[n]),
            None if bound is None else float(bound[n]),
        )


def judge_rendered(worlds: int, seed: int) -> None:
    """Draw pictures of the example's V at random poses, and find the sheet in them."""
    lens = Lens(
        make_gauge.WIDTH,
        make_gauge.HEIGHT,
        ("fx", "fy", "cx", "cy"),
        np.array([make_gauge.FOCAL_PX, make_gauge.FOCAL_PX, *make_gauge.CENTRE_PX]),
    )
    camera = pose(make_gauge.rotation(*make_gauge.CAMERA_IN_TOOL_XYZW), make_gauge.CAMERA_IN_TOOL_MM)
    gauge = Gauge(Shape.V, make_gauge.DEPTH_MM, make_gauge.ANGLE_DEG)
    tally, reasons = Tally(), Counter[str]()
    for n in range(worlds):
        rng = np.random.default_rng([seed, n, 7])
        shown = []
        for k in range(10):
            spin = rng.uniform(-30.0, 30.0) + (180.0 if k % 2 else 0.0)
            R = turned(*rng.uniform(-12.0, 12.0, 2), spin)
            shift = np.array([*rng.uniform(-2.0, 2.0, 2), rng.uniform(-6.0, 6.0)])
            T = pose(R, make_gauge.GAUGE_IN_BASE_MM + shift - R @ np.array([35.0, 0.0, 0.0]))
            pieces = stripe_pieces(make_gauge.draw(T, rng), lens, 4)
            stated = T.copy()
            stated[:3, 3] += make_gauge.ROBOT_SIGMA_MM * rng.standard_normal(3)
            if isinstance(pieces, str):
                reasons[pieces] += 1
            else:
                shown.append(PosedPieces(f"{k}", pieces, stated))
        try:
            result = calibrate_gauge(
                shown, gauge, StatedSensor(lens, camera, laser_in(make_gauge.SHEET_IN_TOOL)), UP
            )
        except UndeterminedError as error:
            reasons[str(error)[:60]] += 1
            continue
        reasons["images left out"] += len(result.left_out)
        add(tally, result, make_gauge.SHEET_IN_TOOL, None)
        place = abs(float((result.plane - make_gauge.SHEET_IN_TOOL) @ [*result.fitted.state.centre_mm, 1.0]))
        print(f"{n}: place off by {place:.3f} mm, 1 sigma {result.sigma[2]:.3f} mm")
    tally.report()
    print(dict(reasons))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rendered", type=int, default=0)
    chosen = parser.parse_args()
    tally, reasons = Tally(), Counter[str]()
    for n in range(chosen.worlds):
        judge(10_000 * chosen.seed + n, tally, reasons)
    if chosen.worlds:
        tally.report()
        print(dict(reasons))
    if chosen.rendered:
        judge_rendered(chosen.rendered, chosen.seed)


if __name__ == "__main__":
    main()
