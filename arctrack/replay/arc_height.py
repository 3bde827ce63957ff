"""The arc's height and output from its own light: what is noise to the stripe says how long the arc is.

Off the stripe a pixel's charge is, for small departures h of the arc's height,

    e_i = level (M_i + h dM_i/dh) (1 + g_i) + black + n_i

with the arc map M at the stated height, its derivative by two maps, and noise n of photons and electronics.
g is what the map itself is wrong by: a smooth relative error of 1 sigma MAP_SIGMA over FORM_PX of the image's
diagonal, and one that goes from pixel to pixel (texture). With both as covariances the best unbiased estimate
is that of generalised least squares (Aitken 1936, Proc. R. Soc. Edinburgh 55, 42), and its covariance says
what a smooth error of the map makes of it: a thousand pixels do not average that away.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from arctrack.control.frame_tracking import FrameStep
from arctrack.recording.results import ArcAboveSurface
from noise_model.arc.map import ArcMap, arc_kernel
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker.arc.level import HUBER, MAP_SIGMA, MAX_SIGMA, MIN_BLACK_SIGMA_E, MIN_PIXELS, unlit_by_the_laser
from tracker.arc.transmission import ArcLight, Transmission, seen_arc
from tracker.geometry import MAP_FLOOR_E, MAP_TOLERANCE, SensorGeometry, dark_variance_at
from tracker.observation import expected_output
from tracker.state import NAN, Frame, Pose, Track

STEP_MM = 0.5
"""Step of the derivative to either side."""

FACE_SIGMAS = 3.0
"""Distance off a joint's faces within which a pixel may lie on either, in sigmas of the seam across.

The groove of `examples/v_groove` bends. At 0 two of its 12 frames are off by 2.3 and 4.5 sigmas, at 2 one by
2.0, at 3 none by more than 1.7.
"""

BLOW_SIGMA_MM, RADIUS_SIGMA = 0.3, 0.05
"""1 sigma of the arc's place, mm, and of its radius, relative: a steady arc's.

They are fitted along, for what they do to the light resembles what the height does.
"""


@dataclass(frozen=True)
class ArcHeight:
    """The arc's output and height as seen in its light; NaN if unknown.

    `level` is the output over the expected one, `height_mm` the arc centre's distance above the stated one
    along the tool's axis, each with 1 sigma. `unknown` says why nothing is known, and is empty where it is.
    """

    level: float = NAN
    level_sigma: float = NAN
    height_mm: float = NAN
    height_sigma_mm: float = NAN
    unknown: str = ""


NOT_DETERMINED = ArcHeight(unknown="not_determined")


@dataclass(frozen=True)
class ArcDeparture:
    """Displacement of the arc upwards and sideways, mm, and its radius over the stated one."""

    height_mm: float = 0.0
    x_mm: float = 0.0
    y_mm: float = 0.0
    radius_ratio: float = 1.0

    def applied_to(self, setup: Setup) -> Setup:
        """Return a setup whose arc departs so."""
        x_mm, y_mm, z_mm = setup.arc.center_in_tool_mm
        center_mm = (x_mm + self.x_mm, y_mm + self.y_mm, z_mm + self.height_mm)
        radius_mm = setup.arc.radius_mm * self.radius_ratio
        return replace(setup, arc=replace(setup.arc, center_in_tool_mm=center_mm, radius_mm=radius_mm))


class ArcHeightEstimator:
    """Estimator of the arc's height from frames of a setup."""

    def __init__(self, geometry: SensorGeometry) -> None:
        self.geometry = geometry

    def of_track(self, frame: Frame, pose: Pose, seam: SeamLine, track: Track) -> ArcHeight:
        """Estimate the arc of a tracked frame about the `seam` of its reading.

        Unknown where the track knows no arc, no surface below the torch, and with the laser on no stripe to
        keep off.
        """
        stripe = track.stripe
        if not math.isfinite(track.arc_level):
            return ArcHeight(unknown="no_arc")
        if frame.laser_on and stripe is None:
            return ArcHeight(unknown="no_stripe")
        if not math.isfinite(track.offset_sigma_y_mm + track.offset_sigma_z_mm):
            return ArcHeight(unknown="no_surface")
        # Where a line shows no stripe, none is near.
        stripe_px = None if stripe is None else np.nan_to_num(stripe.position_px, nan=-1e9)
        # 2 mm off the stripe no light is the laser's.
        keep_off_px = self.geometry.reach_px(2.0)
        seam_sigma_mm = track.offset_sigma_y_mm, track.offset_sigma_z_mm
        return self.estimate(frame, pose, seam, stripe_px, keep_off_px, seam_sigma_mm)

    def estimate(
        self,
        frame: Frame,
        pose: Pose,
        seam: SeamLine,
        stripe_px: Float64 | None,
        keep_off_px: float,
        seam_sigma_mm: tuple[float, float],
    ) -> ArcHeight:
        """Estimate the arc's output and height; unknown where its light does not determine them.

        `stripe_px` (n_scan,) is the stripe on each scan line, px, NaN where there is none; None with the
        laser off. The laser's light reaches `keep_off_px` from it. `seam_sigma_mm` is 1 sigma of the seam
        below the torch, across and in height: of a joint's faces, and of the surface that the arc stands on.
        """
        geometry = self.geometry
        if make_scene(geometry.setup, pose.T_base_tool, seam).below_surface:
            return ArcHeight(unknown="no_arc")
        output = expected_output(geometry.setup, frame)

        def light(departure: ArcDeparture, aside_mm: float = 0.0) -> tuple[ArcLight, Transmission | None]:
            setup = departure.applied_to(geometry.setup)
            scene = make_scene(setup, pose.T_base_tool, seam._replace(y_mm=seam.y_mm + aside_mm))
            kernel = arc_kernel(setup, scene, output)
            # Nothing is baked of an arc that departs from the setup's, and differences want like maps.
            arc_map = ArcMap.of(
                kernel, geometry.xy, geometry.cos4, geometry.n_scan, MAP_TOLERANCE, MAP_FLOOR_E
            )
            arc_e = arc_map.at
            if not geometry.has_light_effects:
                return arc_e, None
            return arc_e, Transmission.of(geometry, scene, arc_e, output)

        unlit = unlit_by_the_laser(geometry, *light(ArcDeparture()), frame.image_dn, stripe_px, keep_off_px)
        if len(unlit.arc_e) < MIN_PIXELS:
            return NOT_DETERMINED

        def light_e(departure: ArcDeparture, aside_mm: float = 0.0) -> Float64:
            return np.asarray(seen_arc(*light(departure, aside_mm), unlit.pixels)[0], np.float64)

        scan, position = np.divmod(unlit.pixels, geometry.n_pos)
        places = np.column_stack([scan, position]) / math.hypot(geometry.n_scan, geometry.n_pos)
        about_mm, map_e, height = 0.0, unlit.arc_e, NOT_DETERMINED
        sigma_y_mm, sigma_z_mm = seam_sigma_mm
        moved_mm = FACE_SIGMAS * sigma_y_mm
        face_e = 0.5 * (light_e(ArcDeparture(), moved_mm) - light_e(ArcDeparture(), -moved_mm))
        # Steps of the height, each about the one before.
        for _ in range(3):
            about = ArcDeparture(height_mm=about_mm)
            slope_e = light_e(replace(about, height_mm=about_mm + STEP_MM)) - light_e(
                replace(about, height_mm=about_mm - STEP_MM)
            )
            columns_e = np.column_stack(
                [
                    map_e,
                    slope_e / (2.0 * STEP_MM),
                    light_e(replace(about, x_mm=BLOW_SIGMA_MM)) - map_e,
                    light_e(replace(about, y_mm=BLOW_SIGMA_MM)) - map_e,
                    light_e(replace(about, radius_ratio=1.0 + RADIUS_SIGMA)) - map_e,
                    np.ones_like(map_e),
                ]
            )
            told = np.isfinite(columns_e).all(axis=1) & np.isfinite(face_e)
            if np.count_nonzero(told) < MIN_PIXELS:
                return NOT_DETERMINED
            moved = _fitted(geometry, columns_e[told], unlit.charge_e[told], places[told], face_e[told])
            height = replace(moved, height_mm=about_mm + moved.height_mm)
            if not abs(moved.height_mm) > STEP_MM:
                break
            # No arc's centre stands farther off its place: the effect `arc_length` goes so far.
            if not abs(height.height_mm) <= 8.0:
                return ArcHeight(unknown="not_settled")
            about_mm, map_e = height.height_mm, light_e(ArcDeparture(height_mm=height.height_mm))
        else:
            return ArcHeight(unknown="not_settled")
        return replace(height, height_sigma_mm=math.hypot(height.height_sigma_mm, sigma_z_mm))


def arc_above_surface(estimator: ArcHeightEstimator, track: Track, step: FrameStep | None) -> ArcAboveSurface:
    """Return how high the arc's centre of a tracked frame stands above the surface."""
    if step is None or step.reading is None or step.inputs.pose is None:
        return ArcAboveSurface(unknown="not_tracked")
    height = estimator.of_track(step.frame, step.inputs.pose, step.reading.seam, track)
    stated_mm = estimator.geometry.setup.arc.center_in_tool_mm[2]
    return ArcAboveSurface(stated_mm + height.height_mm, height.height_sigma_mm, height.unknown)


def _fitted(
    geometry: SensorGeometry, columns: Float64, charge_e: Float64, places: Float64, face_e: Float64
) -> ArcHeight:
    """Fit output, height and the rest to charges (n,) by generalised least squares, spatter left out.

    `columns` (n, 6) are the arc's light, its change with the height per mm, those for 1 sigma of the arc's
    place (x, y) and its radius, and the black level's. `face_e` (n,) is 1 sigma of that light by the place of
    the joint's faces.
    """
    map_e = columns[:, 0]
    black_sigma_e = max(geometry.image_source.black_sigma_e, MIN_BLACK_SIGMA_E)
    apart2 = ((places[:, None] - places[None]) ** 2).sum(axis=2)
    # Correlation length of the map's smooth error, over the image's diagonal: lobes and shadows are as wide.
    map_covariance = MAP_SIGMA**2 * np.exp(-0.5 * apart2 / 0.25**2)
    dark_e2 = dark_variance_at(geometry.image_source, charge_e)
    level = max(float(np.median(charge_e) / max(float(np.median(map_e)), 1e-9)), 1e-3)
    spread, fitted, covariance, chi2 = np.ones(len(map_e)), np.zeros(6), np.eye(6), math.nan
    # Steps of the weights.
    for _ in range(4):
        mean_e = level * map_e
        # 1 sigma of the metal's own texture from pixel to pixel, relative.
        own_e2 = (np.maximum(mean_e, 0.0) + dark_e2 + (0.05 * mean_e) ** 2 + (level * face_e) ** 2) * spread
        factor = cho_factor(np.diag(own_e2) + np.outer(mean_e, mean_e) * map_covariance, lower=True)
        weighted = cho_solve(factor, columns)
        # Each counts in units of its sigma, times the output.
        prior = np.diag([0.0, 0.0, level**-2, level**-2, level**-2, black_sigma_e**-2])
        try:
            covariance = np.linalg.inv(columns.T @ weighted + prior)
        except np.linalg.LinAlgError:
            return NOT_DETERMINED
        fitted = covariance @ (weighted.T @ charge_e)
        residual_e = charge_e - columns @ fitted
        chi2 = float(residual_e @ cho_solve(factor, residual_e)) / len(map_e)
        # The smooth part is no spatter: what a pixel is off beyond it is.
        rough_e = own_e2 * cho_solve(factor, residual_e)
        size = np.abs(rough_e) / np.sqrt(own_e2 / spread)
        spread = np.maximum(1.0, size / HUBER)
        level = max(float(fitted[0]), 1e-3)
    covariance = covariance * max(1.0, chi2)
    level, level_sigma = float(fitted[0]), math.sqrt(float(covariance[0, 0]))
    if not (level > 0.0 and level_sigma < MAX_SIGMA * max(level, 1.0)):
        return NOT_DETERMINED
    height_mm = float(fitted[1]) / level
    to_height = np.array([-height_mm, 1.0, 0.0, 0.0, 0.0, 0.0]) / level
    height_sigma_mm = math.sqrt(float(to_height @ covariance @ to_height))
    # Largest sigma of a known height, mm: arcs are as long. An output is none without its height.
    if not height_sigma_mm < 2.0:
        return NOT_DETERMINED
    return ArcHeight(level, level_sigma, height_mm, height_sigma_mm)
