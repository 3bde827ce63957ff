"""A live run of a cell file: what it needs is built and warmed up, then the loop has the process."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from arctrack.compiling import compiled_by_two
from arctrack.control.bus_poses import BusPoses
from arctrack.control.cell_file import CellFile
from arctrack.control.controller import Controller
from arctrack.control.find_responder import JointFinder
from arctrack.control.frame_tracking import FrameTracking
from arctrack.control.look_ahead import NOTHING_YET, LagEstimator
from arctrack.control.pose_watch import nominal_path
from arctrack.control.recorded_job import recorded_job, with_job
from arctrack.control.recorded_poses import seam_limits
from arctrack.control.robot_messages import TRUSTED
from arctrack.control.seam_passes import SeamPasses
from arctrack.control.tracking_service import SeamTracker
from arctrack.errors import ArctrackError, in_file
from arctrack.live.cameras.camera import CameraProtocol
from arctrack.live.cameras.recording import RecordingCamera
from arctrack.live.cameras.shared_frames import SharedFramesError
from arctrack.live.cameras.shared_memory import SharedMemoryCamera
from arctrack.live.journal.message_pipe import PipeClient, message_pipe
from arctrack.live.journal.ring import RingError
from arctrack.live.serve.captured_camera import CapturedCamera
from arctrack.live.serve.exposure import ExposureChooser
from arctrack.live.serve.find_process import FindClient, frames_ring
from arctrack.live.serve.journal_processes import JournalProcesses, open_journal
from arctrack.live.serve.lag_process import estimate_lags
from arctrack.live.serve.loop import LiveLoop, LiveSeam, LoopResult, OnTrack
from arctrack.live.serve.notify import Notifier
from arctrack.live.serve.process import Watchdog, garbage_left
from arctrack.live.serve.robot_port import OpenBus, port_process
from arctrack.live.serve.supervisor import SupervisedProcess, Supervisor, Tell
from arctrack.recording import read_recording
from noise_model.effects import pose_time_s
from noise_model.transforms import invert
from robot_io import Link, LinkError, Source


@dataclass(frozen=True)
class RunParts:
    """Parts of a run: a camera, and what answers its frames, the seams by the robot's job number."""

    camera: CameraProtocol
    controller: Controller
    seams: dict[int, LiveSeam]
    source: Source


@dataclass(frozen=True)
class LiveRun:
    """A loop that is ready to run, and its subprocesses; None where the cell requires none."""

    loop: LiveLoop
    journal: JournalProcesses | None


@contextmanager
def opened_run(
    cell: CellFile,
    tell: Tell,
    job_number: int | None = None,
    on_track: OnTrack | None = None,
    is_simulated: bool = False,
    **bus_options: Any,
) -> Iterator[LiveRun]:
    """Build a cell's loop and subprocesses, warm it up, and open its bus last; nothing is sent yet.

    `tell` is called from another thread with what happens to the subprocesses. `job_number` is the job of a
    recording's seam, by default the only one; a live robot names its job itself. `on_track` gets each track
    and the offset that was sent. With `is_simulated` the page says that robot and camera are simulated;
    `bus_options` go to python-can. Raises ArctrackError if the cell file states no camera, or camera or bus
    cannot be opened.
    """
    with ExitStack() as opened:
        supervisor = Supervisor(tell)
        lag_end, its_end = message_pipe()
        # Niceness of the estimate of the robot's lag: nobody waits for it.
        estimating = SupervisedProcess("lag", estimate_lags, (), (its_end,), 5, lost=NOTHING_YET)
        lag = opened.enter_context(supervisor.running(estimating))
        finder = opened.enter_context(_finder(cell))
        parts = run_parts(cell, job_number, PipeClient(lag_end), finder)
        opened.callback(parts.camera.close)
        if isinstance(parts.camera, CapturedCamera):
            opened.enter_context(supervisor.running(parts.camera.process))
        trackers = {number: seam.tracking.tracker for number, seam in parts.seams.items()}
        setups = {number: tracker.geometry.setup for number, tracker in trackers.items()}
        asked = [lag]
        if finder is not None:
            asked.append(opened.enter_context(supervisor.running(finder.started(setups))))
        journal = opened.enter_context(open_journal(cell, setups, supervisor, is_simulated))
        for tracker in trackers.values():
            with compiled_by_two(tracker.geometry.setup):
                tracker.warm_up()
        if finder is not None:
            finder.let_warm_up()
        open_bus = opened.enter_context(_robot_port(cell, supervisor))
        for process in asked:
            process.wait_ready()
        opened.enter_context(supervisor.watching())
        # Once it is on the bus, a tracker must not wait for anything.
        try:
            link = Link(
                cell.bus.interface,
                cell.bus.channel,
                bitrate_bit_s=cell.bus.bit_rate_bit_s,
                source=parts.source,
                trusted=TRUSTED,
                open_bus=open_bus,
                **bus_options,
            )
        except LinkError as error:
            raise in_file(cell.path, f"[bus] {error}") from error
        opened.callback(link.close)
        journal_writer = None if journal is None else journal.writer
        for seam in parts.seams.values():
            if journal_writer is not None and isinstance(seam.poses, BusPoses):
                seam.poses.on_sample = journal_writer.on_pose
        range_s = cell.camera.capture.exposure_range_s
        loop = LiveLoop(
            parts.camera,
            link,
            parts.controller,
            parts.seams,
            parts.source,
            on_track,
            journal_writer,
            exposure=None if range_s is None else ExposureChooser(range_s, cell.camera.frame_rate_hz),
        )
        yield LiveRun(loop, journal)


@contextmanager
def _finder(cell: CellFile) -> Iterator[FindClient | None]:
    """Yield what answers a live robot's FIND, None for a recording's."""
    if cell.camera.kind == "recording":
        yield None
        return
    run = str(os.getpid())
    try:
        ring = frames_ring(run, cell.setup.setup)
    except RingError as error:
        raise in_file(cell.path, f"[camera] frames of a FIND: {error}") from None
    with ring:
        yield FindClient(run, ring)


@contextmanager
def _robot_port(cell: CellFile, supervisor: Supervisor) -> Iterator[OpenBus | None]:
    """Run the port of a cell's robot meanwhile, and yield what opens its bus; None for a robot on CAN."""
    if not cell.bus.is_port:
        yield None
        return
    process, open_bus = port_process(cell.bus, cell.process)
    with supervisor.running(process):
        try:
            process.wait_ready()
        except ArctrackError as error:
            raise in_file(cell.path, str(error)) from None
        yield open_bus


def run(
    loop: LiveLoop, goes_on: Callable[[], bool], watchdog_s: float, notifier: Notifier | None = None
) -> LoopResult:
    """Run a loop in this process while `goes_on`, some hundred calls a second; its last offset is REFUSED.

    A turn that takes longer than `watchdog_s` ends the process. `notifier` tells the service manager.
    """
    with garbage_left(), Watchdog(watchdog_s) as watchdog:
        loop.camera.begin()
        try:
            while goes_on() and not loop.is_over:
                loop.turn()
                watchdog.feed()
                if notifier is not None:
                    notifier.goes_on()
        finally:
            loop.close()
    return loop.result()


def run_parts(
    cell: CellFile,
    job_number: int | None = None,
    lag_estimator: LagEstimator | None = None,
    finder: JointFinder | None = None,
) -> RunParts:
    """Return a cell file's camera, and what answers its frames; see `BusPoses` of the estimator.

    `finder` answers the FIND of a live robot.

    Raises ArctrackError if the file states none, if it cannot be opened, if a job's stripe is not in view, or
    its weld schedule is wrong, or its seam cannot be kept.
    """
    camera = cell.camera
    if camera.kind is None or camera.name is None:
        raise in_file(
            cell.path, "[camera] kind: missing; state kind and name, such as shared_memory and cell"
        )
    if camera.kind == "recording":
        recording = read_recording(cell.path.parent / camera.name, cell.setup.path)
        recording = with_job(recording, cell, job_number)
        played = recorded_job(recording, cell, job_number, has_robot=True)
        assert played.number is not None
        seams = {played.number: played.seam}
        return RunParts(RecordingCamera(recording), played.controller, seams, Source.REPLAY)
    if job_number is not None:
        raise ArctrackError(f"--job {job_number}: a live robot names its job itself; leave it out")
    return _live(cell, camera.name, lag_estimator, finder)


def _live(
    cell: CellFile, frames: str, lag_estimator: LagEstimator | None, finder: JointFinder | None
) -> RunParts:
    """Return the camera of a name, and what answers a live robot."""
    setup_file = cell.setup
    jobs = {number: job.to_job(setup_file.setup, cell.limits) for number, job in cell.jobs.items()}
    controller = Controller(jobs, Source.LIVE, cell.policy, finder)
    T_tool_controllertool = setup_file.T_tool_controllertool
    T_controllertool_tool = np.eye(4) if T_tool_controllertool is None else invert(T_tool_controllertool)
    seams: dict[int, LiveSeam] = {}
    for number, job in cell.jobs.items():
        setup = job.setup_for(setup_file.setup)
        poses = BusPoses(
            nominal_path(setup.joint),
            cell.plausibility,
            seam_limits(cell.camera.frame_rate_hz),
            cell.policy,
            T_controllertool_tool,
            pose_time_s(setup, 0.0),
            lag_estimator=lag_estimator,
        )
        make_passes = partial(SeamPasses, job, is_live=True)
        try:
            tracking = FrameTracking(setup, job.correction, make_passes=make_passes)
            seams[number] = SeamTracker(poses, tracking)
        except ValueError as error:
            raise in_file(setup_file.path, str(error)) from error
    if cell.camera.kind != "shared_memory":
        camera: SharedMemoryCamera = CapturedCamera(cell.camera, cell.path, setup_file.setup)
        return RunParts(camera, controller, seams, Source.LIVE)
    try:
        camera = SharedMemoryCamera(frames, setup_file.setup)
    except SharedFramesError as error:
        raise in_file(
            cell.path, f"[camera] name: {error}; start what publishes them first, as the same user"
        ) from None
    return RunParts(camera, controller, seams, Source.LIVE)
