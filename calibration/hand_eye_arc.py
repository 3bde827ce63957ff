"""Calibration of the camera's pose in the tool from the arc's own light.

The stripe alone cannot distinguish a camera that is off by a tenth of a millimetre from a part that is. The
arc can: it burns below the tool's origin, and the fall-off of its reflected light over the image determines
the camera's position relative to it. The estimate is the maximum a posteriori of camera, light and seam
together. The model's own possible errors are fitted too, each with its own prior, so the camera's covariance
includes what they leave open: the arc's position, radius and level, the metal's reflectance, a smooth error
of brightness over the image. A result far outside its prior is refused.

The seam moves with the camera: where the tracker sees it in the image stays, and each camera puts it
elsewhere in space. Between and beyond the observations it may run as its curve's posterior modes say.

Each round chooses pixels that lie off the edges of the joint's faces, linearises their residuals, and moves
to the fit's result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.arc_pixels import ArcPixels
from noise_model.arc.scene import make_scene
from noise_model.calibration_errors import POSE
from noise_model.compiled.arrays import Float64
from noise_model.effects import apply_setup_effects
from noise_model.even_sample import evenly
from noise_model.fit import Fit, Parameter, fit
from noise_model.instrument.camera import Rays
from noise_model.instrument.sensor import variance_e2
from noise_model.setup import Setup
from noise_model.transforms import moved, transform
from tracker.arc.level import HUBER
from tracker.geometry import SensorGeometry
from tracker.seam.curve import SeamCurve
from tracker.seam_observations import SeamObservations
from tracker.state import Frame, Pose

MAX_FRAMES, MAX_SIGHTINGS = 48, 300
"""Largest number of compared frames with the arc on, and of observations of the seam; of more every n-th."""

FIELD_SIGMA = 0.006
"""Smooth relative error of the arc's light over the image, 1 sigma of each of `FIELDS`.

It is the model's floor of the diagnosis, taken as alike in all frames: vignetting, the lens, the filter.
"""

ARC_SIGMA_MM, ARC_RADIUS_SIGMA, REFLECTANCE_SIGMA = 0.1, 0.1, 0.1
"""1 sigma of the arc's place in the tool, and, relative, of its radius, of kappa_diff and of c2."""

NEAR_SIGMAS, SETTLED_SIGMAS, MAX_ROUNDS = 1.0, 0.3, 20
"""Motion of the camera, in its sigmas, below which pixels are kept and rounds end, and their largest number.
"""

FAR_SIGMAS = 4.0
"""Distance from a prior, in its sigmas, at which something else is wrong."""

MAX_LEVEL_FACTOR = 20.0
"""Ratio of the arc's brightness to the stated one, either way, at which something else is wrong."""

MAX_ERROR_RATIO = 0.7
"""The seam's expected error after over that before from which on there is no clear gain."""

CAMERA = ("rot_x", "rot_y", "rot_z", "move_x", "move_y", "move_z")
ARC = ("arc_x", "arc_y", "arc_z")
FIELDS = ("field_u", "field_v", "field_uu", "field_uv", "field_vv")


@dataclass(frozen=True, eq=False)
class HandEye:
    """The result: T_tool_camera (4, 4), mm, the fit behind it, and the seam's expected error.

    `seam_sigma_before_mm` and `seam_sigma_after_mm` (2,) are 1 sigma of the seam point's y and z, mm, that
    the camera's stated tolerance leaves and that the fit leaves, RMS over the recording's poses.
    """

    T_tool_camera: Float64
    fit: Fit
    seam_sigma_before_mm: Float64
    seam_sigma_after_mm: Float64

    @property
    def error_ratio(self) -> float:
        """The expected error after over that before, y and z together."""
        before, after = (
            float(np.hypot(*sigma_mm)) for sigma_mm in (self.seam_sigma_before_mm, self.seam_sigma_after_mm)
        )
        return after / before if before > 0.0 else 1.0

    @property
    def is_gain(self) -> bool:
        """True if the seam's expected error is clearly smaller after than before."""
        return self.error_ratio < MAX_ERROR_RATIO


def estimate_hand_eye(
    setup: Setup,
    frames: Sequence[tuple[Frame, Pose]],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> HandEye:
    """Estimate T_tool_camera from frames and their poses, some of them with the arc on.

    Frames of unknown current count where none is known. `progress` is called with the rounds done and their
    largest number. Raises ValueError if the setup states no arc or no metal, if no frame has the arc on or
    none of them a pixel to compare, if the joint was found in none, if the rounds do not converge, or if
    camera, arc or metal would have to be off by more than FAR_SIGMAS of their priors or the arc's level by a
    factor of MAX_LEVEL_FACTOR.
    """
    setup.require("the hand-eye estimate", "arc", "material")
    lit = [(frame, pose.T_base_tool) for frame, pose in frames if frame.arc_on and frame.current_a != 0.0]
    if any(frame.current_a > 0.0 for frame, _ in lit):
        # Levels are fitted about one for all: a frame whose current is unknown may have any other.
        lit = [(frame, T_base_tool) for frame, T_base_tool in lit if frame.current_a > 0.0]
    if not lit:
        raise ValueError("no frame has the arc on: the hand-eye estimate needs the arc's light")
    problem = _ArcHandEyeProblem.of(setup, _sightings(setup, frames), lit)
    result = _fit_in_rounds(problem, progress)
    prior = np.diag([parameter.prior_sigma**2 for parameter in result.parameters[:6]])
    fitted = problem.setup_at(result.values)
    return HandEye(
        fitted.camera.T_tool_camera,
        result,
        seam_sigma_mm(fitted, problem.sightings, prior),
        seam_sigma_mm(fitted, problem.sightings, result.covariance[:6, :6]),
    )


def seam_sigma_mm(setup: Setup, sightings: SeamObservations, covariance: Float64) -> Float64:
    """Return 1 sigma (2,) of the seam point's y and z, mm, RMS over sightings, of an uncertain camera.

    `covariance` (6, 6), deg and mm, is that of the camera's turn and move in its own frame. What is seen in
    the image stays: sigma^2 = <(dy/dx) C (dy/dx)^T>.
    """
    steps = np.diag(CAMERA_STEPS)
    _, here = sightings.in_joint(setup)
    slopes = np.stack(
        [
            (sightings.in_joint(with_camera(setup, step))[1] - here) / size
            for step, size in zip(steps, CAMERA_STEPS, strict=True)
        ]
    )
    variance = np.einsum("pna,pq,qna->na", slopes, covariance, slopes)
    return np.asarray(np.sqrt(variance.mean(axis=0)))


CAMERA_STEPS = np.array([0.03, 0.03, 0.03, 0.04, 0.04, 0.04])
"""Steps of the derivatives with the camera's turn, deg, and move, mm: the light of a shaded sheet is not
smooth over smaller ones."""


def with_camera(setup: Setup, change: Float64) -> Setup:
    """Return the setup with its camera turned and moved by (6,), deg and mm."""
    T_tool_camera = moved(setup.camera.T_tool_camera, change[:3], change[3:6])
    return replace(setup, camera=replace(setup.camera, T_tool_camera=T_tool_camera))


def _sightings(setup: Setup, frames: Sequence[tuple[Frame, Pose]]) -> SeamObservations:
    """Return an even sample of the tracker's seam observations; ValueError without any."""
    poses = [lambda _, T_base_tool=pose.T_base_tool: T_base_tool for _, pose in frames]
    sightings = SeamObservations.of(setup, [frame for frame, _ in frames], poses)
    if not len(sightings.image_px):
        raise ValueError("the joint was found in no frame: the hand-eye estimate needs its place")
    return sightings.thinned(MAX_SIGHTINGS)


@dataclass(frozen=True, eq=False)
class _ArcHandEyeProblem:
    """Least-squares problem: parameters (p,) in the order of `parameters`, of frames with the arc on.

    `curve` is the seam through the sightings as the stated camera puts them.
    """

    setup: Setup
    sightings: SeamObservations
    curve: SeamCurve
    lit: list[tuple[Frame, Float64]]
    rays: Rays

    @classmethod
    def of(
        cls, setup: Setup, sightings: SeamObservations, lit: list[tuple[Frame, Float64]]
    ) -> _ArcHandEyeProblem:
        """Take the frames under whose stripe the seam is known; ValueError if it is under none."""
        true = apply_setup_effects(setup)
        scenes = [make_scene(true, T_base_tool) for _, T_base_tool in lit]
        curve = _curve(setup, sightings, np.array([scene.stations_mm for scene in scenes]))
        # The seam under a frame's stripe must be known to 0.2 mm.
        is_known = [
            curve.sigma_mm(float(transform(scene.T_joint_tool, setup.laser.point_mm)[0])).max() <= 0.2
            for scene in scenes
        ]
        if not any(is_known):
            raise ValueError(
                "the joint was found near no frame with the arc on: the hand-eye estimate needs the seam "
                "there"
            )
        kept = np.flatnonzero(is_known)
        kept = kept[evenly(len(kept), MAX_FRAMES)]
        curve = _curve(setup, sightings, np.array([scenes[n].stations_mm for n in kept]))
        return cls(setup, sightings, curve, [lit[n] for n in kept], Rays.of(true.camera))

    @property
    def parameters(self) -> list[Parameter]:
        """The parameters: camera, light, arc, metal, seam, fields, levels of the frames."""
        tolerance, ln_level = self.setup.tolerance, math.log(MAX_LEVEL_FACTOR)
        sigmas = np.maximum(self.setup.calibration_errors.sigmas(POSE), 1e-6).tolist()
        black_e = max(tolerance.black_level_dn * self.setup.sensor.gain_e_per_dn, 1e-3)
        return [
            *(
                Parameter(name, "deg" if name.startswith("rot") else "mm", 0.0, sigma, step=step)
                for name, sigma, step in zip(CAMERA, sigmas, CAMERA_STEPS.tolist(), strict=True)
            ),
            Parameter("ln_arc_level", "", 0.0, lower=-ln_level, upper=ln_level, step=1e-3),
            Parameter("black_level", "e-", 0.0, black_e, step=1.0),
            *(Parameter(name, "mm", 0.0, ARC_SIGMA_MM, step=0.05) for name in ARC),
            Parameter("ln_arc_radius", "", 0.0, ARC_RADIUS_SIGMA, step=0.05),
            *(Parameter(name, "", 0.0, REFLECTANCE_SIGMA, step=0.05) for name in ("ln_kappa_diff", "ln_c2")),
            *(Parameter(f"seam_{n}", "", 0.0, 1.0, step=0.3) for n in range(self.curve.n_modes)),
            *(Parameter(name, "", 0.0, FIELD_SIGMA, step=1e-3) for name in FIELDS),
            *(Parameter(f"ln_level_{frame.index}", "", 0.0, 0.1, step=1e-3) for frame, _ in self.lit),
        ]

    @property
    def _seam(self) -> slice:
        return slice(14, 14 + self.curve.n_modes)

    def setup_at(self, x: Float64) -> Setup:
        """Return the setup with camera, arc and metal as parameters (p,) say."""
        setup = with_camera(self.setup, x[:6])
        x_mm, y_mm, z_mm = np.asarray(setup.arc.center_in_tool_mm) + x[8:11]
        arc = replace(
            setup.arc,
            center_in_tool_mm=(float(x_mm), float(y_mm), float(z_mm)),
            radius_mm=setup.arc.radius_mm * math.exp(x[11]),
        )
        metal = setup.material
        metal = replace(metal, kappa_diff=metal.kappa_diff * math.exp(x[12]), c2=metal.c2 * math.exp(x[13]))
        return replace(setup, arc=arc, material=metal)

    def seam_at(self, x: Float64) -> SeamCurve:
        """Return the seam through the sightings as the camera of parameters (p,) puts them."""
        seen = self.sightings.in_joint(with_camera(self.setup, x[:6]))
        return self.curve.through(*seen, self.sightings.variances_mm2)

    def choose(self, x: Float64) -> list[ArcPixels]:
        """Choose each frame's pixels, all as parameters (p,) say."""
        geometry, curve = SensorGeometry.of(self.setup_at(x)), self.seam_at(x)
        return [
            ArcPixels.of(geometry, self.rays, curve, x[self._seam], frame, T_base_tool)
            for frame, T_base_tool in self.lit
        ]

    def light(self, views: Sequence[ArcPixels], x: Float64) -> tuple[Float64, Float64]:
        """Return the arc's light at its stated levels and the other light (n,), e-, of all frames' pixels."""
        setup, curve = self.setup_at(x), self.seam_at(x)
        lights = [view.light(setup, self.rays, curve, x[self._seam]) for view in views]
        arc_e, other_e = (np.concatenate(parts) for parts in zip(*lights, strict=True))
        return arc_e, other_e

    def linear(self, views: Sequence[ArcPixels], x: Float64) -> tuple[Float64, Float64]:
        """Return the whitened residuals (n,) at parameters (p,) and their derivatives (n, p).

        Pixels that come to see another face over a derivative's step, or whose light has a kink there, as at
        a penumbra's border, are left out. The mean is

            exp(ln_arc_level + ln_level) (1 + sum_k field_k phi_k(u, v)) arc_e + other_e + black_level.
        """
        parameters = self.parameters
        u, v = np.concatenate([view.place for view in views]).T
        fields = np.stack([u, v, u * u, u * v, v * v])
        frame_of = np.repeat(np.arange(len(views)), [len(view.charge_e) for view in views])
        first_field = self._seam.stop
        first_level = first_field + len(FIELDS)
        level = np.exp(x[6] + x[first_level:][frame_of])
        factor = level * (1.0 + x[first_field:first_level] @ fields)
        arc_e, other_e = self.light(views, x)
        mean_e = factor * arc_e + other_e + x[7]
        J_e = np.zeros((len(mean_e), len(parameters)))
        smooth = np.isfinite(mean_e)
        for n in (*range(6), *range(8, first_field)):
            step = parameters[n].step * np.eye(len(x))[n]
            below_e, above_e = (
                factor * arc_there_e + other_there_e
                for arc_there_e, other_there_e in (self.light(views, x - step), self.light(views, x + step))
            )
            J_e[:, n] = (above_e - below_e) / (2.0 * parameters[n].step)
            # An arc that is wider is brighter by a square: only what moves the view tells a kink.
            if n < 6:
                kink_e = above_e - 2.0 * (factor * arc_e + other_e) + below_e
                # A pixel counts if its light is smooth over a derivative's step.
                smooth &= ~(np.abs(kink_e) > 0.003 * factor * arc_e)
        smooth &= np.isfinite(J_e).all(axis=1)
        J_e[:, 6], J_e[:, 7] = factor * arc_e, 1.0
        J_e[:, first_field:first_level] = (level * arc_e * fields).T
        J_e[:, first_level:] = (factor * arc_e)[:, None] * (frame_of[:, None] == np.arange(len(views)))
        # Beyond its noise the light scatters by 2 % from pixel to pixel.
        sigma_e = np.sqrt(variance_e2(mean_e, self.setup.sensor) + (0.02 * (mean_e - x[7])) ** 2)
        charge_e = np.concatenate([view.charge_e for view in views])
        residuals, J = (charge_e - mean_e) / sigma_e, -J_e / sigma_e[:, None]
        return residuals[smooth], J[smooth]


def _curve(setup: Setup, sightings: SeamObservations, stations_mm: Float64) -> SeamCurve:
    """Return the seam through sightings over all stations (n, 3) that frames and their torch need."""
    return SeamCurve.of(
        *sightings.in_joint(setup),
        sightings.variances_mm2,
        (float(stations_mm.min()), float(stations_mm.max())),
        setup.joint.has_ridges,
        systematic=(0.0, 0.0),
    )


def _fit_in_rounds(problem: _ArcHandEyeProblem, progress: Callable[[int, int], None]) -> Fit:
    """Choose pixels and fit in turn until the camera settles; ValueError if it does not, or far off."""
    parameters = problem.parameters
    # A round goes no further than 3 sigmas of the priors.
    reach = 3.0 * np.array([parameter.prior_sigma for parameter in parameters])
    x = np.zeros(len(parameters))
    is_near = is_settled = False
    for done in range(MAX_ROUNDS):
        progress(done, MAX_ROUNDS)
        if not is_near:
            views = problem.choose(x)
        if done == 0:
            x[6] = _ln_level(problem, views, x)
        residuals, J = problem.linear(views, x)
        result = _fit(parameters, residuals, J, x)
        step = result.values - x
        # Other pixels would say something else each time: near the end they stay.
        camera_sigmas = np.abs(step / result.sigmas)[:6].max()
        is_near, is_settled = camera_sigmas < NEAR_SIGMAS, camera_sigmas < SETTLED_SIGMAS
        if is_settled:
            break
        x = x + np.clip(step, -reach, reach)
    progress(MAX_ROUNDS, MAX_ROUNDS)
    _check(result)
    if not is_settled:
        raise ValueError(
            f"camera and seam do not settle in {MAX_ROUNDS} rounds: arc, material or joint are not as "
            "stated, or it takes more frames with the arc on"
        )
    return result


def _fit(parameters: Sequence[Parameter], residuals: Float64, J: Float64, x: Float64) -> Fit:
    """Fit parameters (p,) to residuals (n,) that are linear about `x`."""
    return fit(parameters, lambda there: residuals + J @ (there - x), huber=HUBER, start=x)


def _ln_level(problem: _ArcHandEyeProblem, views: Sequence[ArcPixels], x: Float64) -> float:
    """Return about which level, within its bounds, the arc has where camera and seam are as stated."""
    arc_e, _ = problem.light(views, x)
    if not np.nansum(arc_e) > 0.0:
        raise ValueError(
            "no pixel with the arc's light is below saturation, off the stripe and off the joint's edges: "
            "shorten the exposure"
        )
    # All at once: of pixels in shadow nothing is expected.
    charge_e = sum(float(view.charge_e.sum()) for view in views)
    factor = charge_e / float(np.nansum(arc_e))
    return math.log(min(max(factor, 1.0 / MAX_LEVEL_FACTOR), MAX_LEVEL_FACTOR))


def _check(result: Fit) -> None:
    """Raise ValueError if something would have to be further off than its prior lets it be."""
    if "ln_arc_level" in result.at_bounds:
        raise ValueError(
            f"the arc would have to be off by a factor of {MAX_LEVEL_FACTOR:g}: arc or material are not as "
            "stated, or there are too few frames with the arc on"
        )
    sigmas = np.array([parameter.prior_sigma for parameter in result.parameters])
    off = np.abs(result.values / sigmas)
    far = float(off[:6].max())
    if far > FAR_SIGMAS:
        raise ValueError(
            f"the camera would have to be off by {far:.0f} of its stated sigmas: arc or material are not as "
            "stated, or [tolerance] hand_eye_deg and hand_eye_mm are too small"
        )
    first_field = next(n for n, parameter in enumerate(result.parameters) if parameter.name == FIELDS[0])
    light = [*range(8, 14), *range(first_field, first_field + len(FIELDS))]
    worst = max(light, key=lambda n: float(off[n]))
    if off[worst] > FAR_SIGMAS:
        parameter = result.parameters[worst]
        size = f"{result.values[worst]:.2g} {parameter.unit}".rstrip()
        raise ValueError(
            f"{parameter.name} would have to be off by {size}, {off[worst]:.0f} sigmas: arc, material or "
            "lens are not as stated; arctrack diagnose says which"
        )
