"""How good `arctrack calibrate laser` is on sheets whose truth is known, from corners and stripe points.

    python benchmarks/calibrate_laser.py [--worlds N] [--mitsuba N] [--seed SEED]

Random cameras see a board in 4 to 12 poses; a sheet of light crosses it. Corners scatter by 0.03 to 0.3 px.
The stripe's points scatter by 0.1 to 0.6 px, alike over up to five scan lines. In every second world 3 % of
the points are up to 10 px off. In every third world the lens is as far off as its covariance says.
The projection is written out here. z is an error over its stated sigma; the bound is Cramer and Rao's, with
right points alone, and with a lens that the boards' corners tell too. --mitsuba has Mitsuba render
ten pairs of pictures a world, of a line that a projector throws on glossy boards (see mitsuba_boards), and
finds corners and stripe in them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from laser_bound import Boards, Seen
from mitsuba_boards import ROUGHNESS, Paper, Sheet, draw_studio
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm

from calibration.boards.board import Board, BoardKind
from calibration.boards.detect import find_corners
from calibration.camera.enough import UndeterminedError
from calibration.camera.known_lens import board_poses
from calibration.camera.lens import Lens
from calibration.camera.sightings import BoardView
from calibration.laser.calibrate import LaserCalibration, calibrate_laser
from calibration.laser.cross_sections import cross_sections, placed
from calibration.laser.plane import LaserStand
from calibration.laser.stripe import BoardStripe, board_area, find_stripe, laser_light
from noise_model.compiled.arrays import Float64

FAMILY_ALARM = 0.0027
"""The probability that chance alone puts a mean over the most: 3 sigma, shared among the numbers."""

NAMES = ("lean about the stripes", "lean along them", "place amid the points")
LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2")
LENS_SIGMA = np.array([1e-3, 1e-3, 4e-4, 4e-4, 3e-3, 1e-2])
"""1 sigma of a lens that is not the true one: focal lengths relative, the principal point in image widths."""

MITSUBA_PAIRS = 10


@dataclass(frozen=True)
class World:
    """A camera, the sheet n.X + d = 0 in its frame, and what the boards' images show."""

    lens: Lens
    lens_covariance: Float64 | None
    board: Board
    plane: Float64
    views: list[BoardView]
    stripes: dict[str, BoardStripe]
    bound: Float64 | None = None

    @property
    def stand(self) -> LaserStand:
        """A laser as far off the boards as the camera is, which looks as the camera does."""
        normal, distance_mm = self.plane[:3], -self.plane[3] / self.plane[2]
        ahead = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
        ahead /= np.linalg.norm(ahead)
        return LaserStand(np.array([0.0, 0.0, distance_mm]) - distance_mm * ahead, -ahead)


@dataclass
class Scores:
    """What all worlds say, collected."""

    z: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in NAMES})
    over_bound: dict[str, list[Float64]] = field(default_factory=lambda: {"right": [], "off": []})
    sigma_over_bound: dict[str, list[Float64]] = field(default_factory=lambda: {"right": [], "off": []})
    squares: list[float] = field(default_factory=list)
    off_mm: list[float] = field(default_factory=list)
    sigma_mm: list[float] = field(default_factory=list)
    widened: int = 0
    left_out: int = 0
    refused: int = 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--mitsuba", type=int, default=0, help="worlds that Mitsuba renders")
    options = parser.parse_args()
    if options.worlds:
        judge(options.worlds, options.seed, drawn_world)
    if options.mitsuba:
        judge(options.mitsuba, options.seed, rendered_world)


def drawn_world(rng: np.random.Generator, n: int) -> World:
    """Return the corners and stripe points of a random world; some are wrong, some lenses are."""
    return draw_world(rng, with_wrong=n % 2 == 1, with_lens=n % 3 == 2)


def judge(worlds: int, seed: int, make: Callable[[np.random.Generator, int], World]) -> None:
    """Calibrate the sheets of random worlds, and print what is off."""
    scores, start = Scores(), time.perf_counter()
    for n in range(worlds):
        world = make(np.random.default_rng([seed, n]), n)
        scene, seen = board_poses(world.board, world.views, world.lens)
        try:
            result = calibrate_laser(scene, seen, world.stripes, world.stand, world.lens_covariance)
        except UndeterminedError:
            scores.refused += 1
            continue
        add(scores, world, result)
    print(f"{worlds} worlds, seed {seed}; {scores.refused} of them refused")
    show(scores)
    print(f"{(time.perf_counter() - start) / worlds:.3f} s a world")


def rendered_world(rng: np.random.Generator, n: int) -> World:
    """Return the corners and stripe points that are found in ten pairs of pictures by Mitsuba."""
    width, height = 640, 480
    focal = float(rng.uniform(900.0, 2200.0))
    values = np.array([focal, 1.002 * focal, 322.0, 236.0, 0.05 * rng.standard_normal(), 0.0])
    lens = Lens(width, height, LENS_NAMES, values)
    board = Board(BoardKind.CHESSBOARD, 8, 6, 5.0)
    span = np.array([board.columns - 1, board.rows - 1]) * board.square_mm
    distance = focal * span.max() / (0.5 * height)
    by_name = dict(zip(LENS_NAMES, values.tolist(), strict=True))
    # Room for the stripe's light above that of the room.
    studio = draw_studio(rng, (width, height), by_name, distance, exposure=0.4)
    spin, lean = rng.uniform(0.0, np.pi), np.radians(rng.uniform(15.0, 40.0))
    normal = np.array([np.cos(spin) * np.cos(lean), np.sin(spin) * np.cos(lean), np.sin(lean)])
    aim = np.array([0.0, 0.0, distance])
    middle = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    middle /= np.linalg.norm(middle)
    sigma = float(rng.uniform(1.2, 3.0)) / focal
    sheet = Sheet(aim - distance * middle, middle, np.cross(normal, middle), sigma, 0.25, aim, 3.0)
    views, pictures = [], {}
    for view in range(MITSUBA_PAIRS):
        turn = Rotation.from_euler("XYZ", [*rng.uniform(-30, 30, 2), rng.uniform(-90, 90)], degrees=True)
        depth = distance * rng.uniform(0.88, 1.12)
        off = -(sheet.plane[3] + sheet.plane[2] * depth) / (normal[:2] @ normal[:2]) * normal[:2]
        origin = np.array([*off, depth]) - turn.apply([*0.5 * span, 0.0])
        paper = Paper(board, 0.02 * rng.standard_normal(2), float(rng.uniform(*ROUGHNESS)))
        room = studio.light_e(paper, turn.as_matrix(), origin)
        line = studio.light_e(paper, turn.as_matrix(), origin, sheet)
        without, lit = studio.picture(room), studio.picture(room + line)
        corners = find_corners(without, board)
        if corners is not None:
            views.append(BoardView(f"{view}", corners.corners, corners.points_px))
            pictures[f"{view}"] = without, lit
    scene, seen = board_poses(board, views, lens)
    stripes = {}
    for name, T in zip(seen.names, scene.T_camera_board, strict=True):
        light = laser_light(*pictures[name], board_area(board, lens, T))
        stripe = find_stripe(light)
        if stripe is not None:
            sections = cross_sections(light, *pictures[name], stripe)
            stripes[name] = stripe if sections is None else placed(stripe, sections)
    print(f"world {n}: {len(views)} boards and {len(stripes)} stripes seen in {MITSUBA_PAIRS} pairs")
    return World(lens, None, board, sheet.plane, views, stripes)


def project(lens: Lens, points: Float64) -> Float64:
    """Return where points (N, 3) are seen (N, 2), px."""
    fx, fy, cx, cy, k1, k2 = lens.values
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2 * r2
    return np.column_stack([fx * x * radial + cx, fy * y * radial + cy])


def draw_lens(rng: np.random.Generator) -> Lens:
    """Return a random lens."""
    width, height = 1280, 960
    focal = rng.uniform(0.9, 2.5) * width
    center = 0.5 * np.array([width - 1.0, height - 1.0]) + rng.normal(0.0, 0.02 * width, 2)
    values = np.array([focal, focal * rng.uniform(0.995, 1.005), *center, rng.normal(0, 0.1), 0.0])
    return Lens(width, height, LENS_NAMES, values)


def draw_world(
    rng: np.random.Generator, *, with_wrong: bool, with_lens: bool, lens: Lens | None = None
) -> World:
    """Return a random world, with a random lens where none is given."""
    true = draw_lens(rng) if lens is None else lens
    width, height, focal, values = true.width, true.height, float(true.values[0]), true.values
    columns, rows = int(rng.integers(6, 12)), int(rng.integers(5, 10))
    board = Board(BoardKind.CHESSBOARD, columns, rows, float(rng.uniform(3.0, 30.0)))
    span = np.array([columns - 1, rows - 1]) * board.square_mm
    distance = focal * span.max() / (rng.uniform(0.4, 0.7) * height)
    # The sheet stands some 10 to 40 deg to the line of sight and crosses it near the boards' mean distance.
    spin, lean = rng.uniform(0.0, np.pi), np.radians(rng.uniform(10.0, 40.0))
    normal = np.array([np.cos(spin) * np.cos(lean), np.sin(spin) * np.cos(lean), np.sin(lean)])
    plane = np.array([*normal, -normal @ np.array([0.0, 0.0, distance])])
    corner_px, point_px = rng.uniform(0.03, 0.3), rng.uniform(0.1, 0.6)
    alike = rng.uniform(0.0, 0.8)
    views, stripes, seen = [], {}, []
    along_rows = bool(abs(normal[1]) > abs(normal[0]))
    for n in range(int(rng.integers(4, 13))):
        turn = Rotation.from_euler("XYZ", [*rng.uniform(-30, 30, 2), rng.uniform(-90, 90)], degrees=True)
        depth = distance * rng.uniform(0.85, 1.15)
        # The board's middle lies near where the sheet passes at that depth.
        off = -(plane[3] + plane[2] * depth) / (plane[:2] @ plane[:2]) * plane[:2]
        middle = np.array([*(off + rng.normal(0.0, 0.1, 2) * span.min()), depth])
        origin = middle - turn.apply([*0.5 * span, 0.0])
        corners = project(true, turn.apply(board.points_mm) + origin)
        corners += corner_px * rng.standard_normal(corners.shape)
        views.append(BoardView(f"{n}", np.arange(len(corners)), corners))
        points = crossing(plane, turn, origin, span)
        image = project(true, points)
        image = image[np.argsort(image[:, 0 if along_rows else 1])]
        seen.append(Seen(turn, origin, image[:, 0 if along_rows else 1].copy()))
        noise = correlated(rng, len(image), point_px, alike)
        if with_wrong:
            is_wrong = rng.random(len(image)) < 0.03
            noise[is_wrong] += rng.uniform(-10.0, 10.0, is_wrong.sum())
        image[:, 1 if along_rows else 0] += noise
        stripes[f"{n}"] = BoardStripe(image, along_rows, 2.0)
    sigma = LENS_SIGMA * np.array([focal, focal, width, width, 1.0, 1.0])
    boards = Boards(
        plane,
        board,
        values,
        sigma if with_lens else None,
        corner_px,
        point_px,
        alike,
        along_rows,
        lambda lens_values, points: project(replace(true, values=lens_values), points),
        lambda moved, turn, origin: crossing(moved, turn, origin, span),
    )
    bound = boards.bound(seen)
    if not with_lens:
        return World(true, None, board, plane, views, stripes, bound)
    wrong = replace(true, values=values + sigma * rng.standard_normal(6))
    return World(wrong, np.diag(sigma**2), board, plane, views, stripes, bound)


def crossing(plane: Float64, turn: Rotation, origin: Float64, span: Float64) -> Float64:
    """Return points (n, 3), mm, of the line in which the sheet meets a board, as many as on the board."""
    m = turn.apply([0.0, 0.0, 1.0])
    along = np.cross(plane[:3], m)
    along /= np.linalg.norm(along)
    start = np.linalg.lstsq(np.stack([plane[:3], m]), np.array([-plane[3], m @ origin]), rcond=None)[0]
    middle = origin + turn.apply([*0.5 * span, 0.0])
    start = start + ((middle - start) @ along) * along
    reach = np.linspace(-0.4, 0.4, 300) * span.min()
    return np.asarray(start + reach[:, np.newaxis] * along)


def correlated(rng: np.random.Generator, count: int, sigma: float, alike: float) -> Float64:
    """Return noise (count,) of which neighbours are alike by this correlation."""
    white = rng.standard_normal(count)
    noise = np.empty(count)
    noise[0] = white[0]
    for n in range(1, count):
        noise[n] = alike * noise[n - 1] + np.sqrt(1.0 - alike**2) * white[n]
    return sigma * noise


def add(scores: Scores, world: World, result: LaserCalibration) -> None:
    """Collect a world's errors over stated sigma."""
    middle = np.concatenate(result.points_mm).mean(axis=0)
    plane = result.plane * np.sign(result.plane[:3] @ world.plane[:3])
    basis = np.stack([np.cross(result.fit.loose_axis, plane[:3]), result.fit.loose_axis])
    # Two small leans of the normal, and where the plane is amid the points.
    rows = np.zeros((3, 4))
    rows[:2, :3], rows[2] = basis, [*middle, 1.0]
    error, covariance = rows @ (plane - world.plane), rows @ result.covariance[:4, :4] @ rows.T
    for name, value in zip(NAMES, error / np.sqrt(np.diag(covariance)), strict=True):
        scores.z[name].append(float(value))
    if world.bound is not None:
        bound = np.sqrt(np.diag(rows @ world.bound @ rows.T))
        lens = "right" if world.lens_covariance is None else "off"
        scores.over_bound[lens].append(error / bound)
        scores.sigma_over_bound[lens].append(np.sqrt(np.diag(covariance)) / bound)
    scores.squares.append(float(error @ np.linalg.solve(covariance, error)))
    scores.off_mm.append(float(error[2]))
    scores.sigma_mm.append(float(np.sqrt(covariance[2, 2])))
    scores.widened += result.scatter > 1.0
    scores.left_out += len(result.left_out)


def show(scores: Scores) -> None:
    most = norm.isf(0.5 * FAMILY_ALARM / len(NAMES))
    print(f"{'':24} mean z  off/SE (most {most:.1f})  68 %   95 %   z's sigma")
    for name in NAMES:
        z = np.array(scores.z[name])
        off = z.mean() / (z.std(ddof=1) / np.sqrt(len(z)))
        half, whole = (100.0 * np.mean(np.abs(z) <= norm.isf(p)) for p in (0.5 * 0.3173, 0.025))
        print(f"{name:24} {z.mean():+.3f}  {off:+18.2f}  {half:5.1f}  {whole:5.1f}  {z.std():.3f}")
    squares = np.array(scores.squares)
    for share in (0.68, 0.95):
        covered = 100.0 * np.mean(squares <= chi2.ppf(share, 3))
        print(f"{100.0 * share:.0f} % ellipsoid of all three: {covered:.1f} %")
    for lens, over_bound in scores.over_bound.items():
        if over_bound:
            over = np.sqrt(np.mean(np.square(over_bound), axis=0))
            stated = np.median(scores.sigma_over_bound[lens], axis=0)
            print(
                f"lens {lens}: RMS error over the bound {', '.join(f'{value:.2f}' for value in over)}; "
                f"median sigma over it {', '.join(f'{value:.2f}' for value in stated)}"
            )
    off_mm = np.abs(scores.off_mm)
    print(f"off amid the points: median {np.median(off_mm):.4f} mm, most {off_mm.max():.4f} mm")
    print(f"sigma amid the points: median {np.median(scores.sigma_mm):.4f} mm")
    print(f"sigmas widened in {scores.widened} worlds; pairs left out, all of them right: {scores.left_out}")


if __name__ == "__main__":
    main()
