"""Width of the stripe against the stated one, and the setup that states the measured width."""

import math
from dataclasses import dataclass, replace

import numpy as np

from arctrack.check.check_sample import CheckCase
from noise_model.arc.scene import make_scene
from tracker.geometry import SensorGeometry
from tracker.stripe.expected import expect_stripe


@dataclass(frozen=True)
class StripeWidth:
    """The stripe's 1 sigma, px, as measured and as a setup has it, NaN where unknown."""

    measured_px: float
    stated_px: float

    @property
    def ln_ratio(self) -> float:
        """Logarithm of measured over stated width, NaN where unknown."""
        return math.log(self.measured_px / self.stated_px)

    def mended(self, case: CheckCase) -> CheckCase:
        """Return the case with the measured width: the sheet's, and the lens' where that alone is wider."""
        camera, laser = case.setup.camera, case.setup.laser
        sheet_px2 = self.stated_px**2 - camera.psf_sigma_px**2
        psf_px = min(camera.psf_sigma_px, 0.9 * self.measured_px)
        sheet = math.sqrt((self.measured_px**2 - psf_px**2) / sheet_px2)
        laser = replace(laser, stripe_sigma_mm=sheet * laser.stripe_sigma_mm)
        return case.with_setup(replace(case.setup, camera=replace(camera, psf_sigma_px=psf_px), laser=laser))


def stripe_width(case: CheckCase) -> StripeWidth:
    """Return the stripe's width in a case's frames, and as its setup has it at the nominal seam."""
    try:
        geometry = SensorGeometry.of(case.setup)
    except ValueError:
        return StripeWidth(case.sigma_px, math.nan)
    widths_px = []
    for T_base_tool in case.T_base_tool:
        scene = make_scene(case.setup, T_base_tool) if np.isfinite(T_base_tool).all() else None
        expected = None if scene is None or scene.below_surface else expect_stripe(geometry, scene)
        if expected is not None:
            widths_px.append(float(np.median(expected.sigma_px)))
    return StripeWidth(case.sigma_px, float(np.median(widths_px)) if widths_px else math.nan)
