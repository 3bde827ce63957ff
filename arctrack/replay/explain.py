"""Explanation of one frame of a recording: what the tracker's step did with it, and on what grounds.

The frames before it go through the same step, so the seam's history is the one that the replay had. The
observation that counts is then repeated for what the step does not keep: nothing is random, so it gives the
same numbers bit for bit.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from skimage.measure import approximate_polygon

from arctrack.control.recorded_job import recorded_job
from arctrack.errors import ArctrackError, in_file
from arctrack.recording import BadFrame, Recording, require_images
from arctrack.replay.arc_light import arc_light
from arctrack.replay.explain_lines import Refusals, SigmaParts, refusals, sigma_parts
from arctrack.replay.replay_loop import replay_without_bus
from noise_model.arc.map import arc_kernel
from noise_model.arc.scene import Scene, make_scene
from noise_model.compiled.arrays import Float32, Float64
from noise_model.instrument.sensor import variance_e2
from noise_model.surface.joint import MAX_SECTION_POINTS
from tracker import flags
from tracker.arc.level import MAP_SIGMA, ArcLevel
from tracker.arc.transmission import Transmission
from tracker.checks import FrameChecks
from tracker.geometry import SensorGeometry
from tracker.joint import MeasuredJoint, fit_section
from tracker.joint.type_check import groups_of
from tracker.judge import jump_limit_mm
from tracker.observation import FrameInput, Reading, expected_output, observe, observed_section
from tracker.profile import Section
from tracker.seam.locate import locate
from tracker.state import Frame, Pose, Track
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.read import StripeReading, Work
from tracker.tracker_state import TrackerMemory


@dataclass(frozen=True, eq=False)
class ArcImage:
    """The arc's light as predicted for a frame, at the level that was found in it; images (H, W).

    `mean_e` is NaN where a pixel looks past the workpiece, `whitened` is frame less prediction in sigmas of
    pixel noise and of the map's stated uncertainty, NaN for saturated pixels too.
    """

    mean_e: Float32
    whitened: Float32


@dataclass(frozen=True, eq=False)
class StripeLook:
    """Reading of the stripe, why some scan lines hold none, and the parts of the others' sigma."""

    reading: StripeReading
    refusals: Refusals
    parts: SigmaParts


@dataclass(frozen=True, eq=False)
class SeamLook:
    """A measured seam and the earlier ones, displacements (2,) as (y, z) from the programmed path, mm."""

    station_mm: float
    displacement_mm: Float64
    variance_mm2: Float64
    expected_mm: Float64
    expected_sigma_mm: Float64
    limit_mm: Float64


@dataclass(frozen=True, eq=False)
class StepObservation:
    """Observations of the step in a frame; None where it did not get that far.

    `reach_px` is the half-width of the search about the expected stripe, `torch_station_mm` the torch's
    station along the path. `joint` is the one that the step took, otherwise what the profile shows. `seam` is
    None where it took none.
    """

    reading: Reading
    reach_px: float
    torch_station_mm: float
    expected: ExpectedStripe | None = None
    arc: ArcImage | None = None
    stripe: StripeLook | None = None
    profile: Section | None = None
    joint: MeasuredJoint | None = None
    seam: SeamLook | None = None


@dataclass(frozen=True, eq=False)
class Explanation:
    """A frame's track, the tracker's state before it, and the look; None if none was taken."""

    recording: Recording
    geometry: SensorGeometry
    frame: Frame
    pose: Pose | None
    use_arc_map: bool
    before: TrackerMemory
    track: Track
    look: StepObservation | None


def explain(
    recording: Recording, index: int, use_arc_map: bool = True, on_frame: Callable[[int], None] | None = None
) -> Explanation:
    """Replay a recording up to the frame of an index and explain it; `on_frame` gets the frames done.

    Raises ArctrackError if the recording has no such frame, or if it cannot be read.
    """
    require_images(recording.setup, recording.setup_path, "replay.html has each profile and its checks")
    positions = range(position_of(recording, index) + 1)
    job = recorded_job(recording, use_arc_map=use_arc_map)
    outcomes = replay_without_bus(job, positions)
    for position in positions:
        _, frame, outcome = next(outcomes)
        if on_frame is not None:
            on_frame(position + 1)
    if isinstance(frame, BadFrame):
        raise ArctrackError(f"{frame.message}: there is nothing to explain; choose another frame")
    step = outcome.tracked.step
    assert step is not None
    inputs, reading, tracker = step.inputs, step.reading, job.tracking.tracker
    look = None
    if inputs.pose is not None and reading is not None:
        # A frame that contradicts the arc map was read as if no arc were said to burn, one that shows an arc
        # that was not announced with it.
        as_read = replace(frame, arc_on=reading.arc.is_on)
        given = FrameInput(
            geometry=tracker.geometry,
            state=inputs.state,
            frame=as_read,
            T_base_tool=inputs.pose.T_base_tool,
            is_extrapolated=inputs.pose.extrapolated,
            work=Work.of(tracker.geometry),
            use_arc_map=use_arc_map,
            correction=tracker.correction,
            lead=inputs.lead,
            arc_burns=frame.arc_on or bool(reading.evidence.burns),
        )
        look = _look(given, reading)
    return Explanation(
        recording=recording,
        geometry=tracker.geometry,
        frame=frame,
        pose=inputs.pose,
        use_arc_map=use_arc_map,
        before=inputs.state,
        track=outcome.tracked.track,
        look=look,
    )


def position_of(recording: Recording, index: int) -> int:
    """Return the position of the frame with an index; ArctrackError if there is none."""
    for position, row in enumerate(recording.rows):
        if row.index == index:
            return position
    first, last = recording.rows[0].index, recording.rows[-1].index
    nearest = min((row.index for row in recording.rows), key=lambda known: abs(known - index))
    problem = f"has no frame {index}; its frames run from {first} to {last}, and {nearest} is the nearest"
    raise in_file(recording.path, problem)


def _look(given: FrameInput, reading: Reading) -> StepObservation:
    """Take a reading apart, as far as the step went."""
    geometry, use_arc_map = given.geometry, given.use_arc_map
    scene, aim = reading.scene, reading.aim(use_arc_map)
    nominal_scene = make_scene(geometry.setup, given.T_base_tool)
    reach_px = geometry.reach_px(reading.reach_mm)
    look = StepObservation(reading, reach_px, float(nominal_scene.T_joint_tool[0, 3]))
    # A search looks more than once, and each look writes over what the one before had read.
    seen = observe(given, FrameChecks(), aim)
    if seen.expected is None:
        return look
    expected, stripe = seen.expected, seen.stripe
    arc = _arc_image(geometry, scene, seen.transmission, reading.arc, given.frame)
    look = replace(look, expected=expected, arc=arc)
    if stripe is None:
        return look
    section = observed_section(geometry, aim, seen)
    look = replace(look, stripe=StripeLook(stripe, refusals(stripe, expected), sigma_parts(stripe, expected)))
    if len(section.y_mm) < 2:
        return look
    look = replace(look, profile=section)
    if reading.flags & flags.STRIPE_LOST.mask:
        return look
    if reading.joint is None:
        return replace(look, joint=fit_section(section, geometry.setup.joint, given.stripe_image))
    return replace(look, joint=reading.joint, seam=_seam_look(given, scene, reading.joint))


def _arc_image(
    geometry: SensorGeometry, scene: Scene, transmission: Transmission | None, arc: ArcLevel, frame: Frame
) -> ArcImage:
    """Predict the arc's light over the whole image, as the tracker does it for the stripe's band."""
    kernel = arc_kernel(geometry.setup, scene, expected_output(geometry.setup, frame))
    arc_e, mean_e = arc_light(geometry, kernel, transmission, arc)
    dn = frame.image_dn.T if geometry.along_rows else frame.image_dn
    charge_e = geometry.charge_e[np.minimum(dn, len(geometry.charge_e) - 1)]
    variance = variance_e2(mean_e, geometry.setup.sensor) + (MAP_SIGMA * arc_e) ** 2
    whitened = np.where(dn < geometry.saturation_dn, (charge_e - mean_e) / np.sqrt(variance), np.nan)
    images = (mean_e, whitened.astype(np.float32))
    return ArcImage(*(image.T if geometry.along_rows else image for image in images))


def _seam_look(given: FrameInput, scene: Scene, joint: MeasuredJoint) -> SeamLook:
    """Compare a measured joint with its position by the earlier frames."""
    source = given.geometry.seam_source
    located = locate(source, given.T_base_tool, scene, joint.y_mm, joint.z_mm)
    station, displacement = located.station_mm, np.array(located.displacement_mm)
    variance = np.diag(joint.covariance_mm2)
    there = source.seam_at(given.state.history, station)
    expected, sigma = np.array(there.displacement_mm), np.array(there.sigma_mm)
    limit = np.array(list(map(jump_limit_mm, sigma.tolist(), variance.tolist())))
    return SeamLook(station, displacement, variance, expected, sigma, limit)


simplify: Callable[[Float64, float], Float64] = approximate_polygon


def taught_section(explanation: Explanation) -> str:
    """Return the line of `[joint]` that states a frame's profile as `section_mm`.

    Neighbouring points stand in it as their median, and as few as keep its shape. ArctrackError is raised
    where the frame shows no profile on both sides of the programmed line.
    """
    look, name = explanation.look, f"frame {explanation.frame.index}"
    if look is None or look.profile is None:
        raise in_file(explanation.recording.path, f"{name} shows no profile; choose another frame")
    groups, seam = groups_of(look.profile.points), look.reading.seam
    y_mm, z_mm = np.round(groups.y_mm + seam.y_mm, 3), np.round(groups.z_mm + seam.z_mm, 3)
    rises = np.concatenate([[True], y_mm[1:] > np.maximum.accumulate(y_mm)[:-1]])
    y_mm, z_mm = y_mm[rises], z_mm[rises]
    section, tolerance_mm = np.column_stack([y_mm, z_mm]), 0.01
    while len(section) > MAX_SECTION_POINTS:
        section, tolerance_mm = simplify(section, tolerance_mm), 1.5 * tolerance_mm
    if not y_mm[0] < 0.0 < y_mm[-1]:
        problem = f"{name} shows y from {y_mm[0]:g} to {y_mm[-1]:g} mm, not both sides of the programmed seam"
        raise in_file(explanation.recording.path, f"{problem}; teach [joint] seam_in_base_mm on the part")
    return f"section_mm = {section.tolist()}"
