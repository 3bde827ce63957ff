"""The camera's pose in the tool from the arc's own light.

The stripe alone cannot tell a camera that is off by a tenth of a millimetre from a part that is. The arc can:
it burns below the tool's origin, and how its reflected light falls off over the image says where the camera
stands beside it. The estimate is therefore as good as the arc's stated place: an arc that is blown sideways
moves the camera by as much. Priors hold it to the stated hand-eye tolerance, and what would have to leave it
far behind is refused.

The seam is where the tracker saw it, moved and turned as a whole by what is fitted along: a camera that is
off shifts all of what was tracked by nearly the same: the way it wanders is right, its place is not.

Each round chooses pixels that lie off the edges of the joint's faces, takes their residuals as linear, and
goes on to the fit's result, but no further than the pixels go on seeing the faces that they were chosen for:
what changes by a jump has no derivative.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.arc.map import Scene, arc_at, arc_kernel, make_scene
from noise_model.arc_source import level as current_level
from noise_model.arrays import Float32, Float64, Int32, Int64
from noise_model.effects import apply_setup_effects
from noise_model.fit import Fit, Parameter, fit
from noise_model.instrument.sensor import variance_e2
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from noise_model.surface.ray_casting import trace
from noise_model.transforms import invert, moved, transform
from tracker.arc.level import HUBER
from tracker.arc.transmission import Transmission, seen_arc
from tracker.geometry import SensorGeometry
from tracker.seam.gaussian_process import CAPACITY
from tracker.seam.locate import expected_seam
from tracker.state import Frame, Pose
from tracker.step import TrackerState
from tracker.stripe.expected import expect_stripe
from tracker.tracker import Tracker

LATTICE_PX = 16
"""So far apart are the pixels that are compared."""

MAP_SIGMA = 0.02
"""What the arc's light may be off from pixel to pixel beyond its noise, relative."""

KEEP_OFF_SIGMAS = 5.0
"""How far a pixel must lie from the stripe, in the stripe's sigmas."""

EDGE_PX, STEEPEST = 8, 0.3
"""A pixel counts if so far to each side the same face is seen and the light changes by a smaller share."""

STEP_PX = 0.5 * EDGE_PX
"""So far a round may move what a pixel sees: with an edge that comes to meet it the pixel's face stays."""

SETTLED_SIGMAS, MAX_ROUNDS = 0.2, 30
"""Rounds go on until the camera moves by no more of its sigmas."""

SEAM_SIGMA_MM, SEAM_SLOPE_SIGMA = 5.0, 0.05
"""1 sigma of how far the seam lies off where it was tracked, and of how it is turned against that."""

SEAM_KNOWN_MM = 0.2
"""A frame counts if the tracked seam is known so well under its stripe, 1 sigma."""

EVERY = CAPACITY // 3
"""The state after every so many measurements is kept: what one has forgotten the one before still knows."""

WANDER_MM = 0.03
"""A seam that leaves no straight line by more is one: a camera that is off makes as much of a tilt."""

FAR_SIGMAS = 4.0
"""A camera further off than so many of its stated sigmas means that something else is wrong."""

MAX_LEVEL_FACTOR = 20.0
"""An arc by so much brighter or darker than stated means the same."""

NOTHING_TO_COMPARE = (
    "no pixel with the arc's light is below saturation, off the stripe and off the joint's edges: shorten "
    "the exposure"
)

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

    Place and direction of the tracked seam are fitted along. Every `lattice_px`-th pixel of each row and
    column is compared; frames of unknown current count where none is known. `progress` hears the rounds done
    and how many there may be. Raises ValueError if no frame has the arc on or none of them a pixel to
    compare, if the joint was found in none, if the rounds do not settle, or if the camera would have to be
    off by more than FAR_SIGMAS of its tolerance or the arc by a factor of MAX_LEVEL_FACTOR: then arc or
    material are not as stated, or the seam bends within an image, where it is taken as straight.
    """
    lit = [(frame, pose) for frame, pose in frames if frame.arc_on and frame.current_a != 0.0]
    if any(frame.current_a > 0.0 for frame, _ in lit):
        # One level is fitted for all: a frame whose current is unknown may have another.
        lit = [(frame, pose) for frame, pose in lit if frame.current_a > 0.0]
    if not lit:
        raise ValueError("no frame has the arc on: the hand-eye estimate needs the arc's light")
    seen = _with_seam(setup, lit, _tracked(setup, frames))
    result = _settled(setup, seen, progress, lattice_px)
    change = result.values[:6]
    return HandEye(moved(setup.camera.T_tool_camera, change[:3], change[3:6]), result)


@dataclass(frozen=True)
class _Seen:
    """A frame with the arc on, its pose, and the seam as tracked under its stripe."""

    frame: Frame
    pose: Pose
    tracked: SeamLine

    def seam(self, x: Float64, about_mm: float) -> SeamLine:
        """Return the seam as fitted (12,): the tracked one moved and, about a station, turned."""
        at, (y, z, slope_y, slope_z) = self.tracked, x[8:].tolist()
        along = at.station_mm - about_mm
        return SeamLine(
            at.station_mm,
            at.y_mm + y + slope_y * along,
            at.z_mm + z + slope_z * along,
            at.slope_y + slope_y,
            at.slope_z + slope_z,
        )


def _tracked(setup: Setup, frames: Sequence[tuple[Frame, Pose]]) -> list[TrackerState]:
    """Track the recording and return states that know a seam, all of what it has seen among them."""
    tracker = Tracker(setup)
    states: list[TrackerState] = []
    for frame, pose in frames:
        tracker.step(frame, pose)
        if len(tracker.state.history) and not (states and states[-1].history is tracker.state.history):
            states.append(tracker.state)
    if not states:
        raise ValueError("the joint was found in no frame: the hand-eye estimate needs its place")
    return states[::-1][::EVERY][::-1]


def _with_seam(
    setup: Setup, frames: Sequence[tuple[Frame, Pose]], states: Sequence[TrackerState]
) -> list[_Seen]:
    """Return the frames under whose stripe the seam is known, each with what knows it best.

    A history forgets what lies far behind, so that of a long recording no single one knows all of it.
    """
    seen = []
    for frame, pose in frames:
        nominal_scene = make_scene(setup, pose.T_base_tool)
        station_mm = expected_seam(setup, nominal_scene, states[-1].history)[0].station_mm
        lines = [state.history_at(station_mm).line_at(station_mm) for state in states]
        line, sigma = min(lines, key=lambda known: float(known[1].max()))
        if sigma.max() <= SEAM_KNOWN_MM:
            seen.append(_Seen(frame, pose, line))
    if not seen:
        raise ValueError(
            "the joint was found near no frame with the arc on: the hand-eye estimate needs the seam there"
        )
    return _straightened(seen)


def _straightened(seen: list[_Seen]) -> list[_Seen]:
    """Return the frames with their seams on one straight line, the least squares', if that will do.

    The groove shows where the arc stands beside it, 35 mm off: there slopes of 0.003, which are the tracker's
    own, would move it by 0.1 mm in each frame anew.
    """
    stations = np.array([one.tracked.station_mm for one in seen])
    along = np.column_stack([np.ones_like(stations), stations - stations.mean()])
    places = np.array([(one.tracked.y_mm, one.tracked.z_mm) for one in seen])
    line = np.linalg.lstsq(along, places, rcond=None)[0]
    on_line = along @ line
    if np.abs(places - on_line).max() > WANDER_MM:
        return seen
    return [
        replace(one, tracked=SeamLine(one.tracked.station_mm, *place.tolist(), *line[1].tolist()))
        for one, place in zip(seen, on_line, strict=True)
    ]


def _settled(
    setup: Setup, seen: Sequence[_Seen], progress: Callable[[int, int], None], lattice_px: int
) -> Fit:
    """Choose pixels and fit in turn until the camera settles; ValueError if it does not, or far off."""
    about_mm = float(np.median([one.tracked.station_mm for one in seen]))
    x = np.zeros(12)
    for done in range(MAX_ROUNDS):
        progress(done, MAX_ROUNDS)
        geometry = SensorGeometry.of(_with_camera(setup, x[:6]))
        views = [_View.of(geometry, one, one.seam(x, about_mm), lattice_px) for one in seen]
        if not any(len(view.pixels) for view in views):
            raise ValueError(NOTHING_TO_COMPARE)
        if done == 0:
            x[6] = _ln_level(setup, views)
        result = _fit(setup, views, about_mm, x)
        turned = _with_camera(setup, result.values[:6])
        shift_px = max(view.shift_px(turned, view.seen.seam(result.values, about_mm)) for view in views)
        step = result.values - x
        is_settled = shift_px < STEP_PX and bool((np.abs(step) < SETTLED_SIGMAS * result.sigmas)[:6].all())
        if is_settled:
            break
        x = x + min(1.0, STEP_PX / max(shift_px, STEP_PX)) * step
    progress(MAX_ROUNDS, MAX_ROUNDS)
    if "ln_arc_level" in result.at_bounds:
        raise ValueError(
            f"the arc would have to be off by a factor of {MAX_LEVEL_FACTOR:g}: arc or material are not as "
            "stated, or there are too few frames with the arc on"
        )
    stated = np.array([parameter.prior_sigma for parameter in result.parameters[:6]])
    far = float(np.max(np.abs(result.values[:6]) / stated))
    if far > FAR_SIGMAS:
        raise ValueError(
            f"the camera would have to be off by {far:.0f} of its stated sigmas: arc or material are not as "
            "stated, the seam bends within the image, or [tolerance] hand_eye_deg and hand_eye_mm are too "
            "small"
        )
    if is_settled:
        return result
    raise ValueError(
        f"camera and seam do not settle in {MAX_ROUNDS} rounds: arc, material or joint are not as stated, "
        "the seam bends within the image, or it takes more frames with the arc on"
    )


def _with_camera(setup: Setup, change: Float64) -> Setup:
    """Return the setup with its camera turned and moved."""
    camera = setup.camera
    return replace(
        setup, camera=replace(camera, T_tool_camera=moved(camera.T_tool_camera, change[:3], change[3:6]))
    )


@dataclass(frozen=True)
class _View:
    """One frame's pixels (n,) off stripe, edges and saturation.

    Their places by scan line, charge, the face that each saw from `chosen`, and the expected output.
    """

    geometry: SensorGeometry
    seen: _Seen
    scene: Scene
    pixels: Int64
    faces: Int32
    charge_e: Float64
    output: float

    @classmethod
    def of(cls, geometry: SensorGeometry, seen: _Seen, seam: SeamLine, lattice_px: int) -> _View:
        setup, frame = geometry.setup, seen.frame
        s, r = geometry.lattice(lattice_px)
        scene = make_scene(setup, seen.pose.T_base_tool, seam)
        kernel = arc_kernel(setup, scene)
        keep = np.ones(len(s), dtype=bool)
        stripe = expect_stripe(geometry, scene)
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
        charge_e = geometry.charge_e[dn[keep]].astype(np.float64)
        return cls(geometry, seen, scene, pixels, face[keep], charge_e, output)

    def residual(self, setup: Setup, level: float, black_e: float, seam: SeamLine) -> Float64:
        """Return the whitened residuals (n,) against a setup, NaN of a pixel that sees another face."""
        mean_e = self.mean_e(setup, level, black_e, seam)
        variance = variance_e2(mean_e, self.geometry.setup.sensor) + (MAP_SIGMA * mean_e) ** 2
        return np.asarray((self.charge_e - mean_e) / np.sqrt(variance))

    def mean_e(self, setup: Setup, level: float, black_e: float, seam: SeamLine) -> Float64:
        """Return the charge (n,) that a setup lets expect, NaN of a pixel that sees another face."""
        true = apply_setup_effects(setup)
        scene = make_scene(true, self.seen.pose.T_base_tool, seam)
        output = level * self.output
        kernel = arc_kernel(true, scene, output)

        def light(pixels: Int64) -> Float32:
            return arc_at(kernel, self.geometry.xy, self.geometry.cos4, pixels)[0]

        own_e, faces = arc_at(kernel, self.geometry.xy, self.geometry.cos4, self.pixels)
        transmission = Transmission.of(self.geometry, scene, light, output)
        arc_e, other_e = seen_arc(lambda _: own_e, transmission, self.pixels)
        return np.where(faces == self.faces, arc_e + other_e + black_e, np.nan)

    def shift_px(self, setup: Setup, seam: SeamLine) -> float:
        """Return how far what the pixels saw moves in the image at most with this camera and seam."""
        before, after = self.scene, make_scene(apply_setup_effects(setup), self.seen.pose.T_base_tool, seam)
        points, normals = np.empty((2, len(self.pixels), 3))
        faces = np.empty(len(self.pixels), dtype=np.int32)
        shape = before.shape
        trace(
            self.geometry.xy,
            self.pixels,
            before.T_joint_camera,
            shape.vertices,
            shape.corrugation,
            points,
            normals,
            faces,
        )
        there, here = (
            view.camera.project(transform(invert(view.T_joint_camera), points)) for view in (before, after)
        )
        return float(np.linalg.norm(here - there, axis=1).max(initial=0.0))


def _ln_level(setup: Setup, views: Sequence[_View]) -> float:
    """Return about which level, within its bounds, the arc has where camera and seam are as stated."""
    mean_e = sum(float(view.mean_e(setup, 1.0, 0.0, view.seen.tracked).sum()) for view in views)
    if not mean_e > 0.0:
        raise ValueError(NOTHING_TO_COMPARE)
    # All at once: of pixels in shadow nothing is expected.
    charge_e = sum(float(view.charge_e.sum()) for view in views)
    return math.log(min(max(charge_e / mean_e, 1.0 / MAX_LEVEL_FACTOR), MAX_LEVEL_FACTOR))


def _fit(setup: Setup, views: Sequence[_View], about_mm: float, about: Float64) -> Fit:
    """Fit the camera's change, the arc's level, the black level and the seam's move and turn to all views.

    The residuals are those about some values (12,), taken as linear, of the pixels whose faces stay.
    """
    tolerance, ln_level = setup.tolerance, math.log(MAX_LEVEL_FACTOR)
    deg, mm = max(tolerance.hand_eye_deg, 1e-6), max(tolerance.hand_eye_mm, 1e-6)
    black_e = max(tolerance.black_level_dn * setup.sensor.gain_e_per_dn, 1e-3)
    parameters = [
        *(Parameter(name, "deg", 0.0, deg, step=0.01) for name in CAMERA[:3]),
        *(Parameter(name, "mm", 0.0, mm, step=0.01) for name in CAMERA[3:]),
        Parameter("ln_arc_level", "", 0.0, lower=-ln_level, upper=ln_level, step=1e-3),
        Parameter("black_level", "e-", 0.0, black_e, step=1.0),
        Parameter("seam_y", "mm", 0.0, SEAM_SIGMA_MM, step=0.01),
        Parameter("seam_z", "mm", 0.0, SEAM_SIGMA_MM, step=0.01),
        Parameter("seam_slope_y", "mm/mm", 0.0, SEAM_SLOPE_SIGMA, step=5e-4),
        Parameter("seam_slope_z", "mm/mm", 0.0, SEAM_SLOPE_SIGMA, step=5e-4),
    ]

    def residuals(x: Float64) -> Float64:
        turned = _with_camera(setup, x[:6])
        return np.concatenate(
            [view.residual(turned, math.exp(x[6]), x[7], view.seen.seam(x, about_mm)) for view in views]
        )

    at = residuals(about)
    steps = [parameter.step * unit for parameter, unit in zip(parameters, np.eye(12), strict=True)]
    J = np.column_stack([(residuals(about + step) - at) / step.sum() for step in steps])
    stay = np.isfinite(J).all(axis=1)
    at, J = at[stay], J[stay]
    return fit(parameters, lambda x: at + J @ (x - about), huber=HUBER, start=about)
