"""The camera's pose in the tool from the arc's own light.

The stripe alone cannot tell a camera that is off by a tenth of a millimetre from a part that is. The arc can:
it burns below the tool's origin, and how its reflected light falls off over the image says where the camera
stands beside it. The estimate is therefore as good as the arc's stated place: an arc that is blown sideways
moves the camera by as much. Priors hold it to the stated hand-eye tolerance, and what would have to leave it
far behind is refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from noise_model.arc import level as current_level
from noise_model.arc_map import arc_at, arc_kernel, scene
from noise_model.effects import really
from noise_model.fit import Fit, Parameter, fit
from noise_model.frames import Float64, moved
from noise_model.sensor import variance_e2
from noise_model.setup import Setup
from noise_model.surface import SeamLine
from tracker.arc_level import HUBER
from tracker.expected import expect_stripe
from tracker.geometry import SensorGeometry
from tracker.passage import Passage, seen_arc
from tracker.state import Frame, Pose
from tracker.step import Tracker

LATTICE_PX = 16
"""So far apart are the pixels that are compared."""

MAP_SIGMA = 0.02
"""What the arc's light may be off from pixel to pixel beyond its noise, relative."""

KEEP_OFF_SIGMAS = 5.0
"""How far a pixel must lie from the stripe, in the stripe's sigmas."""

EDGE_PX, STEEPEST = 8, 0.3
"""A pixel counts if so far to each side the same face is seen and the light changes by a smaller share."""

ROUNDS = 3
"""How often the pixels are chosen anew with the camera and seam found so far."""

SEAM_SIGMA_MM, SEAM_SLOPE_SIGMA = 5.0, 0.05
"""1 sigma of where a straight seam lies and how it is turned against its nominal line."""

FAR_SIGMAS = 4.0
"""A camera further off than so many of its stated sigmas means that something else is wrong."""

MOST_LEVEL = 20.0
"""An arc by so much brighter or darker than stated means the same."""

CAMERA = ("rot_x", "rot_y", "rot_z", "move_x", "move_y", "move_z")


@dataclass(frozen=True)
class HandEye:
    """The result: T_tool_camera (4, 4), mm, the fit behind it, and the arc's level over the nominal one."""

    T_tool_camera: Float64
    fit: Fit


def estimate_hand_eye(
    setup: Setup,
    frames: Sequence[tuple[Frame, Pose]],
    progress: Callable[[int, int], None] = lambda done, total: None,
    lattice_px: int = LATTICE_PX,
) -> HandEye:
    """Estimate T_tool_camera from frames and their poses, some of them with the arc on.

    The seam is taken as straight over the recording: its place and direction are fitted along. Every
    `lattice_px`-th pixel of each row and column is compared; frames of unknown current count where none is
    known. Raises ValueError if no frame has the arc on, if
    the joint was found in none, or if the camera would have to be off by more than FAR_SIGMAS of its
    tolerance or the arc by a factor of MOST_LEVEL: then the seam is not straight, or arc or material are not
    as stated.
    """
    lit = [(frame, pose) for frame, pose in frames if frame.arc_on and frame.current_a != 0.0]
    if any(frame.current_a > 0.0 for frame, _ in lit):
        # One level is fitted for all: a frame whose current is unknown may have another.
        lit = [(frame, pose) for frame, pose in lit if frame.current_a > 0.0]
    if not lit:
        raise ValueError("no frame has the arc on: the hand-eye estimate needs the arc's light")
    seam = _straight_seam(setup, frames)
    change = np.zeros(6)
    for done in range(ROUNDS):
        progress(done, ROUNDS)
        turned = _with_camera(setup, change)
        views = [_View.of(turned, frame, pose, seam, lattice_px) for frame, pose in lit]
        result = _fit(setup, views, seam)
        change = result.values[:6]
        seam = SeamLine(seam.station_mm, *(float(value) for value in result.values[8:]))
        if "ln_arc_level" in result.at_bounds:
            raise ValueError(
                f"the arc would have to be off by a factor of {MOST_LEVEL:g}: the seam is not straight, "
                "arc or material are not as stated, or there are too few frames with the arc on"
            )
    progress(ROUNDS, ROUNDS)
    stated = np.array([parameter.prior_sigma for parameter in result.parameters[:6]])
    far = float(np.max(np.abs(change) / stated))
    if far > FAR_SIGMAS:
        raise ValueError(
            f"the camera would have to be off by {far:.0f} of its stated sigmas: the seam is not straight, "
            "arc or material are not as stated, or [tolerance] hand_eye_deg and hand_eye_mm are too small"
        )
    return HandEye(moved(setup.camera.T_tool_camera, change[:3], change[3:6]), result)


def _straight_seam(setup: Setup, frames: Sequence[tuple[Frame, Pose]]) -> SeamLine:
    """Track the recording and return the seam at its middle, running along its nominal line."""
    tracker = Tracker(setup)
    for frame, pose in frames:
        tracker.step(frame, pose)
    history = tracker.state.history
    if len(history) == 0:
        raise ValueError("the joint was found in no frame: the hand-eye estimate needs its place")
    y, z = np.median(history.displacements_mm, axis=0)
    return SeamLine(float(np.median(history.stations_mm)), float(y), float(z))


def _with_camera(setup: Setup, change: Float64) -> Setup:
    """Return the setup with its camera turned and moved."""
    camera = setup.camera
    return replace(
        setup, camera=replace(camera, T_tool_camera=moved(camera.T_tool_camera, change[:3], change[3:6]))
    )


@dataclass(frozen=True)
class _View:
    """One frame's pixels off stripe, edges and saturation: their places, charge, the expected output."""

    geometry: SensorGeometry
    pose: Pose
    pixels: npt.NDArray[np.int64]
    charge_e: Float64
    output: float

    @classmethod
    def of(cls, setup: Setup, frame: Frame, pose: Pose, seam: SeamLine, lattice_px: int) -> _View:
        geometry = SensorGeometry.of(setup)
        setup = geometry.setup
        s, r = geometry.lattice(lattice_px)
        view = scene(setup, pose.T_base_tool, seam)
        kernel = arc_kernel(setup, view)
        keep = np.ones(len(s), dtype=bool)
        stripe = expect_stripe(geometry, view)
        if frame.laser_on and stripe is not None:
            keep &= np.abs(r - stripe.position_px[s]) > KEEP_OFF_SIGMAS * stripe.sigma_px[s]
        dn = frame.image_dn[r, s] if geometry.along_rows else frame.image_dn[s, r]
        keep &= dn < geometry.saturation_dn
        predicted, face = arc_at(kernel, geometry.xy, geometry.cos4, s * geometry.n_pos + r)
        keep &= np.isfinite(predicted)
        for ds, dr in ((EDGE_PX, 0), (-EDGE_PX, 0), (0, EDGE_PX), (0, -EDGE_PX)):
            s_near = np.clip(s + ds, 0, geometry.n_scan - 1)
            r_near = np.clip(r + dr, 0, geometry.n_pos - 1)
            near, near_face = arc_at(kernel, geometry.xy, geometry.cos4, s_near * geometry.n_pos + r_near)
            with np.errstate(invalid="ignore"):
                keep &= (near_face == face) & (np.abs(near - predicted) <= STEEPEST * predicted)
        current = current_level(setup.arc, frame.current_a) if frame.current_a > 0.0 else 1.0
        output = current * frame.exposure_s / setup.camera.exposure_s
        pixels = (s * geometry.n_pos + r)[keep]
        return cls(geometry, pose, pixels, geometry.charge_e[dn[keep]].astype(np.float64), output)

    def residual(self, setup: Setup, level: float, black_e: float, seam: SeamLine) -> Float64:
        """Return the whitened residuals (n,) against a setup; past the part no light is expected."""
        true = really(setup)
        view = scene(true, self.pose.T_base_tool, seam)
        output = level * self.output
        kernel = arc_kernel(true, view, output)

        def light(pixels: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
            return arc_at(kernel, self.geometry.xy, self.geometry.cos4, pixels)[0]

        passage = Passage.of(self.geometry, view, light, output)
        arc_e, other_e = seen_arc(light, passage, self.pixels)
        mean = np.nan_to_num(arc_e) + other_e + black_e
        variance = variance_e2(mean, self.geometry.setup.sensor) + (MAP_SIGMA * mean) ** 2
        return np.asarray((self.charge_e - mean) / np.sqrt(variance))


def _fit(setup: Setup, views: Sequence[_View], seam: SeamLine) -> Fit:
    """Fit the camera's change, the arc's level, the black level and a straight seam to all views."""
    tolerance, ln_level = setup.tolerance, math.log(MOST_LEVEL)
    deg, mm = max(tolerance.hand_eye_deg, 1e-6), max(tolerance.hand_eye_mm, 1e-6)
    black_e = max(tolerance.black_level_dn * setup.sensor.gain_e_per_dn, 1e-3)
    parameters = [
        *(Parameter(name, "deg", 0.0, deg, step=0.01) for name in CAMERA[:3]),
        *(Parameter(name, "mm", 0.0, mm, step=0.01) for name in CAMERA[3:]),
        Parameter("ln_arc_level", "", 0.0, lower=-ln_level, upper=ln_level, step=1e-3),
        Parameter("black_level", "e-", 0.0, black_e, step=1.0),
        Parameter("seam_y", "mm", seam.y_mm, SEAM_SIGMA_MM, step=0.01),
        Parameter("seam_z", "mm", seam.z_mm, SEAM_SIGMA_MM, step=0.01),
        Parameter("seam_slope_y", "mm/mm", seam.slope_y, SEAM_SLOPE_SIGMA, step=5e-4),
        Parameter("seam_slope_z", "mm/mm", seam.slope_z, SEAM_SLOPE_SIGMA, step=5e-4),
    ]

    def residuals(x: Float64) -> Float64:
        turned, line = (
            _with_camera(setup, x[:6]),
            SeamLine(seam.station_mm, *(float(value) for value in x[8:])),
        )
        return np.concatenate([view.residual(turned, math.exp(x[6]), x[7], line) for view in views])

    return fit(parameters, residuals, huber=HUBER)
