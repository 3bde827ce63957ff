"""A weld in a cell with a rendered camera: the torch follows the seam, and what came of it is measured.

An offset that was right at its capture is right for where the torch was then. It acts a lag L later, v L
farther on: on a seam of slope s the torch is off by s v L for good. A weave at frequency f that the poses put
t too late would come back in the offsets, 2 pi f t of its amplitude: so the weave itself is measured too.
"""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from arctrack.control.cell_file import CellJob
from arctrack.nominal import nominal_setup, with_profiler
from arctrack.offset_count import OffsetCount
from arctrack.simulation.cell.cell import BRIDGE_MM, Cell
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.weld.events import LOOP_EVENTS
from arctrack.simulation.cell.weld.rendered_camera import RenderedCamera
from arctrack.simulation.cell.world import World
from arctrack.simulation.programmed_path import ProgrammedPath
from arctrack.simulation.simulate import balance, true_values
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import section
from robot_io import BusMessage, GateReason, SeamOffset, TrackerStatus, Validity
from robot_io.clocks.lag import Lag
from tracker import flags
from tracker.state import OffsetLookAhead, Track

START_MM = 30.0
"""Start of the torch, base's x: in a valley of the nominal corrugation."""

SETTLED_TIME_CONSTANTS = 5.0
"""Time constants after which a step is followed to 1 %."""


@dataclass(frozen=True)
class LoopPlan:
    """Plan of a simulated weld.

    - `joint`, `material`: a joint of `arctrack.nominal.DIMENSIONS`, a material of the paper's Table 1.
    - `displaced_mm`, `slope`: displacement of the true seam to the left of the nominal one, mm, and its
      slope, mm per mm.
    - `bend_mm`, `bend_length_mm`: amplitude of an additional bend to the left, and its wave length.
    - `length_mm`: the torch's path; `weave_mm`, `weave_hz` its weave across; `rate_hz` the frame rate.
    - `looks_ahead`: the lag is estimated, and offsets are asked for where the torch will be once they act.
    - `event`: a name of `events.LOOP_EVENTS`.
    - `exact`: the truth is as the setup says; otherwise it is off by the setup's tolerances.
    - `size_px`: the image's width and height; every size has the same field of view.
    - `path`: `circle:RADIUS` or `corner:RADIUS`, mm, in place of a straight seam. The part then lies
      displaced as a whole: by `displaced_mm` to the left of the path's start, and as far along it.
    - `finds_first`: in a live run the robot stands without an arc and commands FIND before it welds.
    - `job`: a cell's job, whose passes follow each other; its joint is not used.
    - `profiles`: a laser profiler stands in the camera's place (`nominal.with_profiler`).
    """

    joint: str = "corrugation"
    material: str = "mild_steel"
    displaced_mm: float = 3.0
    slope: float = 0.0
    bend_mm: float = 0.0
    bend_length_mm: float = 120.0
    length_mm: float = 120.0
    speed_mm_s: float = 10.0
    weave_mm: float = 1.5
    weave_hz: float = 2.0
    rate_hz: float = 25.0
    seed: int = 1
    looks_ahead: bool = True
    event: str | None = None
    exact: bool = True
    size_px: tuple[int, int] = (640, 480)
    path: str | None = None
    finds_first: bool = False
    job: CellJob | None = None
    profiles: bool = False


@dataclass(frozen=True)
class Sample:
    """Torch and seam at a time: (y, z) relative to the nominal seam, mm, without the weave.

    `across_mm` is the torch's lateral position with its weave.
    """

    time_s: float
    station_mm: float
    torch_mm: tuple[float, float]
    seam_mm: tuple[float, float]
    across_mm: float


@dataclass(frozen=True)
class LoopFrame:
    """A frame of the run: its track, what was sent of it, and where the torch was then.

    `lag` is how late the robot follows, as it was known then, and `look_ahead` what was made of it.
    """

    track: Track
    offset: SeamOffset
    reason: GateReason
    sample: Sample
    lag: Lag
    look_ahead: OffsetLookAhead


@dataclass(frozen=True)
class EventResult:
    """Consequences of an event.

    `validities` and `reasons` count the frames during the event, by validity and by each reason but NONE.
    `torch_off_mm` is the torch's largest distance from the seam from its begin on. `valid_again_s` is the
    time from its end until offsets were VALID and the soft start over; infinite if they never were.
    """

    name: str
    begin_s: float
    end_s: float
    validities: dict[str, int]
    reasons: dict[str, int]
    torch_off_mm: float
    valid_again_s: float


@dataclass(frozen=True)
class ClosedLoopResult:
    """Result of a run; errors are those after lock, NaN where it never locked.

    From `lock_s` on the torch follows: the soft start is over, the torch stands on what was measured of the
    seam, and the robot has had the time to follow. `rms_mm` and `max_mm` are of the torch's distance from the
    seam. `offsets` counts those sent, of those that the robot wanted; `reasons` frames by each reason but
    NONE. `lag` is the robot's from a capture on, as estimated at the end. `weave_mm` is the executed weave's
    amplitude, by least squares at the weave's frequency.
    """

    lock_s: float
    rms_mm: float
    max_mm: float
    rms_y_mm: float
    rms_z_mm: float
    offsets: OffsetCount
    reasons: dict[str, int]
    lag: Lag
    weave_mm: float


@dataclass
class ClosedLoop:
    """Run under way: `frames` are the tracks and what was sent, `samples` torch and seam every SAMPLE_S."""

    plan: LoopPlan
    frames: list[LoopFrame] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)
    _on_frame: Callable[[int], None] | None = None

    def __post_init__(self) -> None:
        plan = self.plan
        self.setup = setup_of(plan)
        draw_true, draw_images, draw_cell = (np.random.default_rng([plan.seed, n]) for n in range(3))
        true_setup = self.setup if plan.exact else true_values(self.setup, draw_true)

        def make_camera(robot: Robot) -> RenderedCamera:
            self.camera = RenderedCamera(robot, self.setup, true_setup, draw_images, job=plan.job)
            return self.camera

        sees = plan.job is None or plan.job.again is None or plan.job.again.laser
        self.cell = Cell(
            world_of(plan, self.setup),
            draw_cell,
            make_camera,
            1.0 / plan.rate_hz,
            BRIDGE_MM if sees else None,
        )
        self.event_s = self._plan_event()
        self.duration_s = plan.length_mm / plan.speed_mm_s
        if self.event_s is not None:
            self.duration_s = max(self.duration_s, self.event_s[1] + 5.0)
        self.cell.tracker.poses.looks_ahead = plan.looks_ahead
        self.cell.tracker.on_track = self._on_track
        self.cell.scheduler.every(0.01, self._sample, 0.0007)

    def run(self, on_frame: Callable[[int], None] | None = None) -> ClosedLoopResult:
        """Run to the end, and return the result; `on_frame` is called with the number of frames done."""
        self._on_frame = on_frame
        self.cell.run(self.duration_s)
        return self.result()

    def result(self) -> ClosedLoopResult:
        """Return the result of the run so far."""
        lock_s = self.lock_s()
        locked = [sample for sample in self.samples if sample.time_s >= lock_s]
        valid = [frame.offset.validity is Validity.VALID for frame in self.frames]
        reasons = _reasons(self.frames)
        offsets = OffsetCount.of(sum(valid), len(valid), reasons)
        lag = self.cell.tracker.poses.look_ahead.lag
        if not locked:
            return ClosedLoopResult(lock_s, *(math.nan,) * 4, offsets, reasons, lag, math.nan)
        off = np.array([np.subtract(sample.torch_mm, sample.seam_mm) for sample in locked])
        distance = np.hypot(off[:, 0], off[:, 1])
        rms_y_mm, rms_z_mm = np.sqrt((off**2).mean(axis=0)).tolist()
        return ClosedLoopResult(
            lock_s=lock_s,
            rms_mm=float(np.sqrt((distance**2).mean())),
            max_mm=float(distance.max()),
            rms_y_mm=rms_y_mm,
            rms_z_mm=rms_z_mm,
            offsets=offsets,
            reasons=reasons,
            lag=lag,
            weave_mm=_weave_mm(locked, self.plan.weave_hz),
        )

    def event_result(self) -> EventResult | None:
        """Return the event's outcome, None without one."""
        if self.event_s is None:
            return None
        begin_s, end_s = self.event_s
        during = [frame for frame in self.frames if begin_s <= frame.sample.time_s < end_s]
        off_mm = [
            math.dist(sample.torch_mm, sample.seam_mm) for sample in self.samples if sample.time_s >= begin_s
        ]
        again_s = (
            frame.sample.time_s - end_s
            for frame in self.frames
            if frame.sample.time_s >= end_s
            and frame.offset.validity is Validity.VALID
            and frame.reason is GateReason.NONE
        )
        return EventResult(
            name=LOOP_EVENTS[self.plan.event or ""].name,
            begin_s=begin_s,
            end_s=end_s,
            validities=dict(Counter(frame.offset.validity.name for frame in during)),
            reasons=_reasons(during),
            torch_off_mm=max(off_mm, default=math.nan),
            valid_again_s=next(again_s, math.inf),
        )

    def _plan_event(self) -> tuple[float, float] | None:
        """Let the plan's event begin and end in its time, and return its times, s."""
        if self.plan.event is None:
            return None
        kind = LOOP_EVENTS[self.plan.event]
        begin_s = 0.0 if kind.from_start else 6.0
        end_s = begin_s + kind.lasts_s(self.cell.world)
        draw = np.random.default_rng([self.plan.seed, 3])

        def begin() -> None:
            self.cell.scheduler.at(end_s, kind.begin(self.cell, draw))

        self.cell.scheduler.at(begin_s, begin)
        return begin_s, end_s

    def lock_s(self) -> float:
        """Return from when on the torch follows, s; infinite if it never does."""
        world = self.cell.world
        follows_s = world.latency_s + SETTLED_TIME_CONSTANTS * world.time_constant_s
        for frame in self.frames:
            is_measured = not frame.track.flags & flags.OFFSET_EXTRAPOLATED.mask
            if frame.offset.validity is Validity.VALID and frame.reason is GateReason.NONE and is_measured:
                return frame.track.timestamp_s + follows_s
        return math.inf

    def _on_track(self, track: Track, messages: list[BusMessage]) -> None:
        offset = next(m for m in messages if isinstance(m, SeamOffset))
        status = next(m for m in messages if isinstance(m, TrackerStatus))
        # What is kept of a run is small: its stripes are not.
        track = replace(track, stripe=None, checks=())
        tracker = self.cell.tracker
        lag, look_ahead = tracker.poses.look_ahead.lag, tracker.service.look_ahead
        frame = LoopFrame(track, offset, status.gate_reason, self._now(), lag, look_ahead)
        self.frames.append(frame)
        if self._on_frame is not None:
            self._on_frame(len(self.frames))

    def _sample(self) -> None:
        self.samples.append(self._now())

    def _now(self) -> Sample:
        robot, world = self.cell.robot.robot, self.cell.world
        robot.advance(self.cell.scheduler.now_s)
        y_mm, z_mm = robot.offset_mm.tolist()
        seam_mm = world.seam_mm(robot.station_mm)
        return Sample(robot.now_s, robot.station_mm, (y_mm, z_mm), seam_mm, robot.lateral_mm())


def setup_of(plan: LoopPlan) -> Setup:
    """Return the setup that the tracker knows; its seam begins where the torch does."""
    width, height = plan.size_px
    nominal = nominal_setup(plan.joint, plan.material, width=width, height=height)
    setup = with_profiler(nominal) if plan.profiles else balance(nominal)
    if plan.path is not None:
        return replace(setup, joint=ProgrammedPath.of(plan.path, setup).taken_by(setup.joint))
    points = ((START_MM, 0.0, 0.0), (START_MM + plan.length_mm + 100.0, 0.0, 0.0))
    return replace(setup, joint=replace(setup.joint, seam_in_base_mm=points))


def world_of(plan: LoopPlan, setup: Setup) -> World:
    """Return the world of a plan: the true seam relative to the nominal one, and the robot."""
    height_mm, width_mm, pitch_mm = section(setup.joint).corrugation.tolist()
    straight = World(
        start_base_mm=(START_MM, 0.0, 0.0),
        speed_mm_s=plan.speed_mm_s,
        weave_mm=plan.weave_mm,
        weave_hz=plan.weave_hz,
        turned_deg=(0.0, 0.0, 0.0),
        displaced_mm=(plan.displaced_mm, 0.0),
        slope=(plan.slope, 0.0),
        bend_mm=plan.bend_mm,
        bend_length_mm=plan.bend_length_mm,
        latency_s=0.08,
        time_constant_s=0.08,
        length_mm=plan.length_mm + 100.0,
        corrugation=(height_mm, width_mm, pitch_mm),
    )
    if plan.path is None:
        return straight
    return replace(
        straight,
        start_base_mm=(0.0, 0.0, 0.0),
        displaced_mm=(0.0, 0.0),
        course=ProgrammedPath.of(plan.path, setup),
        part_mm=(plan.displaced_mm, plan.displaced_mm, 0.0),
    )


def _reasons(frames: list[LoopFrame]) -> dict[str, int]:
    """Return the number of frames with each reason but NONE."""
    return dict(Counter(frame.reason.name for frame in frames if frame.reason is not GateReason.NONE))


def _weave_mm(samples: list[Sample], weave_hz: float) -> float:
    """Return the weave's amplitude about the seam, mm."""
    times_s: Float64 = np.array([sample.time_s for sample in samples])
    across_mm = np.array([sample.across_mm - sample.seam_mm[0] for sample in samples])
    phase = 2.0 * math.pi * weave_hz * times_s
    columns = np.column_stack([np.sin(phase), np.cos(phase), np.ones_like(phase)])
    (sine, cosine, _), *_ = np.linalg.lstsq(columns, across_mm, rcond=None)
    return math.hypot(sine, cosine)
