"""The stage at which the residual is simplest.

At the stage where a gap arises it is a simple function of that stage's own coordinates; seen from another
stage it is complicated. So each stage has forms that a gap of its own may take, each with few coefficients.
The sensor's are functions of the grey level or of time; the lens' are factors over the image, stray light and
a blur; a source's are its level in each frame and its place; the surface's are functions of its angles and
the parts of its light; the medium's are light that falls off about the arc, and sparks. Geometry and timing
have the change of the image with the camera's pose, the plate's tilt and the clock. A form's share is the
part of the gap that it explains on frames that it was not fitted to, nuisances fitted with it, less a penalty
for each coefficient.

The catalogue of effects is not used here, so the stage is found even where no effect explains the gap.
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
from sim_to_real.data.binned import THINNING, ObservedFrame
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.nuisances import N_LEVELS, SEAM_FROM, apply_nuisances
from sim_to_real.locate.covariates import Covariates, Fitted
from sim_to_real.locate.residual_structure import filled, noise_shares
from sim_to_real.locate.spline_term import MIN_EXCESS, CrossValidation, hat_basis, hat_basis_2d

COEFFICIENT_PENALTY = 0.002
"""The penalty on a form's share for each coefficient: of two that explain the same the simpler one wins."""

LEVEL_NUISANCES = (0, 1)
"""The level nuisances, which are free here: a brighter lamp says nothing about how its light is lost."""

DEFOCUS_BINS = 1.0
"""1 sigma of the blur that stands for a wider point-spread function."""

N_BLOCKS, BLOCK_BINS = 4, 20
"""A frame's level is fitted to all but one of so many parts, which consist of blocks so many bins wide."""


Form = tuple[Stage, str, tuple[str, ...]]

FormShares = list[tuple[Stage, str, float]]


@dataclass(frozen=True)
class StageShare:
    """The share of the gap, 0 to 1, that the best form of a stage explains, and that form's name."""

    stage: str
    form: str
    share: float


@dataclass(frozen=True)
class Displacement:
    """A displacement by a few numbers: its stage, the steps of its tangents, and its largest values."""

    stage: Stage
    steps: tuple[float, ...]
    reach: tuple[float, ...]


DISPLACEMENTS: Mapping[str, Displacement] = {
    "place of the arc": Displacement(Stage.SOURCE, (0.3, 0.3, 0.3, 0.15), (3.0, 3.0, 3.0, 0.7)),
    "pose of the camera": Displacement(Stage.GEOMETRY, (), (2.0, 2.0, 2.0, 2.5, 2.5, 2.5)),
    "tilt of the plate": Displacement(Stage.GEOMETRY, (0.7, 0.7), (6.0, 6.0)),
    "clock": Displacement(Stage.TIMING, (0.015,), (0.15,)),
}
"""Displacements that are rendered: of the arc's centre (mm) and ln radius, the camera's rotation (deg) and
translation (mm), the plate's roll and pitch (deg), the delay (s).

The camera's tangents are its nuisances'.
"""

CAMERA_COLUMNS = slice(N_LEVELS, SEAM_FROM)
"""The place of the camera's pose among the nuisances."""

STAGE_FORMS: tuple[Form, ...] = (
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


def stages(model: LinearizedModel, fits: Sequence[tuple[Fitted, Covariates]]) -> tuple[StageShare, ...]:
    """Return all stages, the one at which the residuals are simplest first.

    Of several fits, the one whose simplest form leaves least counts. A large gap biases the nuisances of a
    fit so far that no form is simple. Then the stated values (`covariates.NominalFit`) are nearer the truth,
    unless the seam or the camera is off.
    """
    return min((_stage_shares(model, *fit) for fit in fits), key=lambda explained: explained[1])[0]


def _stage_shares(
    model: LinearizedModel, fit: Fitted, covariates: Covariates
) -> tuple[tuple[StageShare, ...], float]:
    """Return all stages, and the excess of the mean square over noise that the best form leaves."""
    validation = CrossValidation.of(covariates, fit.residuals, free=LEVEL_NUISANCES)
    views = _Views(model, fit, validation)
    columns = linear_columns(
        validation.covariates, covariates, validation.chosen, model.observed.setup.camera
    )
    columns["parts"] = views.parts()
    forms = list(STAGE_FORMS)
    tangents = views.tangents()
    for name, moving in DISPLACEMENTS.items():
        columns[name] = np.hstack([tangents[name], views.secant(name, tangents[name])])
        forms.append((moving.stage, name, (name,)))
    smooth = form_shares(validation, columns, forms)
    of_stages = ranked(smooth + nonsmooth_shares(validation, covariates, fit.residuals))
    excess = max(validation.mean_square - validation.nuisance_gain - 1.0, 0.0)
    return of_stages, excess * (1.0 - of_stages[0].share)


def ranked(shares_of_forms: FormShares) -> tuple[StageShare, ...]:
    """Return the best form of each stage, best stage first, with shares clipped to 0 to 1."""
    best: dict[Stage, tuple[str, float]] = {stage: ("", 0.0) for stage in Stage}
    for stage, name, explained in shares_of_forms:
        if explained > best[stage][1]:
            best[stage] = (name, explained)
    shares = [StageShare(stage.value, name, min(1.0, value)) for stage, (name, value) in best.items()]
    return tuple(sorted(shares, key=lambda of_stage: -best[Stage(of_stage.stage)][1]))


def form_shares(
    validation: CrossValidation, columns: Mapping[str, Float32], forms: Sequence[Form]
) -> FormShares:
    """Return each form's share of the excess over noise, beyond what nuisances explain."""
    p = len(validation.covariates.nuisances)
    places, start = {}, p
    for name, of_name in columns.items():
        places[name] = np.arange(start, start + of_name.shape[1])
        start += of_name.shape[1]
    A, b = validation.moments(np.hstack([validation.covariates.tangents, *columns.values()]))
    shares = []
    for stage, name, used in forms:
        places_used = np.concatenate([np.arange(p), *(places[column] for column in used)])
        gained = validation.best_gain(A[:, places_used[:, None], places_used], b[:, places_used])
        explained = validation.excess_share(gained - validation.nuisance_gain)
        shares.append((stage, name, explained - COEFFICIENT_PENALTY * (len(places_used) - p)))
    return shares


def linear_columns(
    chosen: Covariates, covariates: Covariates, places: Int64, camera: Camera
) -> dict[str, Float32]:
    """Return the columns (n, k) of whitened light for some bins, `places` among all bins.

    What a lens spreads is spread over all bins.
    """
    values, per_dn = chosen.values, 1.0 / chosen.sigma_dn
    arc, laser, light = chosen.arc_dn * per_dn, chosen.laser_dn * per_dn, chosen.light_dn * per_dn
    exposed = per_dn * values["exposure"] / max(float(np.max(values["exposure"], initial=0.0)), 1e-9)
    arc_level = exposed * values["current"] / max(float(np.max(values["current"], initial=0.0)), 1e-9)
    lit = np.where(values["current"] > 0.0, exposed, 0.0)
    rho2 = (values["radius"] / max(float(np.max(values["radius"], initial=0.0)), 1e-9)) ** 2
    radial = np.column_stack([np.ones_like(rho2), rho2, rho2**2])
    mean_light = _mean_light_dn(covariates)[chosen.frame] * per_dn

    def times(basis: Float32, weight: Float32) -> Float32:
        return np.asarray(basis * weight[:, np.newaxis], dtype=np.float32)

    return {
        "arc_radial": times(radial, arc),
        "laser_radial": times(radial, laser),
        "light_radial": times(radial, light),
        "arc_time": times(hat_basis(values["time"], 4), arc),
        "laser_time": times(hat_basis(values["time"], 4), laser),
        "light_time": times(hat_basis(values["time"], 4), light),
        "arc_current": times(hat_basis(values["current"], 3), arc),
        "laser_column": times(hat_basis(values["column"], 5), laser),
        "arc_half_angle": times(hat_basis(values["half_angle"], 8), arc),
        "arc_theta_i": times(hat_basis(values["theta_i"], 5), arc),
        "arc_theta_r": times(hat_basis(values["theta_r"], 5), arc),
        "arc_phi_r": times(hat_basis(values["phi_r"], 5), arc),
        "laser_theta_r": times(hat_basis(values["theta_r"], 4), laser),
        "add_concavity": times(hat_basis(values["concavity"], 4), arc_level),
        "add_distance": times(hat_basis(values["distance"], 6), lit),
        "add_arc_distance": times(hat_basis(values["distance"], 6), arc_level),
        "light_image": times(hat_basis_2d(chosen), light),
        "mean_light": times(radial[:, :1], mean_light),
        "mean_light_radial": times(radial[:, :2], mean_light),
        "blur": times(radial[:, :1], (_blurred_dn(covariates) - covariates.light_dn)[places] * per_dn),
        "add_gray_level": times(hat_basis(values["gray_level"], 9), per_dn),
        "distortion": _distortion(chosen, camera),
    }


def _mean_light_dn(covariates: Covariates) -> Float32:
    """Return each frame's mean predicted light (n_frames,), DN, each part of the image counted alike."""
    weight = np.where(covariates.in_stripe, 1.0 / THINNING**2, 1.0)
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


def nonsmooth_shares(validation: CrossValidation, covariates: Covariates, residuals: Float64) -> FormShares:
    """Return the shares of forms that are no functions of coordinates: frame levels, lamps, noise, sparks."""
    noise = noise_shares(covariates, residuals)
    of_noise = [
        (Stage.SENSOR, "noise", noise.rest),
        (Stage.ILLUMINATION, "grain", noise.stripe_band),
        (Stage.MEDIUM, "sparks", noise.sparks),
    ]
    return _frame_level_shares(validation) + _lamp_level_shares(validation) + of_noise


def _frame_level_shares(validation: CrossValidation) -> FormShares:
    """Return what a level for each frame explains, on blocks of the frame that it was not fitted to."""
    c = validation.covariates
    rows, columns = np.divmod(c.bins, c.shape[1])
    block = (rows // BLOCK_BINS + 3 * (columns // BLOCK_BINS)) % N_BLOCKS
    place, size = c.frame * N_BLOCKS + block, c.n_frames * N_BLOCKS
    shares = []
    for stage, name, light_dn in (
        (Stage.SOURCE, "arc's level of each frame", c.arc_dn),
        (Stage.ILLUMINATION, "laser's level of each frame", c.laser_dn),
        (Stage.SENSOR, "level of each frame", c.light_dn),
    ):
        column = light_dn / c.sigma_dn
        squares = np.bincount(place, validation.weights * column**2, size).reshape(-1, N_BLOCKS)
        weighted = validation.weights * column * validation.residuals
        products = np.bincount(place, weighted, size).reshape(-1, N_BLOCKS)
        others = squares.sum(axis=1, keepdims=True) - squares
        level = (products.sum(axis=1, keepdims=True) - products) / np.maximum(others, 1e-6)
        gained = float(np.sum(2.0 * level * products - level**2 * squares))
        gained /= max(validation.total_weight, 1e-9)
        explained = validation.excess_share(gained - validation.nuisance_gain)
        shares.append((stage, name, explained - COEFFICIENT_PENALTY))
    return shares


def _lamp_level_shares(validation: CrossValidation) -> FormShares:
    """Return what a lamp's output beyond its tolerance explains, if it leaves nothing else to explain."""
    if validation.mean_square - validation.nuisance_gain - 1.0 > MIN_EXCESS:
        return []
    bound = replace(validation, free=())
    arc, laser = (
        bound.excess_share(replace(validation, free=(level,)).nuisance_gain - bound.nuisance_gain)
        for level in LEVEL_NUISANCES
    )
    return [(Stage.SOURCE, "arc's output", arc), (Stage.ILLUMINATION, "laser's output", laser)]


@dataclass(frozen=True, eq=False)
class _Views:
    """The chosen bins rendered anew with something displaced."""

    model: LinearizedModel
    fit: Fitted
    validation: CrossValidation

    @property
    def stated(self) -> Setup:
        # The fit's effects do not matter here: only the change of light does.
        return apply_nuisances(self.model.observed.binned, self.fit.nuisance)

    def parts(self) -> Float32:
        """Return the diffuse part of arc and laser, and the arc's lobe as a function of the half angle."""
        material = self.stated.material
        covariates = self.validation.covariates
        if not material.kappa_diff > 0.0:
            return np.zeros((len(covariates.frame), 1), dtype=np.float32)
        dull = Material(material.name, material.kappa_diff, 0.0, material.c2)
        arc, laser = self._light(apply_setup_effects(replace(self.stated, material=dull)))
        by_angle = hat_basis(covariates.values["half_angle"], 6) * (self._here[0] - arc)[:, np.newaxis]
        return np.column_stack([arc, laser, by_angle]).astype(np.float32)

    def tangents(self) -> dict[str, Float32]:
        """Return the change of whitened light (n, k) for one unit of each displacement."""
        columns = {"pose of the camera": self.validation.covariates.tangents[:, CAMERA_COLUMNS]}
        for name, moving in DISPLACEMENTS.items():
            if moving.steps:
                by = [
                    self._change(name, step * axis) / step
                    for step, axis in zip(moving.steps, np.eye(len(moving.steps)), strict=True)
                ]
                columns[name] = np.column_stack(by).astype(np.float32)
        return columns

    def secant(self, name: str, tangents: Float32) -> Float32:
        """Return the change of whitened light (n, 1) for the displacement that fits best by its tangents."""
        validation = self.validation
        A, b = validation.moments(np.hstack([validation.covariates.tangents, tangents]))
        by = validation.coefficients(A.sum(axis=0), b.sum(axis=0))[len(validation.covariates.nuisances) :]
        reach = np.array(DISPLACEMENTS[name].reach)
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
        validation, rays = self.validation, Rays.of(true.camera)
        starts = np.cumsum([0, *self.model.observed.counts])

        def of_frame(frame: ObservedFrame) -> tuple[Float32, Float32]:
            first, last = np.searchsorted(validation.chosen, starts[frame.position : frame.position + 2])
            place = validation.chosen[first:last] - starts[frame.position]
            passed = self.fit.lights[frame.position]
            condition = frame.condition
            dark = np.zeros(len(place), dtype=np.float32)
            if condition.arc_level == 0.0 and condition.laser_level == 0.0:
                return dark, dark
            seam = self.model.seam(frame, self.fit.nuisance, {})
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

        lights = self.model.over_frames(of_frame)
        return np.concatenate([arc for arc, _ in lights]), np.concatenate([laser for _, laser in lights])
