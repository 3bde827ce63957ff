"""Test of whether the stripe is where a setup puts it, and otherwise which part of the setup is off.

A stripe's points are intersected with the laser plane and compared with the stated section of the joint,
which may lie off its nominal place as parts do. The residual is explained in turn by one part of the setup
that is far from its stated value, all others within what their calibration leaves open:

    Z_k = p(points | part k off) = integral of p(points | x) p_k(x) dx,

x the errors of the calibration (`noise_model.calibration_errors`), the camera's pose, the laser's plane, the
sensor's pose, the lens and the part's place, p_k a normal law that is wide for part k. Laplace's
approximation gives ln Z_k (MacKay 2003, chapter 27). Parts with equal Z_k cannot be separated by these poses:
a plate stays in base while the tool moves, a sensor goes with the tool. So rotated and lifted poses separate
them, and a tool that only travels does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial.legendre import legval
from scipy.spatial.transform import Rotation
from scipy.special import huber

from calibration.rigid import transform_each
from calibration.threads import one_thread
from noise_model.compiled.arrays import Float64
from noise_model.effects import apply_setup_effects
from noise_model.fit import Fit, Parameter, fit
from noise_model.robust import sigma_of
from noise_model.setup import Setup
from noise_model.stripe import stripe_runs_along_rows
from noise_model.surface.joint import SeamLine, corrugation_height, seam_frame, section
from noise_model.transforms import cross, invert, moved, transform
from tracker.geometry import calibration_moves, to_laser_plane
from tracker.seam.curve import BEND_LENGTH_MM, BEND_MM

BINS_A_FRAME, MIN_IN_BIN = 16, 3
"""Number of parts of a stripe whose medians are taken, and least number of scan lines of each."""

MIN_SIGMA_PX, MIN_SIGMA_MM = 0.2, 0.03
"""1 sigma of such a median, px, and of a section's own shape, mm, are no less.

On metal the mean of 64 lines still scatters by 0.15 px.
"""

MAX_OFF_MM = 60.0
"""A point farther off the joint lies on something else."""

GRID_MM, MAX_MODES = 2.0, 6
"""Spacing of the stations at which a seam's bends are computed, and number of their modes."""

ANNEALING = (30.0, 5.0)
"""Factors of the points' sigma in the fits before the last one: far off, the robust fit alone gets stuck."""

FAR = 1e3
"""A residual that counts for one beyond all reach, sigmas."""

STRAY_SHARE = 0.05
"""Share of the points that may lie on anything else: glints, tacks, what stands next to the joint."""

HUBER = 2.0
"""Huber's bound of residuals, sigmas: upright faces, glints, what lies next to the joint."""

PART_SIGMAS = (2.0, 2.0, 0.02, 0.02, 0.3)
"""1 sigma of how a part lies off its nominal place: sideways and in height, mm, along the seam, mm/mm, and
turned about it, deg."""

DIMENSION_TOLERANCE, STALE_DIMENSION = 0.03, 0.4
"""1 sigma of a dimension's logarithm: of a part made to its drawing, and of a wrong drawing."""

OFF_NATS, RIVAL_NATS = 7.0, 6.0
"""Log likelihood ratio from which the setup as stated does not explain the points, and below which two causes
cannot be separated: a bent plate makes odds doubtful."""

PART_BLOCK = ("seam_y", "seam_z", "seam_slope_y", "seam_slope_z", "part_roll")
CAMERA_BLOCK = ("camera_rot_x", "camera_rot_y", "camera_rot_z", "camera_x", "camera_y", "camera_z")
LASER_BLOCK = ("laser_rot_1", "laser_rot_2", "laser_offset")
SENSOR_BLOCK = ("sensor_rot_x", "sensor_rot_y", "sensor_rot_z", "sensor_x", "sensor_y", "sensor_z")
LENS_BLOCK = ("ln_focal",)
DIMENSION = "ln_"
"""Beginning of a dimension's name among the parameters: the logarithm of its ratio to the stated."""
SHAPE_BLOCK = ("shape_0", "shape_1", "shape_2", "shape_3")

AS_STATED, CAMERA, LASER, SENSOR, LENS, PART = "as stated", "camera", "laser", "sensor", "lens", "part"
DIMENSIONS = "dimensions"

BLOCKS: Mapping[str, tuple[str, ...]] = {
    CAMERA: CAMERA_BLOCK,
    SENSOR: SENSOR_BLOCK,
    LASER: LASER_BLOCK,
    LENS: LENS_BLOCK,
    PART: PART_BLOCK,
}
"""The parts of a setup that may be off: the camera alone in the tool, camera and laser together in the tool,
the laser alone, the lens' focal lengths, and the part itself, with the base and the tool's length.

The first two are the hand-eye's.
"""


def _by_name(names: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    return dict(zip(names, values, strict=True))


STALE_POSE = (1.0, 1.0, 1.0, 5.0, 5.0, 5.0)
"""1 sigma of a pose that is not as stated any more, deg and mm."""

STALE: Mapping[str, Mapping[str, float]] = {
    CAMERA: _by_name(CAMERA_BLOCK, STALE_POSE),
    SENSOR: _by_name(SENSOR_BLOCK, STALE_POSE),
    LASER: _by_name(LASER_BLOCK, (1.0, 1.0, 5.0)),
    LENS: _by_name(LENS_BLOCK, (0.05,)),
    PART: _by_name(PART_BLOCK, (20.0, 20.0, 0.05, 0.05, 3.0)),
}
"""1 sigma of what is off where a part of the setup is not as stated, in the units of its parameters."""


@dataclass(frozen=True, eq=False)
class StripeSight:
    """A frame's stripe, image points (n, 2) x y, px, in the order of its scan lines, and the tool's pose."""

    points_px: Float64
    T_base_tool: Float64


@dataclass(frozen=True, eq=False)
class Cause:
    """A part of the setup that is off, as an explanation of the stripes.

    `ln_evidence` is ln Z less that of a line which leaves its course anywhere. `values` is what it would take
    by parameter name, in deg, mm and ln, `fit` the fit behind them; `rms_px` how far the stripes then lie off
    their places, by a robust measure. `turn_deg` and `move_mm` are the turn and the move of the part in all,
    0 of the lens and of dimensions.
    """

    name: str
    ln_evidence: float
    fit: Fit
    values: Mapping[str, float]
    rms_px: float
    turn_deg: float
    move_mm: float


@dataclass(frozen=True, eq=False)
class StripePlace:
    """Position of stripes against the one that a setup expects.

    `off_px` is the median over all points, `off_sigma_px` the 1 sigma that tolerances and the part's place
    let expect; `as_stated` is the fit with all within them.
    The tool was turned by up to `turned_deg` and lifted by `lifted_mm` between the frames. The part's place
    is stated about `middle_mm`, the station amid the points.
    """

    setup: Setup

    off_px: float
    off_sigma_px: float
    as_stated: Cause
    turned_deg: float
    lifted_mm: float
    n_frames: int
    middle_mm: float
    bends: SeamBends

    @property
    def fitted_setup(self) -> Setup:
        """The setup with its parts where the fit has them, within their tolerances."""
        return with_changes(self.setup, self.as_stated.values)

    @property
    def seam(self) -> SeamLine:
        """The seam's line."""
        values = self.as_stated.values
        y, z, slope_y, slope_z = (values[name] for name in PART_BLOCK[:4])
        about = self.middle_mm + np.array([-0.5, 0.0, 0.5]) * GRID_MM
        before, here, after = self.bends.y_mm(values, about)
        bent = float(after - before) / GRID_MM
        return SeamLine(self.middle_mm, y + float(here), z, slope_y + bent, slope_z)


@one_thread()
def explain_stripes(
    setup: Setup, sights: Sequence[StripeSight], names: Sequence[str]
) -> tuple[float, list[Cause]]:
    """Return the stripes' median distance from their nominal places, px, and the cause of each name.

    A later name is fitted from the best of a grid, and, annealed, from the setup as stated. Raises ValueError
    where no stripe meets the laser plane in front of the camera.
    """
    problem = _StripePlaceProblem.of(setup, sights)
    first = problem.explain(names[0], problem.coarse_place(), {})
    others = [problem.explain(n, problem.coarse_change(n), problem.annealed(n)) for n in names[1:]]
    return problem.displacement(first.fit)[0], [first, *others]


@one_thread()
def locate_stripes(setup: Setup, sights: Sequence[StripeSight]) -> StripePlace:
    """Compare the stripes of some frames with the places that a setup expects them in.

    Raises ValueError where no stripe meets the laser plane in front of the camera.
    """
    problem = _StripePlaceProblem.of(setup, sights)
    as_stated = problem.explain(AS_STATED, problem.coarse_place(), {})
    off_px, sigma_px = problem.displacement(as_stated.fit)
    turns = np.array([sight.T_base_tool[:3, :3] for sight in sights])
    turned = Rotation.from_matrix(turns[0].T @ turns).magnitude()
    heights = [sight.T_base_tool[:3, 3] @ np.asarray(setup.joint.surface_normal_in_base) for sight in sights]
    return StripePlace(
        setup=setup,
        off_px=off_px,
        off_sigma_px=sigma_px,
        as_stated=as_stated,
        turned_deg=float(np.degrees(turned.max())),
        lifted_mm=float(np.ptp(heights)),
        n_frames=len(sights),
        middle_mm=problem.middle_mm,
        bends=problem.bends,
    )


@dataclass(frozen=True, eq=False)
class SeamBends:
    """Lateral bends of a seam: modes (m, g), mm, at `stations_mm` (g,), each with unit variance.

    They are the Karhunen-Loeve modes of `tracker.seam.curve`'s prior.
    """

    stations_mm: Float64
    modes_mm: Float64

    @classmethod
    def between(cls, first_mm: float, last_mm: float) -> SeamBends:
        """Return the modes between two stations, the largest first."""
        stations = np.arange(first_mm, last_mm + GRID_MM, GRID_MM)
        apart = stations[:, None] - stations[None, :]
        values, vectors = np.linalg.eigh(BEND_MM[0] ** 2 * np.exp(-0.5 * (apart / BEND_LENGTH_MM) ** 2))
        modes = (np.sqrt(np.maximum(values, 0.0)) * vectors)[:, ::-1].T
        return cls(stations, modes[:MAX_MODES])

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the modes' coefficients."""
        return tuple(f"bend_{n}" for n in range(len(self.modes_mm)))

    def y_mm(self, x: Mapping[str, float], at_mm: Float64) -> Float64:
        """Return the seam's lateral bend (n,), mm, at stations (n,), for coefficients by name."""
        y_mm = np.array([x[name] for name in self.names]) @ self.modes_mm
        return np.interp(at_mm, self.stations_mm, y_mm)

    def range_mm(self, x: Mapping[str, float]) -> float:
        """Return the range of the seam's distances from a straight line, mm."""
        y_mm = self.y_mm(x, self.stations_mm)
        if len(y_mm) < MIN_IN_BIN:
            return 0.0
        return float(np.ptp(y_mm - np.polyval(np.polyfit(self.stations_mm, y_mm, 1), self.stations_mm)))


@dataclass(frozen=True, eq=False)
class _StripePlaceProblem:
    """Points (n, 2) of all frames with T_joint_tool (n, 4, 4), their 1 sigma (n,), px, across the stripe.

    `course_px` is the distance of two neighbours along the stripe: so far a line may leave its course between
    them to either side.
    """

    setup: Setup
    points_px: Float64
    T_joint_tool: Float64
    sigma_px: Float64
    course_px: float
    middle_mm: float
    bends_px: Float64
    across: Float64
    bends: SeamBends

    @classmethod
    def of(cls, setup: Setup, sights: Sequence[StripeSight]) -> _StripePlaceProblem:
        true = apply_setup_effects(setup)
        points, transforms, sigmas = [], [], []
        for sight in sights:
            binned, sigma_px = _bin_points(sight.points_px)
            ahead_base = transform(sight.T_base_tool, true.laser.point_mm)
            T_joint_tool = invert(seam_frame(true.joint, ahead_base)) @ sight.T_base_tool
            points.append(binned)
            sigmas.append(sigma_px)
            transforms.append(np.broadcast_to(T_joint_tool, (len(binned), 4, 4)))
        points_px, sigma_px = np.concatenate(points), np.concatenate(sigmas)
        T_joint_tool = np.concatenate(transforms)
        across = np.array([0.0, 1.0] if stripe_runs_along_rows(true) else [1.0, 0.0])
        met, shifted = (to_laser_plane(true, points_px + step)[0] for step in (0.0, across))
        in_joint = transform_each(T_joint_tool, met)
        off_mm = _off_section(true, in_joint)
        mm_per_px = np.abs(_off_section(true, transform_each(T_joint_tool, shifted)) - off_mm)
        known = np.isfinite(mm_per_px) & (mm_per_px > 0.0) & (np.abs(off_mm) < MAX_OFF_MM)
        camera = true.camera
        along_px = camera.width if stripe_runs_along_rows(true) else camera.height
        vertices = section(true.joint).vertices
        uprights_mm = vertices[:-1][np.diff(vertices[:, 0]) == 0.0, 0]
        near_mm = np.abs(in_joint[:, 1:2] - uprights_mm).min(axis=1, initial=np.inf)
        # Beneath an upright face the section jumps.
        known &= near_mm > 3.0
        if not known.any():
            raise ValueError("no stripe meets the laser plane where the joint is")
        return cls(
            setup=true,
            points_px=points_px[known],
            T_joint_tool=T_joint_tool[known],
            sigma_px=np.hypot(sigma_px, MIN_SIGMA_MM / np.where(known, mm_per_px, 1.0))[known],
            course_px=along_px / BINS_A_FRAME,
            middle_mm=float(np.median(in_joint[known, 0])),
            bends_px=_bends(points_px, true)[:, known],
            across=across,
            bends=SeamBends.between(in_joint[known, 0].min(), in_joint[known, 0].max()),
        )

    def coarse_place(self) -> dict[str, float]:
        """Return the part's approximate place relative to its nominal one: the best of a grid."""
        # Sideways and in height, mm.
        return self._best_of(
            {"seam_y": y, "seam_z": z} for z in np.arange(-18.0, 18.5, 1.5) for y in np.arange(-6.0, 7.0, 3.0)
        )

    def coarse_change(self, name: str) -> dict[str, float]:
        """Return the approximate change of one part that is off: the best of a grid along each axis.

        Far from it a fit may run off to a sheet that the camera sees edge on.
        """
        steps = np.arange(-3.0, 3.1, 0.25)
        return self._best_of({n: sigma * k} for n, sigma in STALE.get(name, {}).items() for k in steps)

    def _best_of(self, places: Iterable[dict[str, float]]) -> dict[str, float]:
        nothing = dict.fromkeys((*PART_BLOCK, *SHAPE_BLOCK, *self.bends.names), 0.0)
        return min(
            places,
            key=lambda place: float(_robust_costs(self.residuals({**nothing, **place})).sum()),
            default={},
        )

    def annealed(self, name: str) -> Mapping[str, float]:
        """Return the fit with one part off to points that count less and less little.

        Plates settle first, and then say nothing of where the joint lies between them: that is looked for.
        """
        start: Mapping[str, float] = {}
        for factor in ANNEALING:
            vague = replace(self, sigma_px=factor * self.sigma_px)
            if factor == ANNEALING[-1]:
                # A camera that is off by 3 sigma of STALE_POSE puts it so far away, mm.
                seams_mm = start["seam_y"] + np.arange(-15.0, 15.5, 1.0)
                start = vague._best_of({**start, "seam_y": y_mm} for y_mm in seams_mm.tolist())
            parameters = vague._parameters(name)
            values = vague._fit(parameters, np.array([start.get(p.name, 0.0) for p in parameters])).values
            start = dict(zip((p.name for p in parameters), values, strict=True))
        return start

    def explain(self, name: str, *starts: Mapping[str, float]) -> Cause:
        """Return the best explanation of the points with one part off, from several starts."""
        return max((self._explain_from(name, start) for start in starts), key=lambda cause: cause.ln_evidence)

    def _explain_from(self, name: str, near: Mapping[str, float]) -> Cause:
        parameters = self._parameters(name)
        sigmas = np.array([parameter.prior_sigma for parameter in parameters])
        start = np.array([near.get(parameter.name, 0.0) for parameter in parameters])
        result = self._fit(parameters, start)
        values = dict(zip((parameter.name for parameter in parameters), result.values, strict=True))
        residuals = self.residuals(values)
        _, ln_correlation = np.linalg.slogdet(result.correlation)
        ln_volume = 0.5 * ln_correlation + float(np.log(result.sigmas / sigmas).sum())
        turn, move = _size(name, [values[n] for n in BLOCKS.get(name, ())])
        rms_px = sigma_of(residuals * self.sigma_px)
        ln_prior = -0.5 * float(np.sum((result.values / sigmas) ** 2))
        return Cause(
            name, ln_volume + ln_prior + self._ln_likelihood(residuals), result, values, rms_px, turn, move
        )

    def _ln_likelihood(self, residuals: Float64) -> float:
        """Return the log likelihood of residuals (n,) over that of points anywhere on a line's way."""
        ln_course = np.log(2.0 * self.course_px / (math.sqrt(2.0 * math.pi) * self.sigma_px))
        ln_points = ln_course - 0.5 * _robust_costs(residuals)
        return float(np.logaddexp(math.log1p(-STRAY_SHARE) + ln_points, math.log(STRAY_SHARE)).sum())

    def _fit(self, parameters: Sequence[Parameter], start: Float64) -> Fit:
        names = [parameter.name for parameter in parameters]

        def residuals(x: Float64) -> Float64:
            return self.residuals(dict(zip(names, x, strict=True)))

        def derivatives(x: Float64) -> Float64:
            steps = {parameter.name: parameter.step for parameter in parameters}
            return self._derivatives(dict(zip(names, x, strict=True)), steps)

        return fit(parameters, residuals, HUBER, start=start, derivatives=derivatives, min_gain_rel=1e-4)

    def _derivatives(self, x: dict[str, float], steps: Mapping[str, float]) -> Float64:
        """Return the residuals' forward differences (n, p), all of one setup at once.

        What the calibration's errors do to the points is taken where the setup is as stated.
        """
        modes = self.setup.calibration_errors.mode_names
        alone = [name for name in steps if name in self.setup_names and name not in modes]
        together = [name for name in steps if name not in alone]
        places = {name: {**x, name: x[name] + step} for name, step in steps.items()}
        moves_mm = np.zeros((1 + len(together), 1, *self.mode_moves_mm.shape[1:]))
        for mode, move_mm in zip(modes, self.mode_moves_mm, strict=True):
            moves_mm[1 + together.index(mode)] = steps[mode] * move_mm
        here, *moved = self._residuals_at(x, [x, *(places[name] for name in together)], moves_mm)
        off = dict(zip(together, moved, strict=True))
        off |= {name: self.residuals(places[name]) for name in alone}
        return np.column_stack([(off[name] - here) / step for name, step in steps.items()])

    @cached_property
    def mode_moves_mm(self) -> Float64:
        """Moves of the points (m, n, 3), mm, joint frame, by calibration errors of 1 sigma."""
        _, moves_mm = calibration_moves(self.setup, self.setup.calibration_errors, self.points_px)
        return np.asarray(np.einsum("nij,nmj->mni", self.T_joint_tool[:, :3, :3], moves_mm))

    def _parameters(self, name: str) -> list[Parameter]:
        sigmas = {
            **_by_name(PART_BLOCK, PART_SIGMAS),
            **dict.fromkeys(self.setup.calibration_errors.mode_names, 1.0),
            # Lens, sheet and plate bend all stripes: Legendre's polynomials along them, px.
            **_by_name(SHAPE_BLOCK, (0.5, 0.5, 0.5, 0.3)),
            **dict.fromkeys(
                (DIMENSION + n for n, value in self.setup.joint.dimensions.items() if value > 0.0),
                STALE_DIMENSION if name == DIMENSIONS else DIMENSION_TOLERANCE,
            ),
            **dict.fromkeys(self.bends.names, 1.0),
            **STALE.get(name, {}),
        }
        return [Parameter(n, "", 0.0, sigma, step=0.01 * sigma) for n, sigma in sigmas.items()]

    def residuals(self, x: Mapping[str, float]) -> Float64:
        """Return the residuals (n,) of the stripe's points, in their sigmas."""
        return np.asarray(self._residuals_at(x, [x])[0])

    def _residuals_at(
        self, x: Mapping[str, float], places: Sequence[Mapping[str, float]], moves_mm: Float64 | float = 0.0
    ) -> Float64:
        """Return the residuals (k, n) at k places that have the setup of x, where points are moved."""
        try:
            setup = self._setup_with(tuple(x.get(name, 0.0) for name in self.setup_names))
        except ValueError:
            # Dimensions that no joint has.
            return np.full((len(places), len(self.points_px)), FAR)
        shapes = np.array([[place[name] for name in SHAPE_BLOCK] for place in places])
        seen_px = self.points_px + np.tensordot(shapes, self.bends_px, axes=1)
        both_px = np.stack([seen_px, seen_px + self.across], axis=1)
        T_joint_tool = np.tile(self.T_joint_tool, (2 * len(places), 1, 1))
        in_joint = transform_each(T_joint_tool, to_laser_plane(setup, both_px.reshape(-1, 2))[0])
        off_mm = self._off_mm(setup, in_joint.reshape(*both_px.shape[:3], 3) + moves_mm, places)
        here_mm, shifted_mm = off_mm[:, 0], off_mm[:, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            off_px: Float64 = here_mm / (shifted_mm - here_mm)
        return np.asarray(np.clip(np.nan_to_num(off_px / self.sigma_px, nan=FAR), -FAR, FAR))

    @cached_property
    def setup_names(self) -> tuple[str, ...]:
        """Names of the parameters that change the setup."""
        dimensions = (DIMENSION + name for name in self.setup.joint.dimensions)
        blocks = (*CAMERA_BLOCK, *LASER_BLOCK, *SENSOR_BLOCK, *LENS_BLOCK)
        return (*self.setup.calibration_errors.mode_names, *blocks, *dimensions)

    @cached_property
    def _setup_with(self) -> Callable[[tuple[float, ...]], Setup]:
        """The setup with parameters of some values; derivatives ask for that of the residuals before."""
        return lru_cache(maxsize=1)(lambda x: with_changes(self.setup, _by_name(self.setup_names, x)))

    def _off_mm(self, setup: Setup, in_joint: Float64, places: Sequence[Mapping[str, float]]) -> Float64:
        """Return the distances (k, 2, n), mm, of points (k, 2, n, 3) off the joint that lies at k places."""
        part = np.array([[place[name] for name in PART_BLOCK] for place in places])
        seam_y, seam_z, slope_y, slope_z, roll_deg = part.T[:, :, None, None]
        along, y, z = (in_joint[..., axis] for axis in range(3))
        bent_mm = np.array([self.bends.y_mm(place, x) for place, x in zip(places, along, strict=True)])
        y = y - (seam_y + slope_y * (along - self.middle_mm) + bent_mm)
        z = z - (seam_z + slope_z * (along - self.middle_mm)) - np.radians(roll_deg) * y
        return _off_section(setup, np.stack([along, y, z], axis=-1).reshape(-1, 3)).reshape(y.shape)

    def displacement(self, stated: Fit) -> tuple[float, float]:
        """Return the points' median distance from their nominal places, px, and its expected 1 sigma."""
        nominal = dict.fromkeys((parameter.name for parameter in stated.parameters), 0.0)

        def median_px(x: Mapping[str, float]) -> float:
            return float(np.median(self.residuals(x) * self.sigma_px))

        here = median_px(nominal)
        off = [
            (median_px({**nominal, p.name: p.step}) - here) / p.step * p.prior_sigma
            for p in stated.parameters
        ]
        return here, math.hypot(*off)


def with_changes(setup: Setup, x: Mapping[str, float]) -> Setup:
    """Return a setup whose camera, laser, sensor, lens and joint are changed by parameters, deg, mm and ln.

    The independent errors of its calibration are in their sigmas. Raises ValueError for dimensions that no
    joint has.
    """
    sizes = np.array([x.get(name, 0.0) for name in setup.calibration_errors.mode_names])
    if sizes.any():
        setup = setup.with_errors(setup.calibration_errors.errors(sizes))
    camera, laser = setup.camera, setup.laser
    T_tool_camera = _move_pose(camera.T_tool_camera, x, CAMERA_BLOCK)
    plane, change = laser.plane, [x.get(name, 0.0) for name in LASER_BLOCK]
    if any(change):
        plane = _turn_plane(plane, laser.point_mm, *change)
    T_tool_moved = _move_pose(T_tool_camera, x, SENSOR_BLOCK)
    n_x, n_y, n_z, d = (plane @ T_tool_camera @ invert(T_tool_moved)).tolist()
    factor = math.exp(x.get("ln_focal", 0.0))
    camera = replace(camera, T_tool_camera=T_tool_moved, fx=factor * camera.fx, fy=factor * camera.fy)
    changed = replace(setup, camera=camera, laser=replace(laser, plane_in_tool=(n_x, n_y, n_z, d)))
    ratios = {n: x[DIMENSION + n] for n in setup.joint.dimensions if x.get(DIMENSION + n)}
    if not ratios:
        return changed
    stated = setup.joint.dimensions
    dimensions = {**stated, **{n: stated[n] * math.exp(r) for n, r in ratios.items()}}
    return replace(changed, joint=replace(setup.joint, dimensions=dimensions))


def _move_pose(T: Float64, x: Mapping[str, float], block: Sequence[str]) -> Float64:
    change = [x.get(name, 0.0) for name in block]
    return moved(T, change[:3], change[3:]) if any(change) else T


def _turn_plane(
    plane: Float64, point_mm: Float64, steep_deg: float, level_deg: float, off_mm: float
) -> Float64:
    """Return a plane (4,) turned about its steepest and its level line through a point, and moved."""
    normal = plane[:3]
    level = cross(normal, np.array([0.0, 0.0, 1.0]))
    level /= np.linalg.norm(level)
    axis = np.radians(steep_deg) * cross(normal, level) + np.radians(level_deg) * level
    turned = Rotation.from_rotvec(axis).apply(normal)
    return np.append(turned, -turned @ point_mm - off_mm)


def _bends(points_px: Float64, setup: Setup) -> Float64:
    """Return the displacement (k, n, 2), px, of points (n, 2) for one unit of each of `SHAPE_BLOCK`."""
    along_rows = stripe_runs_along_rows(setup)
    size = setup.camera.width if along_rows else setup.camera.height
    place = 2.0 * points_px[:, 0 if along_rows else 1] / size - 1.0
    across = np.array([0.0, 1.0] if along_rows else [1.0, 0.0])
    return np.array([np.outer(legval(place, unit), across) for unit in np.eye(len(SHAPE_BLOCK))])


def _off_section(setup: Setup, in_joint: Float64) -> Float64:
    """Return the distance, mm, of points (n, 3), joint frame, above the joint's section, along its normal."""
    shape = section(setup.joint)
    vertices, y = shape.vertices, in_joint[:, 1]
    z = in_joint[:, 2] - corrugation_height(in_joint[:, 0], shape.corrugation)
    run = np.diff(vertices[:, 0])
    # No point lies on an upright face.
    slope = np.divide(np.diff(vertices[:, 1]), run, out=np.zeros_like(run), where=run > 0.0)
    face = np.clip(np.searchsorted(vertices[:, 0], y) - 1, 0, len(run) - 1)
    plain = vertices[face, 1] + slope[face] * (y - vertices[face, 0])
    return np.asarray((z - plain) / np.hypot(1.0, slope[face]))


def _bin_points(points_px: Float64) -> tuple[Float64, Float64]:
    """Return medians (m, 2) over parts of a stripe (n, 2) and their 1 sigma (m,), px."""
    parts = np.array_split(points_px, min(BINS_A_FRAME, max(1, len(points_px) // MIN_IN_BIN)))
    middles = np.array([np.median(part, axis=0) for part in parts])
    across = 0 if np.ptp(points_px[:, 0]) < np.ptp(points_px[:, 1]) else 1
    sigmas = []
    for part in parts:
        steps = np.diff(part[:, across])
        scatter = float(np.median(np.abs(steps - np.median(steps)))) * 1.05 if len(steps) else 1.0
        sigmas.append(max(MIN_SIGMA_PX, scatter / math.sqrt(len(part))))
    return middles, np.array(sigmas)


def _robust_costs(residuals: Float64) -> Float64:
    """Return what each residual (n,) costs by Huber's rule."""
    return np.asarray(2.0 * huber(HUBER, residuals))


def _size(name: str, block: Sequence[float]) -> tuple[float, float]:
    if name in (CAMERA, SENSOR):
        return float(np.linalg.norm(block[:3])), float(np.linalg.norm(block[3:]))
    if name == LASER:
        return math.hypot(block[0], block[1]), abs(block[2])
    if name == PART:
        return abs(block[4]), math.hypot(block[0], block[1])
    return 0.0, 0.0
