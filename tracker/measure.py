"""What a look at a frame has found, and a look by its pieces, between which Python comes.

Effects of a setup act on the arc's light there, and a closed joint's line is read off the image.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import CELL, ArcMap
from noise_model.arc.scene import Scene
from noise_model.arrays import Integers
from noise_model.median import known_median
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker import checks
from tracker.arc.level import UNKNOWN, ArcLevel
from tracker.arc.transmission import NO_LIGHT, Transmission
from tracker.checks import Asked, ask_whether
from tracker.frame_pieces import Aim
from tracker.geometry import SensorGeometry
from tracker.joint import MeasuredJoint, fit_closed_joint, fit_section
from tracker.joint.evidence import MIN_EVIDENCE_NATS
from tracker.joint.image_line import read_image_line
from tracker.joint.measured import undetermined
from tracker.joint.section import Section
from tracker.look import (
    ArcSeen,
    FrameLight,
    Look,
    ask_light,
    level_of,
    no_stripe,
    nothing_read,
    output_for,
    read_look,
    see_arc,
)
from tracker.profile import Profile
from tracker.state import Frame, Stripe
from tracker.stripe.band import LightLevel
from tracker.stripe.expected import ExpectedStripe, expect_stripe
from tracker.stripe.read import LitBand, Work, light_band
from tracker.stripe.scatter import NO_SCATTER, Scatter
from tracker.stripe.smooth import smoothed


class Reading(NamedTuple):
    """What one look at a frame, within a reach about an expected seam, has found.

    `scatter` is what the frames up to this one show of the stripe, `read_with` what the look was taken with.
    """

    asked: Asked
    scene: Scene
    seam: SeamLine
    reach_mm: float
    arc: ArcLevel = UNKNOWN
    stripe: Stripe | None = None
    joint: MeasuredJoint | None = None
    fov_margin_mm: float = math.nan
    scatter: Scatter = NO_SCATTER
    read_with: Scatter = NO_SCATTER

    @property
    def flags(self) -> int:
        """The flags that its frame raises."""
        return self.asked.flags


def look_through_effects(asked: Asked, geometry: SensorGeometry, frame: Frame, aim: Aim, work: Work) -> Look:
    """Take a look by its pieces: effects act on the arc's light on its way to the pixels."""
    image_dn, light, source = frame.image_dn, frame_light(geometry.setup, frame), geometry.look_source
    scene, scatter = aim.scene, aim.scatter
    none = no_stripe(geometry.along_rows)
    if not ask_whether(asked, checks.CAMERA_ABOVE, not scene.below_surface):
        return nothing_read(UNKNOWN, none, scatter)
    expected = expect_stripe(geometry, scene)
    ask_whether(asked, checks.STRIPE_EXPECTED, expected is not None)
    if expected is None:
        return nothing_read(UNKNOWN, none, scatter)
    reach_px = geometry.reach_px(aim.reach_mm)
    seen = see_arc(source, scene, expected, image_dn, light, reach_px)
    transmission = transmission_of(geometry, scene, seen, frame)
    arc_e, other_e = (seen.arc_e, NO_LIGHT)
    if transmission is not None:
        arc_e, other_e = transmission.through(seen.pixels, seen.arc_e)
    arc = level_of(source, seen, arc_e, other_e, light)
    if not ask_light(asked, arc, light):
        return nothing_read(arc, none, scatter)
    lit = light_through(
        geometry, seen, transmission, arc, image_dn, expected, reach_px, work, aim.use_arc_map
    )
    return read_look(asked, source, scene, aim.seam, aim.reach_mm, expected, arc, lit, work, scatter)


def transmission_of(
    geometry: SensorGeometry, scene: Scene, seen: ArcSeen, frame: Frame
) -> Transmission | None:
    """Return what a frame's effects make of the arc's light, None if no effect acts on it."""
    arc_map = ArcMap(seen.kernel, geometry.xy, geometry.cos4, seen.table)
    output = expected_output(geometry.setup, frame) if shows_arc(geometry.setup, frame) else 0.0
    return Transmission.of(geometry, scene, arc_map.at, output)


def light_through(
    geometry: SensorGeometry,
    seen: ArcSeen,
    transmission: Transmission | None,
    arc: ArcLevel,
    image_dn: Integers,
    expected: ExpectedStripe,
    reach_px: float,
    work: Work,
    use_arc_map: bool,
) -> LitBand:
    """Return `light_band`'s band with its light as it comes through effects."""
    has_effects = transmission is not None
    lit: LitBand = light_band(
        geometry.look_source,
        seen.kernel,
        seen.table,
        arc,
        image_dn,
        expected,
        reach_px,
        work,
        use_arc_map,
        has_effects,
    )
    if transmission is None or not use_arc_map:
        return lit
    band = lit.band
    n_scan, depth = band.background.shape
    first = np.arange(n_scan) * geometry.n_pos + band.lows[np.arange(n_scan) // CELL]
    pixels = (first[:, None] + np.arange(depth)).ravel()
    arc_e, other_e = transmission.through(pixels, band.background.ravel())
    band.background[:] = (np.float32(lit.light.level) * arc_e + other_e).reshape(n_scan, depth)
    return lit._replace(light=LightLevel(1.0, lit.light.black_e))


def fit_by_pieces(
    asked: Asked, geometry: SensorGeometry, scene: Scene, frame: Frame, look: Look
) -> MeasuredJoint:
    """Return the joint that is fitted to a look's section, undetermined where there is none."""
    joint, stated = None, geometry.setup.joint
    if look.is_stripe:
        joint = fit_section(look.section, stated, frame.image_dn, geometry.along_rows)
        if stated.type == "butt" and not _is_told(joint):
            profile = profile_of(look.section, frame, geometry.along_rows)
            closed = _closed_joint(geometry, scene, look, profile)
            if _is_told(closed):
                ask_whether(asked, checks.GAP_SHOWN, False)
                joint = closed
    nothing: MeasuredJoint = undetermined()
    return nothing if joint is None else joint


def _is_told(joint: MeasuredJoint | None) -> bool:
    """Say whether a joint is told from a plate."""
    return joint is not None and joint.evidence_nats >= MIN_EVIDENCE_NATS


def _closed_joint(
    geometry: SensorGeometry, scene: Scene, look: Look, profile: Profile
) -> MeasuredJoint | None:
    """Return the closed joint whose line the image shows beside the stripe, None where it shows none."""
    stripe_sigma_px = known_median(look.section.light.width_px)
    line = read_image_line(geometry, scene, smoothed(look.stripe).position_px, stripe_sigma_px, profile)
    return None if line is None else fit_closed_joint(profile, geometry.setup.joint, line)


def profile_of(section: Section, frame: Frame, along_rows: bool) -> Profile:
    """Return a section as a profile, with the whole frame by scan line."""
    points = section.points
    return Profile(
        points.y_mm,
        points.z_mm,
        points.dy_mm,
        points.dz_mm,
        points.sigma_px,
        points.scan,
        section.column_mm,
        points.beside_px,
        reach_mm=section.reach_mm,
        light=section.light,
        image_dn=frame.image_dn.T if along_rows else frame.image_dn,
        mixed_mm=section.mixed_mm,
        bias_px=section.bias_px,
        misfit_px=points.misfit_px,
        slope_sigma=section.slope_sigma,
        n_lines=points.n_lines,
    )


def shows_arc(setup: Setup, frame: Frame) -> bool:
    """Say whether a frame is said to show an arc that the setup knows."""
    return frame.arc_on and setup.arc.shines


def expected_output(setup: Setup, frame: Frame) -> float:
    """Return what the setup expects of the arc for a frame's current and exposure, over the nominal output.

    Without a known current, or with the arc said to be off, that is the nominal one, and so is an exposure.
    """
    arc, exposure_s = setup.arc, setup.camera.exposure_s
    output: float = output_for(
        float(frame.current_a), float(frame.exposure_s), arc.current_a, exposure_s, arc.current_exponent
    )
    return output


def frame_light(setup: Setup, frame: Frame) -> FrameLight:
    """Return what is said to light a frame."""
    return FrameLight(
        float(frame.exposure_s), float(frame.current_a), bool(frame.laser_on), bool(shows_arc(setup, frame))
    )
