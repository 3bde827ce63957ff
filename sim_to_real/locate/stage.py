"""The stage at which the residual becomes simplest.

Undo the sensor, the lens, the light: at the stage where the gap arises it is a function of few numbers of
that stage's own coordinates, and at the others a complicated one. So each stage has forms that a gap of its
own may take, each with few coefficients: the sensor a function of the grey level or of time; the lens
factors over the image, stray light, a blur; a source its level frame by frame, its place; the surface
functions of its angles, and its light's parts; the medium light that falls off about the arc, or sparks;
geometry and timing the change of the image with the camera's pose, the plate's tilt, the clock. A form's
share is what it explains of the gap on frames that it was not fitted to, nuisances fitted with it, less a
little for each coefficient.

None of this looks into the catalogue of effects, so it stands where the catalogue ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from noise_model.arrays import Float32, Float64, Int64
from noise_model.effects import apply_setup_effects
from noise_model.effects.effect import Stage
from noise_model.forward import look
from noise_model.instrument.camera import Camera, Rays
from noise_model.setup import Setup
from noise_model.surface.brdf import Material
from noise_model.surface.joint import BentSeam, seam_frame
from noise_model.transforms import invert, moved
from sim_to_real.data.binned import THIN, ObservedFrame
from sim_to_real.fit.linearized_model import Expected
from sim_to_real.fit.nuisances import N_LEVELS, SEAM_FROM, really_there
from sim_to_real.locate.covariates import Covariates, Fitted
from sim_to_real.locate.residual_structure import filled, noise_shares
from sim_to_real.locate.spline_term import LEAST_EXCESS, HeldOut, hats, hats_of_two

PER_COEFFICIENT = 0.002
"""What a form pays of its share for each coefficient: of two that explain the same the simpler is meant."""

LEVELS = (0, 1)
"""Nuisances that are let go: that a lamp is brighter than stated says nothing of how its light is lost."""

DEFOCUS_BINS = 1.0
"""1 sigma of the blur whose difference from the image stands for a wider point-spread function."""

BLOCKS, BLOCK_BINS = 4, 20
"""A frame's level is told from all but one of so many parts, each of blocks so many bins wide."""


Form = tuple[Stage, str, tuple[str, ...]]

Found = list[tuple[Stage, str, float]]


@dataclass(frozen=True)
class StageShare:
    """Which share of the gap, 0 to 1, the best form of a stage explains, and that form's name."""

    stage: str
    form: str
    share: float


@dataclass(frozen=True)
class Moved:
    """What moves by a few numbers: which stage that belongs to, the steps of its tangents, its reach."""

    stage: Stage
    steps: tuple[float, ...]
    reach: tuple[float, ...]


MOVED: Mapping[str, Moved] = {
    "place of the arc": Moved(Stage.SOURCE, (0.3, 0.3, 0.3, 0.15), (3.0, 3.0, 3.0, 0.7)),
    "pose of the camera": Moved(Stage.GEOMETRY, (), (2.0, 2.0, 2.0, 2.5, 2.5, 2.5)),
    "tilt of the plate": Moved(Stage.GEOMETRY, (0.7, 0.7), (6.0, 6.0)),
    "clock": Moved(Stage.TIMING, (0.015,), (0.15,)),
}
"""What is rendered: the arc's centre (mm) and ln radius, the camera's turn (deg) and move (mm), roll and
pitch (deg), the delay (s). The camera's tangents are those of its nuisances."""

CAMERA_COLUMNS = slice(N_LEVELS, SEAM_FROM)
"""Where the camera's pose is among the nuisances."""

FORMS: tuple[Form, ...] = (
    (Stage.SOURCE, "arc over the field", ("arc_radial",)),
    (Stage.SOURCE, "arc over time", ("arc_time",)),
    (Stage.SOURCE, "arc over current", ("arc_current",)),
    (Stage.ILLUMINATION, "laser over time", ("laser_time",)),
    (Stage.ILLUMINATION, "laser along its fan", ("laser_column",)),
    (Stage.SURFACE, "arc over half angle", ("arc_half_angle",)),
    (Stage.SURFACE, "arc over half angle and azimuth", ("arc_half_angle", "arc_phi_r")),
    (
        Stage.SURFACE,
        "light over all angles",
        ("arc_half_angle", "arc_theta_i", "arc_theta_r", "laser_theta_r"),
    ),
    (Stage.SURFACE, "lobe and diffuse", ("parts", "laser_theta_r")),
    (Stage.SURFACE, "light between faces", ("add_concavity",)),
    (Stage.MEDIUM, "glow about the arc", ("add_distance",)),
    (Stage.MEDIUM, "arc's light about the arc", ("add_arc_distance", "light_radial")),
    (Stage.OPTICS, "fall-off", ("light_radial",)),
    (Stage.OPTICS, "fall-off of either light", ("arc_radial", "laser_radial")),
    (Stage.OPTICS, "factor over the image", ("light_image",)),
    (Stage.OPTICS, "mean light", ("mean_light",)),
    (Stage.OPTICS, "mean light over the field", ("mean_light_radial",)),
    (Stage.OPTICS, "blur", ("blur",)),
    (Stage.SENSOR, "grey level", ("add_gray_level",)),
    (Stage.SENSOR, "light over time", ("light_time",)),
    (Stage.GEOMETRY, "distortion", ("distortion",)),
)
"""The stages' forms that are linear in the columns named."""


def stages(expected: Expected, fits: Sequence[tuple[Fitted, Covariates]]) -> tuple[StageShare, ...]:
    """Return all stages, the one at which the residuals are simplest first.

    Of several fits it is those of the one whose simplest form leaves least.

    A large gap pulls the nuisances of a fit so far that nothing about it is simple: then the stated values
    (`covariates.Start`) are nearer the truth. They are not where the seam or the camera is off.
    """
    return min((_explained(expected, *fit) for fit in fits), key=lambda explained: explained[1])[0]


def _explained(
    expected: Expected, fit: Fitted, covariates: Covariates
) -> tuple[tuple[StageShare, ...], float]:
    """Return all stages, and what the best form leaves of the excess of the mean square over noise."""
    held = HeldOut.of(covariates, fit.residuals, free=LEVELS)
    views = _Views(expected, fit, held)
    columns = linear_columns(held.covariates, covariates, held.chosen, expected.observed.setup.camera)
    columns["parts"] = views.parts()
    forms = list(FORMS)
    tangents = views.tangents()
    for name, moving in MOVED.items():
        columns[name] = np.hstack([tangents[name], views.secant(name, tangents[name])])
        forms.append((moving.stage, name, (name,)))
    found = ranked(
        forms_explained(held, columns, forms) + unsmooth_explained(held, covariates, fit.residuals)
    )
    return found, max(held.mean_square - held.alone - 1.0, 0.0) * (1.0 - found[0].share)


def ranked(found: Found) -> tuple[StageShare, ...]:
    """Return the best form of each stage, best stage first, shares held to 0 to 1."""
    best: dict[Stage, tuple[str, float]] = {stage: ("", 0.0) for stage in Stage}
    for stage, name, explained in found:
        if explained > best[stage][1]:
            best[stage] = (name, explained)
    shares = [StageShare(stage.value, name, min(1.0, value)) for stage, (name, value) in best.items()]
    return tuple(sorted(shares, key=lambda of_stage: -best[Stage(of_stage.stage)][1]))


def forms_explained(held: HeldOut, columns: Mapping[str, Float32], forms: Sequence[Form]) -> Found:
    """Return each form's share of the excess over noise beyond what nuisances explain."""
    p = len(held.covariates.nuisances)
    places, start = {}, p
    for name, of_name in columns.items():
        places[name] = np.arange(start, start + of_name.shape[1])
        start += of_name.shape[1]
    A, b = held.moments(np.hstack([held.covariates.tangents, *columns.values()]))
    found = []
    for stage, name, used in forms:
        at = np.concatenate([np.arange(p), *(places[column] for column in used)])
        explained = held.share(held.gain_of(A[:, at[:, None], at], b[:, at]) - held.alone)
        found.append((stage, name, explained - PER_COEFFICIENT * (len(at) - p)))
    return found


def linear_columns(
    chosen: Covariates, covariates: Covariates, places: Int64, camera: Camera
) -> dict[str, Float32]:
    """Return the columns (n, k) of whitened light for some bins, `places` among all bins.

    What a lens spreads is spread over all bins.
    """
    of, one = chosen.values, 1.0 / chosen.sigma_dn
    arc, laser, light = chosen.arc_dn * one, chosen.laser_dn * one, chosen.light_dn * one
    exposed = one * of["exposure"] / max(float(np.max(of["exposure"], initial=0.0)), 1e-9)
    arc_level = exposed * of["current"] / max(float(np.max(of["current"], initial=0.0)), 1e-9)
    lit = np.where(of["current"] > 0.0, exposed, 0.0)
    rho2 = (of["radius"] / max(float(np.max(of["radius"], initial=0.0)), 1e-9)) ** 2
    radial = np.column_stack([np.ones_like(rho2), rho2, rho2**2])
    mean_light = _mean_light_dn(covariates)[chosen.frame] * one

    def times(basis: Float32, weight: Float32) -> Float32:
        return np.asarray(basis * weight[:, np.newaxis], dtype=np.float32)

    return {
        "arc_radial": times(radial, arc),
        "laser_radial": times(radial, laser),
        "light_radial": times(radial, light),
        "arc_time": times(hats(of["time"], 4), arc),
        "laser_time": times(hats(of["time"], 4), laser),
        "light_time": times(hats(of["time"], 4), light),
        "arc_current": times(hats(of["current"], 3), arc),
        "laser_column": times(hats(of["column"], 5), laser),
        "arc_half_angle": times(hats(of["half_angle"], 8), arc),
        "arc_theta_i": times(hats(of["theta_i"], 5), arc),
        "arc_theta_r": times(hats(of["theta_r"], 5), arc),
        "arc_phi_r": times(hats(of["phi_r"], 5), arc),
        "laser_theta_r": times(hats(of["theta_r"], 4), laser),
        "add_concavity": times(hats(of["concavity"], 4), arc_level),
        "add_distance": times(hats(of["distance"], 6), lit),
        "add_arc_distance": times(hats(of["distance"], 6), arc_level),
        "light_image": times(hats_of_two(chosen), light),
        "mean_light": times(radial[:, :1], mean_light),
        "mean_light_radial": times(radial[:, :2], mean_light),
        "blur": times(radial[:, :1], (_blurred_dn(covariates) - covariates.light_dn)[places] * one),
        "add_gray_level": times(hats(of["gray_level"], 9), one),
        "distortion": _distortion(chosen, camera),
    }


def _mean_light_dn(covariates: Covariates) -> Float32:
    """Return each frame's mean predicted light (n_frames,), DN, each part of the image counted alike."""
    weight = np.where(covariates.in_stripe, 1.0 / THIN**2, 1.0)
    total = np.bincount(covariates.frame, weight * covariates.light_dn, covariates.n_frames)
    weights = np.bincount(covariates.frame, weight, covariates.n_frames)
    return np.asarray(total / np.maximum(weights, 1e-9), dtype=np.float32)


def _blurred_dn(covariates: Covariates) -> Float32:
    """Return the predicted light (n,), DN, blurred a little more."""
    blurred = np.empty_like(covariates.light_dn)
    for frame in np.unique(covariates.frame):
        of_frame = covariates.frame == frame
        image = filled(covariates.image(int(frame), covariates.light_dn))
        blurred[of_frame] = cv2.GaussianBlur(image, (0, 0), DEFOCUS_BINS).ravel()[covariates.bins[of_frame]]
    return blurred


def _distortion(chosen: Covariates, camera: Camera) -> Float32:
    """Return what light does as points move along their radius, by its cube and by the radius itself.

    A turned camera sees the image shifted, so the nuisances' columns for turns about x and y are the image's
    slopes down and along its rows, up to a sign that both share.
    """
    along, down = chosen.tangents[:, CAMERA_COLUMNS][:, 1], -chosen.tangents[:, CAMERA_COLUMNS][:, 0]
    x = (chosen.values["column"] - camera.cx) / camera.fx
    y = (chosen.values["row"] - camera.cy) / camera.fy
    outward = along * x + down * y
    columns = np.column_stack([outward, outward * (x**2 + y**2)])
    return np.asarray(columns / np.maximum(np.abs(columns).max(axis=0, initial=0.0), 1e-9), dtype=np.float32)


def unsmooth_explained(held: HeldOut, covariates: Covariates, residuals: Float64) -> Found:
    """Return the shares that no function of coordinates explains: levels of frames, lamps, noise, sparks."""
    of = noise_shares(covariates, residuals)
    noise = [(Stage.SENSOR, "noise", of.rest), (Stage.ILLUMINATION, "grain", of.stripe_band)]
    return _levels_explained(held) + _lamps_explained(held) + [*noise, (Stage.MEDIUM, "sparks", of.sparks)]


def _levels_explained(held: HeldOut) -> Found:
    """Return what a level for each frame explains on blocks of the frame that it was not told from."""
    c = held.covariates
    rows, columns = np.divmod(c.bins, c.shape[1])
    block = (rows // BLOCK_BINS + 3 * (columns // BLOCK_BINS)) % BLOCKS
    place, size = c.frame * BLOCKS + block, c.n_frames * BLOCKS
    found = []
    for stage, name, light_dn in (
        (Stage.SOURCE, "arc's level of each frame", c.arc_dn),
        (Stage.ILLUMINATION, "laser's level of each frame", c.laser_dn),
        (Stage.SENSOR, "level of each frame", c.light_dn),
    ):
        column = light_dn / c.sigma_dn
        squares = np.bincount(place, held.weights * column**2, size).reshape(-1, BLOCKS)
        products = np.bincount(place, held.weights * column * held.residuals, size).reshape(-1, BLOCKS)
        others = squares.sum(axis=1, keepdims=True) - squares
        level = (products.sum(axis=1, keepdims=True) - products) / np.maximum(others, 1e-6)
        gained = float(np.sum(2.0 * level * products - level**2 * squares)) / max(held.total_weight, 1e-9)
        explained = held.share(gained - held.alone)
        found.append((stage, name, explained - PER_COEFFICIENT))
    return found


def _lamps_explained(held: HeldOut) -> Found:
    """Return what a lamp's output beyond its tolerance explains, if that leaves nothing else to explain."""
    if held.mean_square - held.alone - 1.0 > LEAST_EXCESS:
        return []
    bound = replace(held, free=())
    return [
        (stage, name, bound.share(replace(held, free=(level,)).alone - bound.alone))
        for stage, name, level in (
            (Stage.SOURCE, "arc's output", LEVELS[0]),
            (Stage.ILLUMINATION, "laser's output", LEVELS[1]),
        )
    ]


@dataclass(frozen=True, eq=False)
class _Views:
    """The chosen bins rendered anew with something moved."""

    expected: Expected
    fit: Fitted
    held: HeldOut

    @property
    def stated(self) -> Setup:
        # Effects of a fit are left where they are: what is asked is how light changes.
        return really_there(self.expected.observed.binned, self.fit.nuisance)

    def parts(self) -> Float32:
        """Return the diffuse part of arc and laser, and the arc's lobe as a function of the half angle."""
        material = self.stated.material
        of = self.held.covariates
        if not material.kappa_diff > 0.0:
            return np.zeros((len(of.frame), 1), dtype=np.float32)
        dull = Material(material.name, material.kappa_diff, 0.0, material.c2)
        arc, laser = self._light(apply_setup_effects(replace(self.stated, material=dull)))
        by_angle = hats(of.values["half_angle"], 6) * (self._here[0] - arc)[:, np.newaxis]
        return np.column_stack([arc, laser, by_angle]).astype(np.float32)

    def tangents(self) -> dict[str, Float32]:
        """Return how whitened light (n, k) changes for one unit of what moves."""
        found = {"pose of the camera": self.held.covariates.tangents[:, CAMERA_COLUMNS]}
        for name, moving in MOVED.items():
            if moving.steps:
                by = [
                    self._change(name, step * axis) / step
                    for step, axis in zip(moving.steps, np.eye(len(moving.steps)), strict=True)
                ]
                found[name] = np.column_stack(by).astype(np.float32)
        return found

    def secant(self, name: str, tangents: Float32) -> Float32:
        """Return how whitened light (n, 1) changes to where the tangents point: there it bends with it."""
        held = self.held
        A, b = held.moments(np.hstack([held.covariates.tangents, tangents]))
        by = held.solved(A.sum(axis=0), b.sum(axis=0))[len(held.covariates.nuisances) :]
        reach = np.array(MOVED[name].reach)
        return self._change(name, np.clip(by, -reach, reach))[:, np.newaxis].astype(np.float32)

    @cached_property
    def _here(self) -> tuple[Float32, Float32]:
        return self._light(apply_setup_effects(self.stated))

    def _change(self, name: str, by: Float64) -> Float32:
        setup, delay_s, T_base_plate = self.stated, 0.0, np.eye(4)
        if name == "place of the arc":
            x, y, z = np.asarray(setup.arc.center_in_tool_mm) + by[:3]
            radius_mm = setup.arc.radius_mm * float(np.exp(by[3]))
            center = (float(x), float(y), float(z))
            setup = replace(setup, arc=replace(setup.arc, center_in_tool_mm=center, radius_mm=radius_mm))
        elif name == "pose of the camera":
            T_tool_camera = moved(setup.camera.T_tool_camera, by[:3], by[3:])
            setup = replace(setup, camera=replace(setup.camera, T_tool_camera=T_tool_camera))
        elif name == "tilt of the plate":
            T_base_joint = seam_frame(setup.joint, np.asarray(setup.joint.seam_in_base_mm[0]))
            T_base_plate = moved(T_base_joint, [*by, 0.0], np.zeros(3)) @ invert(T_base_joint)
        else:
            delay_s = float(by[0])
        arc, laser = self._light(apply_setup_effects(setup), delay_s, invert(T_base_plate))
        return (arc - self._here[0]) + (laser - self._here[1])

    def _light(
        self, true: Setup, delay_s: float = 0.0, T_plate_base: Float64 | None = None
    ) -> tuple[Float32, Float32]:
        """Return whitened light (n,) of arc and laser in the chosen bins; a tilted plate is a turned tool.

        The seam runs straight as in the middle of the view: that is enough for what light changes by.
        """
        held, rays = self.held, Rays.of(true.camera)
        starts = np.cumsum([0, *self.expected.observed.counts])

        def of_frame(frame: ObservedFrame) -> tuple[Float32, Float32]:
            first, last = np.searchsorted(held.chosen, starts[frame.position : frame.position + 2])
            place = held.chosen[first:last] - starts[frame.position]
            passed = self.fit.passed[frame.position]
            condition = frame.condition
            dark = np.zeros(len(place), dtype=np.float32)
            if condition.arc_level == 0.0 and condition.laser_level == 0.0:
                return dark, dark
            seam = self.expected.seam(frame, self.fit.nuisance, {})
            seam = BentSeam((seam.middle,), seam.ground)
            T_base_tool = frame.T_base_tool_in(true, delay_s)
            T_base_tool = T_base_tool if T_plate_base is None else T_plate_base @ T_base_tool
            layers = look(true, T_base_tool, seam, rays, np.flatnonzero(frame.keep)[place])
            whitened = (passed.dn_per_e()[place] / frame.sigma_dn[place]).astype(np.float32)
            return (
                whitened * passed.arc_factor[place] * layers.arc_e if condition.arc_level > 0.0 else dark,
                whitened * passed.laser_factor[place] * layers.laser_e
                if condition.laser_level > 0.0
                else dark,
            )

        lights = self.expected.over_frames(of_frame)
        return np.concatenate([arc for arc, _ in lights]), np.concatenate([laser for _, laser in lights])
