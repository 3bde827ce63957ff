"""Experiments that a diagnosis may ask for: frames taken in another way than the recording's.

Where no experiment separates two effects, a witness does: an instrument that sees only one of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from noise_model.compiled.arrays import Point

N_MORE = 4
"""Frames of an experiment."""

TILT_DEG, RAISE_MM, SHIFT_MM, CURRENT, EXPOSURE, FASTER = 10.0, 2.0, 10.0, 1.5, 0.5, 3.0
"""Changes of the experiments: angle, height, way, and factors of current, exposure and speed."""


@dataclass(frozen=True)
class Experiment:
    """An experiment of the menu; what it does not name is as the setup states, laser and arc on.

    `name` is what the report asks for, `key` is short, for names of files. `exposure` and `current` are
    factors of the setup's, `speed` one of the motion's. The tool is turned by the rotation vector `turn_deg`
    and moved by `move_mm`, both in its own frame.
    """

    key: str
    name: str
    laser_on: bool = True
    arc_on: bool = True
    exposure: float = 1.0
    current: float = 1.0
    turn_deg: Point = (0.0, 0.0, 0.0)
    move_mm: Point = (0.0, 0.0, 0.0)
    speed: float = 1.0


MENU = (
    Experiment("dark", "dark frames", laser_on=False, arc_on=False),
    Experiment("laser", "laser alone, arc off", arc_on=False),
    Experiment("arc", "arc alone, laser off", laser_on=False),
    Experiment("exposure", "a second exposure, half as long", exposure=EXPOSURE),
    Experiment("current", "a second current, half as much again", current=CURRENT),
    Experiment("raised", f"the torch raised by {RAISE_MM:g} mm", move_mm=(0.0, 0.0, RAISE_MM)),
    Experiment("sideways", f"the torch tilted sideways by {TILT_DEG:g} deg", turn_deg=(TILT_DEG, 0.0, 0.0)),
    Experiment(
        "along", f"the torch tilted along the seam by {TILT_DEG:g} deg", turn_deg=(0.0, TILT_DEG, 0.0)
    ),
    Experiment("faster", f"the same run {FASTER:g} times as fast", speed=FASTER),
)
"""The experiments that may be asked for."""

MORE_OF_UNKNOWN = (
    Experiment(
        "shifted",
        f"the torch shifted by {SHIFT_MM:g} mm along the seam, the part at rest",
        move_mm=(SHIFT_MM, 0.0, 0.0),
    ),
    Experiment(
        "turned",
        f"the torch turned by {TILT_DEG:g} deg about its axis, the part at rest",
        turn_deg=(0.0, 0.0, TILT_DEG),
    ),
    Experiment("again", "the same run again, an hour later"),
)
"""Further experiments where the cause is unknown: they tell the camera from the part, and both from time."""

_FLAT_FIELD = "a flat field: opal glass, lit evenly at the laser's wavelength"
_BOARD = "a calibration board, seen from several poses"
_SIDE_VIEW = "a second camera that sees the arc from the side"
_COUPON = "a coupon of the plate, measured with a goniometer"

WITNESS: Mapping[str, str] = {
    "arc_length": _SIDE_VIEW,
    "arc_deflection": _SIDE_VIEW,
    "arc_radius": _SIDE_VIEW,
    "arc_flicker": "the welding current, recorded much faster than the frames",
    "argon_line_leak": "a spectrum of the arc's light behind the filter",
    "laser_power_drift": "a photodiode at the laser",
    "laser_speckle": "a second frame from the same pose with the laser moved by a millimetre",
    "uneven_fan": "the stripe on a white board at tool height, the arc off",
    "stripe_profile": "the sheet on a camera's chip without a lens, the laser dimmed",
    "ambient_light": "the same frames with the hall's lamps off",
    "wrong_material": _COUPON,
    "roughness_change": _COUPON,
    "brdf_tail": _COUPON,
    "rolling_marks": _COUPON,
    "plate_outline": "the plate's edge, touched by the torch",
    "interreflection": "the same joint with one of its faces blackened",
    "fume": "the same run with the fume extraction on",
    "groove_glare": "the same joint with its faces blackened",
    "mirrored_stripe": "the same joint with one of its faces blackened",
    "spatter": "a high-speed camera beside the sensor's",
    "spatter_streaks": "a high-speed camera beside the sensor's",
    "hot_metal_glow": "frames within a second after the arc is switched off",
    "veiling_glare": "a light trap within the view, which is black by itself",
    "defocus": "a slanted edge in the laser plane",
    "vignetting": _FLAT_FIELD,
    "dirty_window": "the same run with a new window",
    "ghost_stripe": "the same frames without the window",
    "filter_shift": "a flat field lit by the laser alone",
    "gamma": "a grey scale of known steps within the view",
    "black_level": "frames with the lens covered",
    "blooming": "the same run with the lens stopped down until nothing saturates",
    "fixed_pattern": _FLAT_FIELD,
    "read_noise": "frames with the lens covered",
    "image_compression": "the same frames, stored without loss",
    "exposure_drift": "a lamp of constant light within the view",
    "hand_eye": _BOARD,
    "surface_tilt": "three points of the plate, touched by the torch",
    "lens_distortion": _BOARD,
    "pose_delay": "a signal that starts frame and pose together",
}
"""The instrument that would see each effect, and no other."""
