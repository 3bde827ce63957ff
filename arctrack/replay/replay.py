"""A recording through the tracker: offsets onto the bus, results, pictures.

Replay drives the tracking service of the live run with recorded frames and poses. Results go to disk frame by
frame; a frame that cannot be read becomes a row with its flag, and the tracking goes on.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from arctrack.compiling import compiled_by_two
from arctrack.control.cell_file import CellFile
from arctrack.control.pose_watch import Doubt
from arctrack.control.recorded_job import RecordedJob, recorded_job, with_job
from arctrack.control.robot_messages import TRUSTED
from arctrack.control.tracking_service import TrackingService
from arctrack.end_signals import ends_at_safe_points
from arctrack.errors import ArctrackError
from arctrack.output import make_folder
from arctrack.printable import printable
from arctrack.recording import BadFrame, Recording, Truth, read_truth
from arctrack.recording.ahead import read_ahead
from arctrack.recording.results import (
    BUS_LOG,
    FILES,
    NO_ARC_HEIGHT,
    Latency,
    ResultsWriter,
    Summary,
    count_flags,
)
from arctrack.recording.run_offsets import RunComparison, read_run_offsets
from arctrack.recording.score import score
from arctrack.replay.arc_height import ArcHeightEstimator, arc_above_surface
from arctrack.replay.pages.drawing import drawing_on
from arctrack.replay.pages.drawing_spool import ReplayedFrame, SeenFile
from arctrack.replay.replay_clock import RealTime, RecordingTime
from arctrack.replay.replay_loop import replay_frames, replay_without_bus
from robot_io import BusLogError, Link, LinkError, Source, Verdict
from robot_io.poses.pose_questions import Implausibility
from tracker import flags
from tracker.state import Frame, Track
from tracker.warm_up import OnCompiled, WarmUp

if TYPE_CHECKING:
    from arctrack.replay.pages.pictures import ReplayPictures

VIRTUAL = "virtual"
"""python-can's bus inside the process, which no robot hears."""

DEFAULT_BUS = f"{VIRTUAL}:arctrack"
RESULTS_FOLDER = "results"


@dataclass(frozen=True)
class ReplayOptions:
    """Options of a replay.

    Parameters
    ----------
    bus : str, optional
        python-can's interface and channel, joined by a colon; by default the cell's, else `virtual:arctrack`.
    use_arc_map : bool
        False reads the stripe over a local median with one variance for all pixels.
    pictures : bool
        False writes no video, pictures or page.
    exports : tuple of str
        Files to write beside the others: `replay.mcap`, `replay.rrd`.
    cell : CellFile, optional
        The choices for a cell: bus, limits, jobs. A bus that is stated beside it goes before.
    job_number : int, optional
        Which of the cell's jobs the recording's seam is; by default the only one.
    onto_a_robot : bool
        Whether a bus beyond this process is meant: without it no bus but `virtual` is joined.
    """

    bus: str | None = None
    use_arc_map: bool = True
    pictures: bool = True
    exports: tuple[str, ...] = ()
    cell: CellFile | None = None
    job_number: int | None = None
    onto_a_robot: bool = False

    @property
    def chosen_bus(self) -> str:
        """The bus that is meant."""
        if self.bus is not None:
            return self.bus
        return DEFAULT_BUS if self.cell is None or self.cell.bus.is_port else str(self.cell.bus)


@dataclass(frozen=True)
class Replay:
    """Result of a replay; the tracks are without their stripes, `warnings` one line each."""

    recording: Recording
    folder: Path
    summary: Summary
    tracks: tuple[Track, ...]
    bad_frames: tuple[BadFrame, ...]
    warnings: tuple[str, ...]
    warm_up: WarmUp

    def __repr__(self) -> str:
        return f"Replay({self.summary}; results in {printable(str(self.folder))})"

    @property
    def complaint(self) -> str | None:
        """One line on the frames that could not be read; None if all could."""
        of_the_others = f"their rows carry {flags.FRAME_UNREADABLE.name}, the others are in {self.folder}"
        return self.recording.complaint(self.bad_frames, of_the_others)


def replay_recording(
    recording: Recording,
    folder: Path | str | None = None,
    options: ReplayOptions | None = None,
    on_frame: Callable[[int], None] | None = None,
    on_drawn: Callable[[int], None] | None = None,
    on_compiled: OnCompiled | None = None,
    cores: int = 1,
) -> Replay:
    """Replay a recording, and write the results into a folder.

    Parameters
    ----------
    recording : Recording
        What `read_recording` returned.
    folder : Path or str, optional
        Where the files go; by default `results` in the recording's own folder.
    options : ReplayOptions, optional
        How to replay.
    on_frame : callable, optional
        Hears the number of frames done.
    on_drawn : callable, optional
        Hears the number of frames drawn after the last offset.
    on_compiled : callable, optional
        Hears what is compiled before the first frame.
    cores : int, optional
        How many cores there are for the pictures, once the last offset has gone out. Those of a long
        recording are drawn by processes on them, if there are several.

    Returns
    -------
    Replay
        The tracks, without their stripes, and a summary.

    Raises
    ------
    ArctrackError
        If folder, bus or truth.csv fails.
    TypeError
        For a path where the recording should be.
    """
    if not isinstance(recording, Recording):
        raise TypeError(
            f"a Recording is needed, not a {type(recording).__name__}: read_recording(path) is one"
        )
    options = options or ReplayOptions()
    folder = recording.path / RESULTS_FOLDER if folder is None else Path(folder)
    _check_bus(options)
    recording = with_job(recording, options.cell, options.job_number)
    # Nothing tracks by it, but nothing is sent before all that is needed in the end has been read.
    truth = read_truth(recording.path)
    make_folder(folder, ())
    if not (options.pictures or options.exports):
        job, warm_up = _warm(recording, options, on_compiled)
        return _replay(job, truth, folder, options, warm_up, None, on_frame)
    with drawing_on(recording, truth, folder, cores) as drawing:
        job, warm_up = _warm(recording, options, on_compiled)
        pictures = _load_pictures()(
            recording,
            truth,
            folder,
            use_arc_map=options.use_arc_map,
            drawing=drawing,
            pictures=options.pictures,
            exports=options.exports,
            on_drawn=on_drawn,
        )
        # From here to the last offset nobody draws: nothing slows the tracking.
        drawing.wait_ready()
        with pictures.after() as seen:
            return _replay(job, truth, folder, options, warm_up, seen, on_frame)


def _warm(
    recording: Recording, options: ReplayOptions, on_compiled: OnCompiled | None
) -> tuple[RecordedJob, WarmUp]:
    """Return a tracker that waits for no compiler, nor the recording for what decodes it.

    Compiling takes long: it comes before there is a bus that nobody reads meanwhile.
    """
    interface, _ = parse_bus(options.chosen_bus)
    has_robot = interface != VIRTUAL
    job = recorded_job(recording, options.cell, options.job_number, options.use_arc_map, has_robot)
    with compiled_by_two(recording.setup):
        warm_up = job.tracking.tracker.warm_up(on_compiled)
    # The first PNG compiles what decodes all.
    next(recording.frames(range(1)), None)
    return job, warm_up


def _replay(
    job: RecordedJob,
    truth: Truth | None,
    folder: Path,
    options: ReplayOptions,
    warm_up: WarmUp,
    seen: SeenFile | None,
    on_frame: Callable[[int], None] | None,
) -> Replay:
    """Replay onto the bus and keep what was seen, where someone draws it."""
    recording = job.recording
    interface, channel = parse_bus(options.chosen_bus)
    bit_rate_bit_s = None if options.cell is None else options.cell.bus.bit_rate_bit_s
    tracks: list[Track] = []
    compute_ms: list[float] = []
    doubts: list[Doubt | None] = []
    bad_frames: list[BadFrame] = []
    run_offsets, comparison = read_run_offsets(recording.path), RunComparison()
    started_s = time.monotonic()
    with ExitStack() as opened:
        check_interrupt = opened.enter_context(ends_at_safe_points())
        # Closed last: what reads may still wait for a disk, and no robot is to wait for it.
        frames = opened.enter_context(read_ahead(recording.frames()))
        opened.enter_context(_bus_errors())
        # The robot on the bus is a live one; what it hears is not, and is no other than it says.
        link = opened.enter_context(
            Link(
                interface,
                channel,
                bitrate_bit_s=bit_rate_bit_s,
                log_paths=(folder / BUS_LOG,),
                source=Source.REPLAY,
                trusted=TRUSTED,
            )
        )
        # Only now do an earlier run's files go: what was sent over a bus that is not there cannot be again.
        make_folder(folder, (name for name in FILES if name != BUS_LOG))
        results = opened.enter_context(ResultsWriter(folder))
        clock: RecordingTime | RealTime = RecordingTime(recording.rows, job.number)
        if interface != VIRTUAL:
            clock = RealTime(recording.rows, link, check_interrupt)
        service = TrackingService[Frame | None](
            job.controller, job.seam, lambda message: link.send(message, clock.logged_at_s()), clock.now_s
        )
        # However it ends, the robot is told that nothing holds any longer.
        opened.callback(service.close)
        # A robot on the bus waits for nothing but the offsets.
        is_timed = interface != VIRTUAL or recording.setup.profiler is not None
        heights = None if is_timed else ArcHeightEstimator(job.tracking.tracker.geometry)
        for row, frame, outcome in replay_frames(service, clock, recording.rows, frames):
            check_interrupt()
            tracked, sent = outcome.tracked, outcome.for_results()
            run = run_offsets.get(row.index)
            if run is not None:
                comparison.add(run, sent)
            arc = NO_ARC_HEIGHT
            if heights is not None:
                arc = arc_above_surface(heights, tracked.track, tracked.step)
            results.write(tracked.track, sent, tracked.took_ms, run, arc)
            doubts.append(outcome.pose_doubt)
            if seen is not None:
                seen.add(ReplayedFrame.of(outcome, run, arc[:2]))
            tracks.append(replace(tracked.track, stripe=None))
            compute_ms.append(tracked.took_ms)
            if isinstance(frame, BadFrame):
                bad_frames.append(frame)
            if on_frame is not None:
                on_frame(len(tracks))
    summary = replace(
        _summary(recording, truth, options.use_arc_map, tracks, compute_ms, time.monotonic() - started_s),
        offsets={verdict.value: job.controller.verdicts[verdict] for verdict in Verdict},
        refusals=job.refusals,
        pose_doubts=Counter(doubt.name.lower() for doubt in doubts if doubt is not None),
        heard_robot_status=job.poses.hears_robot,
        run_offsets=comparison if run_offsets else None,
    )
    summary.write(folder)
    warnings = (*clock.warnings(service), *bus_faults(link), *_pose_warnings(recording, doubts))
    if comparison.differences:
        warnings = (*warnings, str(comparison))
    return Replay(recording, folder, summary, tuple(tracks), tuple(bad_frames), warnings, warm_up)


def bus_faults(link: Link) -> tuple[str, ...]:
    """Return a line on the faults of a bus, if there were any."""
    faults = {fault.value: count for fault, count in link.faults.items() if count}
    if not faults:
        return ()
    counts = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in sorted(faults.items()))
    return (f"{link.interface}:{link.channel}: faults of the bus: {counts}",)


def _pose_warnings(recording: Recording, doubts: Sequence[Doubt | None]) -> Iterator[str]:
    """Yield a line for each doubt of the poses; that they have yet to show enough is none."""
    for doubt in dict.fromkeys(doubts):
        if doubt is None or doubt is Implausibility.UNPROVEN:
            continue
        count, first = doubts.count(doubt), recording.rows[doubts.index(doubt)].index
        yield (
            f"{recording.poses.path.name}: {doubt.value}: no offset is sent for {count} frames, "
            f"the first is {first}"
        )


def track_alone(
    recording: Recording, use_arc_map: bool, on_frame: Callable[[int], None] | None = None
) -> Summary:
    """Track a recording without bus, files and pictures, and return the numbers: for comparison."""
    truth = read_truth(recording.path)
    tracks: list[Track] = []
    compute_ms: list[float] = []
    job = recorded_job(recording, use_arc_map=use_arc_map)
    with compiled_by_two(recording.setup):
        job.tracking.tracker.warm_up()
    started_s = time.monotonic()
    for _, _, outcome in replay_without_bus(job, range(len(recording.rows))):
        tracks.append(replace(outcome.tracked.track, stripe=None))
        compute_ms.append(outcome.tracked.took_ms)
        if on_frame is not None:
            on_frame(len(tracks))
    return _summary(recording, truth, use_arc_map, tracks, compute_ms, time.monotonic() - started_s)


def parse_bus(text: str) -> tuple[str, str]:
    """Split `interface:channel`; ArctrackError if it is none."""
    interface, colon, channel = text.partition(":")
    if not (interface and colon and channel):
        raise ArctrackError(
            f"--bus {text!r}: give interface:channel, such as {DEFAULT_BUS} or socketcan:can0"
        )
    return interface, channel


def _check_bus(options: ReplayOptions) -> None:
    bus = options.chosen_bus
    interface, _ = parse_bus(bus)
    if interface != VIRTUAL and not options.onto_a_robot:
        raise ArctrackError(
            f"--bus {bus}: a replay moves what listens there; say --onto-a-robot if that is meant"
        )


def _summary(
    recording: Recording,
    truth: Truth | None,
    use_arc_map: bool,
    tracks: Sequence[Track],
    compute_ms: Sequence[float],
    elapsed_s: float,
) -> Summary:
    return Summary(
        recording=recording.name,
        use_arc_map=use_arc_map,
        frames=len(tracks),
        valid=sum(track.valid for track in tracks),
        laser_on=sum(row.laser_on for row in recording.rows),
        flags=count_flags(tracks),
        offsets={},
        refusals={},
        recorded_rate_hz=recording.frame_rate_hz,
        replayed_rate_hz=len(tracks) / elapsed_s,
        latency_ms=Latency.of(compute_ms),
        score=None if truth is None else score(tracks, truth, recording.setup.tolerance.seam_mm),
        joint_ends_mm=_joint_ends_mm(tracks),
    )


def _joint_ends_mm(tracks: Sequence[Track]) -> dict[str, tuple[float, float]]:
    """Return station and 1 sigma of the joint's start and end, where they were found."""
    ends_mm = [
        end
        for track in tracks
        for end in (("start", track.joint_start_mm), ("end", track.joint_end_mm))
        if math.isfinite(end[1][0])
    ]
    return dict(ends_mm)


def _load_pictures() -> type[ReplayPictures]:
    # Matplotlib takes a while to load: only those who want pictures wait for it.
    from arctrack.replay.pages.pictures import ReplayPictures

    return ReplayPictures


@contextmanager
def _bus_errors() -> Iterator[None]:
    try:
        yield
    except (LinkError, BusLogError) as error:
        raise ArctrackError(str(error)) from error
