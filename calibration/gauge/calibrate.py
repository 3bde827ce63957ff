"""The laser sheet from a gauge at known poses of the robot, and a check of a sheet against a gauge."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calibration.camera.enough import UndeterminedError
from calibration.gauge.adjustment import (
    SHEET,
    SIZE,
    GaugeFit,
    GaugeProblem,
    GaugeState,
    fit_with_noise,
    inverse,
)
from calibration.gauge.shape import Gauge, Shape
from calibration.gauge.sightings import PosedPieces, StatedSensor, place_gauge
from calibration.outliers import MAX_OUTLIER_SHARE
from noise_model.compiled.arrays import Float64
from noise_model.fit import student_t
from noise_model.transforms import transform

MIN_IMAGES = 4
"""Fewer images determine no sheet and leave nothing to judge it by."""

MAX_LEAN_DEG, MAX_PLACE_MM = 0.5, 0.2
"""Largest 1 sigma of the sheet's tilts and offset: beyond it the sheet is as good as unknown."""

FALSE_ALARM = 0.001
"""The probability that a set without a wrong image loses one."""

MIN_FREEDOM = 2
"""Degrees of freedom of the errors' size, at least."""

SIZE_SIGMA_MM = 0.01
"""1 sigma of a gauge's size: a ground one is better, a milled one as good."""

FEW_IMAGES = 3
"""Fewer images say nothing of the errors: those that are usual count."""

HELD = 1e-9
"""1 sigma of what is held."""

LIFT_MM, TILT_DEG, SPIN_DEG = 10.0, 15.0, 40.0
"""The motions that are proposed where some are missing: the stripe still crosses the gauge."""


@dataclass(frozen=True)
class GaugeCalibration:
    """Sheet calibrated with a gauge; `left_out` maps unused images to the reason."""

    problem: GaugeProblem
    fitted: GaugeFit
    left_out: dict[str, str]

    @property
    def plane(self) -> Float64:
        """The sheet (4,) in the tool frame, n.X + d = 0, mm."""
        return self.fitted.state.plane

    @property
    def sigma(self) -> Float64:
        """1 sigma (3,) of its two tilts, rad, and of its offset at the middle of the points, mm."""
        return np.asarray(np.sqrt(np.diag(self.tilt_offset_covariance)))

    @property
    def tilt_offset_covariance(self) -> Float64:
        """Covariance (3, 3) of tilts and offset."""
        wider = small_sample_factor(self.problem.gauge, len(self.fitted.counts))
        return np.asarray(self.fitted.covariance[SHEET, SHEET] * wider**2)

    @property
    def plane_per_move(self) -> Float64:
        """The plane's derivatives (4, 3) by tilts and offset."""
        state = self.fitted.state
        per = np.zeros((4, 3))
        per[:3, :2], per[3, :2], per[3, 2] = state.leans.T, -state.leans @ state.centre_mm, 1.0
        return per

    @property
    def covariance(self) -> Float64:
        """The covariance (4, 4) of the plane, of rank 3."""
        per = self.plane_per_move
        return np.asarray(per @ self.tilt_offset_covariance @ per.T)

    @property
    def off_mm(self) -> tuple[Float64, ...]:
        """Distance of each image's points from the gauge's faces."""
        off = self.problem.distances(self.fitted.state)
        return tuple(off[part] for part in self.problem.slices)


@dataclass(frozen=True)
class GaugeCheck:
    """Check of a setup with a gauge: its size free, the sheet as stated.

    `size_mm` is what the setup measures, with 1 sigma; `left_out` maps images that show no such gauge to the
    reason.
    """

    problem: GaugeProblem
    fitted: GaugeFit
    size_mm: float
    sigma_mm: float
    left_out: dict[str, str]

    @property
    def off_mm(self) -> float:
        """The size that is measured less the gauge's own."""
        return self.size_mm - self.problem.gauge.size_mm


def small_sample_factor(gauge: Gauge, images: int) -> float:
    """Return the factor of sigmas for the few images that determine the errors: Student's t.

    Across a V an image determines the robot's error in two directions, across a step in its height alone.
    Sheet and gauge take some of that. A plate tells no more than a step.
    """
    freedom = 2 * images - 7 if gauge.shape is Shape.V else images - 4
    return student_t(0.95, max(freedom, MIN_FREEDOM)) / student_t(0.95, math.inf)


def calibrate_gauge(
    shown: Sequence[PosedPieces], gauge: Gauge, sensor: StatedSensor, up: Float64
) -> GaugeCalibration:
    """Find the sheet from stripes on a gauge that stands still in base.

    `up` is the direction out of the gauge's top, within some degrees, base frame. UndeterminedError where the
    poses do not determine the sheet, with the motion that is missing.
    """
    start, sightings, left_out = place_gauge(shown, gauge, sensor, up)
    _check_count(len(sightings), left_out)
    problem = GaugeProblem(gauge, sensor.T_tool_camera, tuple(sightings))
    known = np.full(SIZE + 1, np.inf)
    known[SIZE] = SIZE_SIGMA_MM
    problem, fitted = fit_consistent(problem, start, known, left_out)
    result = GaugeCalibration(problem, fitted, left_out)
    form_mm = float(fitted.noise_mm[1])
    if form_mm > 0.1:
        raise UndeterminedError(
            f"the stripe's pieces lie {form_mm:.2f} mm off the faces of {gauge}, 1 σ: it is another gauge, "
            "or camera and lens are not as the setup has them"
        )
    missing = missing_motion(problem, fitted)
    if missing is not None:
        raise UndeterminedError(missing)
    return result


def fit_consistent(
    problem: GaugeProblem, start: GaugeState, known: Float64, left_out: dict[str, str]
) -> tuple[GaugeProblem, GaugeFit]:
    """Fit the images that agree; the others are left out one by one, the worst first, each with the reason.

    UndeterminedError where more of them disagree than may be left out.
    """
    count, fitted = len(problem.sightings), fit_with_noise(problem, start, known)
    while len(problem.sightings) > MIN_IMAGES:
        worst = int(np.argmax(fitted.squares / fitted.counts))
        rest = replace(problem, sightings=(*problem.sightings[:worst], *problem.sightings[worst + 1 :]))
        without = fit_with_noise(rest, start, known)
        if not _is_wrong(problem, worst, without):
            break
        if count - len(rest.sightings) > MAX_OUTLIER_SHARE * count:
            raise UndeterminedError(
                f"more than {100.0 * MAX_OUTLIER_SHARE:.0f} % of the stripes do not lie where the others do: "
                f"the {problem.gauge.noun} moved, or the poses are others"
            )
        left_out[problem.sightings[worst].name] = (
            f"its stripe does not lie where the others' do: the {problem.gauge.noun} moved, or the pose is "
            "another's"
        )
        problem, fitted = rest, without
    return problem, fitted


def _is_wrong(problem: GaugeProblem, image: int, without: GaugeFit) -> bool:
    """Return True if an image contradicts a fit without it beyond noise and that fit's errors."""
    part = problem.slices[image]
    d, J = problem.misfits(without.state)[part], problem.slopes(without.state)[part]
    C = problem.covariances(without.state, without.noise_mm)[image] + J @ without.covariance @ J.T
    square = float(d @ np.linalg.solve(C, d)) / small_sample_factor(problem.gauge, len(without.counts)) ** 2
    return square > float(chi2.isf(FALSE_ALARM / len(problem.sightings), len(d)))


def _check_count(images: int, left_out: dict[str, str]) -> None:
    if images >= MIN_IMAGES:
        return
    why = f": {next(iter(left_out))} {next(iter(left_out.values()))}" if left_out else ""
    raise UndeterminedError(
        f"{images} image{'s show' if images != 1 else ' shows'} the gauge{why}: {MIN_IMAGES} at least are "
        "needed, and 12 are good; one is enough for --check"
    )


def _excess(information: Float64) -> Float64:
    """Return the ratio of the sheet's sigmas (3,) to their limits: two tilts, and the offset."""
    sigma = np.sqrt(np.diag(inverse(information)))[SHEET]
    return np.array([*(sigma[:2] / math.radians(MAX_LEAN_DEG)), sigma[2] / MAX_PLACE_MM])


def missing_motion(problem: GaugeProblem, fitted: GaugeFit) -> str | None:
    """Return what is missing to determine the sheet, in words; None where it is determined."""
    excess = _excess(fitted.information)
    motions = telling_motions(problem, fitted)
    if not motions:
        return None
    sigma = excess * [MAX_LEAN_DEG, MAX_LEAN_DEG, MAX_PLACE_MM]
    leans = f"its leans are known to {_rounded(sigma[0], '°')} and {_rounded(sigma[1], '°')}"
    return (
        f"the sheet is not determined: {leans}, its place to {_rounded(sigma[2], ' mm')} (1 σ). Add images "
        f"for which you {', and '.join(motions)}"
    )


def telling_motions(problem: GaugeProblem, fitted: GaugeFit) -> list[str]:
    """Return the motions, two at most, by whose images the sheet would be known best; none if it is known.

    Each motion is tried.
    """
    information, wanted = fitted.information, list[str]()
    if _excess(information).max() <= 1.0:
        return wanted
    for _ in range(2):
        gains = {
            what: information + sum(_information(problem, fitted, T) for T in poses)
            for what, poses in _motions(problem, fitted.state).items()
            if what not in wanted
        }
        best = min(gains, key=lambda what: float(_excess(gains[what]).max()))
        wanted.append(best)
        information = gains[best]
        if _excess(information).max() <= 1.0:
            break
    return wanted


def _rounded(value: float, unit: str) -> str:
    return f"{value:.2g}{unit}" if value < 90.0 else "nothing"


def _motions(problem: GaugeProblem, state: GaugeState) -> dict[str, tuple[Float64, Float64]]:
    """Return motions of the tool by name, each with two poses (4, 4), about the stripe's middle."""
    T = problem.sightings[0].T_base_tool
    middle = T[:3, :3] @ state.centre_mm + T[:3, 3]

    def turned(axis: int, angle_deg: float) -> Float64:
        R = Rotation.from_rotvec(math.radians(angle_deg) * T[:3, axis]).as_matrix()
        other = np.eye(4)
        other[:3, :3], other[:3, 3] = R, middle - R @ middle
        return np.asarray(other @ T)

    def lifted(by_mm: float) -> Float64:
        other = T.copy()
        other[:3, 3] += by_mm * state.T_base_gauge[:3, 2]
        return other

    return {
        f"raise and lower the tool by {LIFT_MM:g} mm": (lifted(LIFT_MM), lifted(-LIFT_MM)),
        f"tilt the tool by ±{TILT_DEG:g}° about its x": (turned(0, TILT_DEG), turned(0, -TILT_DEG)),
        f"tilt the tool by ±{TILT_DEG:g}° about its y": (turned(1, TILT_DEG), turned(1, -TILT_DEG)),
        f"turn the tool by ±{SPIN_DEG:g}° about its z": (turned(2, SPIN_DEG), turned(2, -SPIN_DEG)),
        "turn the tool by 180° about its z": (turned(2, 180.0), turned(2, 180.0 - SPIN_DEG)),
    }


def _information(problem: GaugeProblem, fitted: GaugeFit, T_base_tool: Float64) -> Float64:
    """Return the information of an image at another pose, its stripe as wide and as noisy as the others."""
    state, like = fitted.state, problem.sightings[0]
    to_camera = np.asarray(np.linalg.inv(T_base_tool @ problem.T_tool_camera), dtype=np.float64)
    normals, offsets = problem.gauge.faces
    in_tool = np.linalg.inv(T_base_tool) @ state.T_base_gauge
    ends = problem.points_base(state)[problem.slices[0]][[0, -1]]
    is_plate = problem.gauge.shape is Shape.PLATE
    reach = float(np.linalg.norm(ends[1] - ends[0])) if is_plate else max(3.0 * state.size_mm, 5.0)
    rows: list[Float64] = []
    for n, face in enumerate(like.faces.tolist()):
        m = in_tool[:3, :3] @ normals[face]
        point = in_tool[:3, 3] + offsets[face] * state.size_mm * m
        along = np.cross(m, state.plane[:3])
        along = along / max(float(np.linalg.norm(along)), 1e-9)
        place = np.linalg.lstsq(
            np.stack([m, state.plane[:3], along]),
            np.array([m @ point, -state.plane[3], along @ point]),
            rcond=None,
        )[0]
        share = n / (len(like.rays) - 1) if is_plate else n % 2
        rows.append(place + (share - 0.5) * reach * along)
    seen = transform(to_camera, transform(T_base_tool, np.array(rows)))
    rays = seen / seen[:, 2:]
    sighting = replace(like, T_base_tool=T_base_tool, rays=rays)
    other = replace(problem, sightings=(sighting,))
    J = other.slopes(state)
    return np.asarray(J.T @ np.linalg.solve(other.covariances(state, fitted.noise_mm)[0], J))


def check_gauge(shown: Sequence[PosedPieces], gauge: Gauge, sensor: StatedSensor, up: Float64) -> GaugeCheck:
    """Measure a gauge's size by a sheet as stated, in one image or more.

    UndeterminedError where none shows the gauge.
    """
    start, sightings, left_out = place_gauge(shown, gauge, sensor, up)
    if not sightings:
        name, reason = next(iter(left_out.items()))
        raise UndeterminedError(f"no image shows the gauge: {name} {reason}")
    problem = GaugeProblem(gauge, sensor.T_tool_camera, tuple(sightings))
    # One image does not determine all of a gauge's tilt against its stripes.
    tilt = math.radians(3.0)
    held = np.array([*[HELD] * 3, tilt, tilt, *[np.inf] * 4])
    fitted = fit_with_noise(problem, start, held)
    sigma = math.sqrt(float(fitted.covariance[SIZE, SIZE]))
    if len(sightings) >= FEW_IMAGES:
        sigma *= small_sample_factor(gauge, len(sightings))
    return GaugeCheck(problem, fitted, fitted.state.size_mm, sigma, left_out)


def check_each(shown: Sequence[PosedPieces], gauge: Gauge, sensor: StatedSensor) -> list[GaugeCheck]:
    """Measure a gauge's size in each image alone: nothing is known of the robot, but that it stands upright.

    Poses are not used. UndeterminedError where no image shows the gauge.
    """
    up = np.array([0.0, 0.0, 1.0])
    checks, why = [], None
    for each in shown:
        alone = replace(each, T_base_tool=np.eye(4))
        try:
            checks.append(check_gauge([alone], gauge, sensor, up))
        except UndeterminedError as error:
            why = error
    if why is not None and not checks:
        raise why
    return checks
