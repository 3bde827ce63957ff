"""How good `arctrack calibrate camera` is on cameras whose truth is known.

    python benchmarks/calibrate_camera.py [--worlds N] [--printed N] [--chosen N] [--seed SEED] [--tilts]

Random cameras see a bent board; the corners scatter. In the first table the kind of distortion is given, in
the second one it is chosen. z is an error over its stated sigma. Its mean over worlds is 0 but for chance:
beside it stands how many standard errors it is off, and the most that chance allows with Bonferroni's
correction. 95 % and 68 % are how often the truth lies within. The Cramer-Rao bound is that of the true noise.
--tilts fits five coefficients without a tilt to exact corners of tilted sensors, and nothing else.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field, replace

import numpy as np
from camera_worlds import LENSES, World, draw_corners, draw_world, project
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm

from calibration.boards.board import Board, BoardKind
from calibration.camera.adjustment import linearise
from calibration.camera.calibrate import CameraCalibration, fit_lens
from calibration.camera.enough import UndeterminedError
from calibration.camera.halves import MAX_RATIO, difference_of_halves, splits
from calibration.camera.lens import ORDERS
from calibration.camera.sightings import BoardView
from noise_model.compiled.arrays import Float64

FAMILY_ALARM = 0.0027
"""The probability that any of the parameters is called biased without being so: 3 sigma."""

WRONG_SHARE, PRINT_SHARE = 0.01, 0.001
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "warp_x_mm", "warp_y_mm")


@dataclass
class Scores:
    """What all worlds say, collected."""

    z: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in NAMES})
    over_bound: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in NAMES})
    ellipse: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    refused: int = 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=400, help="worlds whose kind of distortion is given")
    parser.add_argument("--printed", type=int, default=100, help="worlds whose boards are not exact")
    parser.add_argument("--chosen", type=int, default=60, help="worlds whose distortion is chosen")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--tilts", action="store_true", help="tilted sensors by five coefficients, alone")
    options = parser.parse_args()
    if options.tilts:
        tilts(options.seed)
        return
    if options.worlds:
        given(options.worlds, options.seed)
    if options.printed:
        given(options.printed, options.seed, PRINT_SHARE)
    if options.chosen:
        chosen(options.chosen, options.seed)


def given(worlds: int, seed: int, print_share: float = 0.0) -> None:
    """Print bias, coverage and efficiency where the kind of distortion is given.

    `print_share` is 1 sigma of the corners' places on the board, over the squares' side.
    """
    scores = Scores()
    wrong_found = wrong_all = right_lost = right_all = 0
    for n in range(worlds):
        rng = np.random.default_rng([seed, n])
        world = draw_world(rng, list(LENSES)[n % len(LENSES)])
        share = WRONG_SHARE if n % 2 else 0.0
        if print_share:
            world = printed(world, rng, print_share)
        images, wrong = draw_corners(rng, world, share)
        start = time.perf_counter()
        try:
            found = fit_lens(board_of(world), views_of(images), world.size, orders=[world.order])
        except UndeterminedError:
            scores.refused += 1
            continue
        scores.seconds.append(time.perf_counter() - start)
        add(scores, world, found, rng)
        named = {(corner.view, corner.corner) for corner in found.wrong}
        truly = {(view, corner) for view, corners in enumerate(wrong) for corner in corners}
        wrong_found, wrong_all = wrong_found + len(named & truly), wrong_all + len(truly)
        right_lost += len(named - truly)
        right_all += sum(map(len, images)) - len(truly)
    how = f"corners off by {print_share:g} squares on the board, " if print_share else ""
    print(f"\n{worlds} worlds, {how}distortion given, seed {seed}; {scores.refused} of them refused")
    show(scores)
    print(f"wrong corners named: {wrong_found} of {wrong_all}; right ones lost: {right_lost} of {right_all}")


def chosen(worlds: int, seed: int) -> None:
    """Print what becomes of the projection where the distortion is chosen, and how often halves disagree."""
    scores, ratios, orders, spread = Scores(), [], [], 0
    for n in range(worlds):
        rng = np.random.default_rng([seed, 1, n])
        world = draw_world(rng, list(LENSES)[n % len(LENSES)])
        images, _ = draw_corners(rng, world)
        start = time.perf_counter()
        try:
            found = fit_lens(board_of(world), views_of(images), world.size)
        except UndeterminedError:
            scores.refused += 1
            continue
        halves = [difference_of_halves(found.scene, found.seen, half) for half in splits(len(images))]
        scores.seconds.append(time.perf_counter() - start)
        ratios.append(float(np.median([difference.ratio for difference in halves])))
        orders.append(list(LENSES).index(world.order) - list(ORDERS).index(found.order))
        spread += found.scatter > 1.0
        scores.ellipse.append(mahalanobis(world, found, rng))
    print(f"\n{worlds} worlds, distortion chosen, seed {seed}; {scores.refused} of them refused")
    leaner, richer = sum(o > 0 for o in orders), sum(o < 0 for o in orders)
    print(f"distortion as drawn {orders.count(0)}, leaner {leaner}, richer {richer}")
    print(f"68 % ellipse of the projection: {share(scores.ellipse, 0.68):.1f} %")
    print(
        f"halves' ratio: median {np.median(ratios):.2f}, 95 % below {np.quantile(ratios, 0.95):.2f}, "
        f"above {MAX_RATIO:g} in {sum(r > MAX_RATIO for r in ratios)}"
    )
    print(f"sigma widened without need: {spread}; {np.median(scores.seconds):.2f} s a calibration")


def tilts(seed: int) -> None:
    """Print the residuals of lenses with tilted sensors that are fitted without a tilt."""
    print("tilt about x, y [deg]   k1    RMS residual [px]")
    for k1 in (-0.05, -0.15):
        for about_x, about_y in ((5.0, 0.0), (10.0, 0.0), (15.0, 0.0), (0.0, 10.0), (7.0, 7.0)):
            world = draw_world(np.random.default_rng([seed, 3]), "none", views=14)
            world.lens.update(k1=k1, tau_x=np.radians(about_x), tau_y=np.radians(about_y))
            images = [project(world.lens, world.corners_camera(view)) for view in range(14)]
            found = fit_lens(board_of(world), views_of(images), world.size, orders=["k1 k2 p1 p2 k3"])
            print(f"{about_x:10.0f} {about_y:5.0f} {k1:12.2f} {found.rms_px:12.4f}")


def printed(world: World, rng: np.random.Generator, share: float) -> World:
    """Return a world whose board is not exact, of an odd and an even side so that its ends are told."""
    counts = (world.counts[0], world.counts[1] + 1 - sum(world.counts) % 2)
    offsets = share * world.square_mm * rng.standard_normal((counts[0] * counts[1], 2))
    return replace(world, counts=counts, print_mm=offsets)


def board_of(world: World) -> Board:
    return Board(BoardKind.CHESSBOARD, *world.counts, world.square_mm)


def views_of(images: list[Float64]) -> list[BoardView]:
    return [BoardView(f"{n}", np.arange(len(points)), points) for n, points in enumerate(images)]


def add(scores: Scores, world: World, found: CameraCalibration, rng: np.random.Generator) -> None:
    """Collect a world's errors over stated sigma and over the bound."""
    truth = {**world.lens, "warp_x_mm": world.warp_mm[0], "warp_y_mm": world.warp_mm[1]}
    values = [*found.scene.lens.values, *found.scene.warp_mm]
    bounds = bound(world, found)
    for name, value, sigma, least in zip(found.names, values, found.sigma, bounds, strict=True):
        scores.z[name].append((value - truth[name]) / sigma)
        scores.over_bound[name].append((value - truth[name]) / least)
    scores.ellipse.append(mahalanobis(world, found, rng))


def bound(world: World, found: CameraCalibration) -> Float64:
    """Return the Cramer-Rao bound of each parameter: the true noise, at the true scene."""
    T = np.tile(np.eye(4), (len(world.poses), 1, 1))
    for n, (turn, move) in enumerate(world.poses):
        T[n, :3, :3], T[n, :3, 3] = turn.as_matrix(), move
    values = np.array([world.lens[name] for name in found.scene.lens.names])
    lens = replace(found.scene.lens, values=values)
    scene = replace(found.scene, lens=lens, warp_mm=world.warp_mm, T_camera_board=T)
    weight = 1.0 / world.sigma_px[found.seen.view]
    information = linearise(scene, found.seen, weight).information()
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))))


def mahalanobis(world: World, found: CameraCalibration, rng: np.random.Generator) -> float:
    """Return the squared distance, over its covariance, of where a random point is seen from where it is.

    The camera frames of truth and estimate differ by the motion that brings the true boards to those found,
    in least squares of the image.
    """
    lens = {name: 0.0 for name in NAMES[:9]} | dict(
        zip(found.scene.lens.names, found.scene.lens.values, strict=True)
    )
    weight = (1.0 / found.noise.sigma_px)[found.seen.view][:, None]
    truth = np.concatenate([world.corners_camera(view) for view in range(len(world.poses))])
    counted = found.seen.view * np.prod(world.counts) + found.seen.corner
    target = project(lens, found.scene.points_camera(found.seen)) * weight

    def moved(motion: Float64, points: Float64) -> Float64:
        return np.asarray(Rotation.from_rotvec(motion[:3]).apply(points) + motion[3:])

    def misfit(motion: Float64) -> Float64:
        return np.asarray((project(lens, moved(motion, truth[counted])) * weight - target).ravel())

    motion = least_squares(misfit, np.zeros(6), x_scale="jac").x
    ray = rng.uniform(0.0, 1.0, 2) * world.size
    x, y = [(ray[n] - world.lens[f"c{'xy'[n]}"]) / world.lens[f"f{'xy'[n]}"] for n in (0, 1)]
    point = found.distance_mm * np.array([[x, y, 1.0]])
    where = project(world.lens, point)
    error = project(lens, moved(motion, point))[0] - where[0]
    covariance = (
        found.scatter * found.known.projection_covariance(found.scene.lens, where, found.distance_mm)[0]
    )
    return float(error @ np.linalg.solve(covariance, error))


def share(squares: list[float], probability: float) -> float:
    """Return how many of squared distances lie within the ellipse of a probability, %."""
    return 100.0 * float(np.mean(np.array(squares) <= chi2.ppf(probability, 2)))


def show(scores: Scores) -> None:
    most = norm.isf(0.5 * FAMILY_ALARM / len(NAMES))
    print(f"{'':10} worlds  mean z  off/SE (most {most:.1f})  95 %   error/bound")
    for name in NAMES:
        z, over = np.array(scores.z[name]), np.array(scores.over_bound[name])
        off = z.mean() / (z.std(ddof=1) / np.sqrt(len(z)))
        covered = 100.0 * np.mean(np.abs(z) <= norm.isf(0.025))
        rms = np.sqrt(np.mean(over**2))
        print(f"{name:10} {len(z):6d}  {z.mean():+.3f}  {off:+18.2f}  {covered:5.1f}  {rms:12.3f}")
    print(f"68 % ellipse of the projection: {share(scores.ellipse, 0.68):.1f} %")
    print(f"{np.median(scores.seconds):.2f} s a lens")


if __name__ == "__main__":
    main()
