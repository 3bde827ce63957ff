"""Advice on what to inspect in the cell when a diagnosis names an effect, and where to state the result."""

from collections.abc import Mapping

ADVICE: Mapping[str, str] = {
    "arc_length": "Check stick-out and arc voltage; if the arc is meant to be so long, state its height in "
    "[arc] center_in_tool_mm.",
    "arc_deflection": "Look for arc blow: the earth clamp's place, magnetised clamps, a worn electrode tip.",
    "arc_radius": "Check electrode tip, shielding gas and current; state the radius in [arc] radius_mm.",
    "arc_flicker": "Check the current source for pulsing and the electrode for wear; expose whole pulses.",
    "argon_line_leak": "Measure the filter's curve (arctrack calibrate filter) or take a narrower one: argon "
    "shines at 696.5 nm.",
    "laser_power_drift": "Let the laser warm up before welding; check its temperature control and supply.",
    "laser_speckle": "Nothing is broken; a wider aperture or a moving diffuser makes the stripe smoother.",
    "uneven_fan": "Look at the stripe on a white board; state the fan's end in [laser] fan_half_angle_deg.",
    "stripe_profile": "Focus the laser at tool height, and state the width in [laser] stripe_sigma_mm.",
    "ambient_light": "Shade the sensor from the hall's lamps, or keep the effect in the setup.",
    "wrong_material": "Check which metal or coating is on the table, and [material] in the setup.",
    "roughness_change": "Check the surface's finish; measure it anew with arctrack calibrate reflectance.",
    "brdf_tail": "Nothing is broken; keep the effect in the setup, or measure the metal anew.",
    "rolling_marks": "Turn the part by 90 deg to confirm; keep the effect in the setup for this sheet.",
    "plate_outline": "Nothing is broken: the plate ends within the view. Keep the effect in the setup.",
    "interreflection": "Nothing is broken: shiny faces light each other. Keep the effect in the setup.",
    "groove_glare": "Nothing is broken: a groove shines from the arc. Keep the effect in the setup.",
    "mirrored_stripe": "Nothing is broken: shiny faces mirror the stripe. Keep the effect in the setup.",
    "fume": "Check fume extraction and gas shielding; look through the window for haze.",
    "spatter": "Check gas flow, current and cleanliness of the metal; the frames it strikes are lost.",
    "spatter_streaks": "Check gas flow and current; a shorter exposure makes the streaks shorter.",
    "hot_metal_glow": "Nothing is broken: metal glows. A shorter exposure or a shorter wavelength sees less.",
    "dirty_window": "Clean or change the protective window.",
    "ghost_stripe": "Look for the laser on torch or fixture, and for a window or filter without coating.",
    "filter_shift": "State the filter's real effective_index in [filter], or tilt and centre it anew.",
    "vignetting": "Look for something that cuts the field's edge: hood, filter mount, an aperture too wide.",
    "defocus": "Focus the lens anew at the stripe's distance.",
    "veiling_glare": "Clean lens and window, and shade the lens from the arc.",
    "exposure_drift": "Switch automatic exposure and gain off; let the camera warm up.",
    "fixed_pattern": "Take a flat field and correct the camera's gains.",
    "blooming": "Shorten the exposure or close the aperture, so that the arc's reflection does not saturate.",
    "gamma": "Switch the camera's gamma or look-up table off, or state the response in [sensor] gamma.",
    "black_level": "Take dark frames and state the offset in [sensor] black_level_dn.",
    "read_noise": "Take dark frames and state the noise in [sensor] read_noise_e; check cable and gain.",
    "image_compression": "Store frames without loss: PNG, or FFV1 as video.",
    "hand_eye": "Check the camera's bracket, then run arctrack calibrate hand-eye.",
    "surface_tilt": "Check how the plate lies in its clamps, and the work object's frame.",
    "lens_distortion": "Calibrate the lens and state [camera] distortion.",
    "pose_delay": "Bring the clocks of robot and camera together; until then keep the delay in the setup.",
}
"""Advice by id, for each effect of the catalogue."""
