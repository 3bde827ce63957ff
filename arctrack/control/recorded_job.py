"""A recording as a job: the controller, poses and tracker that answer its frames."""

from dataclasses import dataclass, replace
from functools import partial

from arctrack.control.cell_file import CellFile
from arctrack.control.controller import Controller
from arctrack.control.frame_tracking import FrameTracking
from arctrack.control.job import Job
from arctrack.control.recorded_poses import RecordedPoses
from arctrack.control.seam_passes import SeamPasses
from arctrack.control.tracking_service import SeamTracker
from arctrack.errors import ArctrackError, in_file
from arctrack.recording import Recording
from arctrack.recording.reader import fitted
from robot_io import Source


@dataclass(frozen=True)
class RecordedJob:
    """Controller that answers a recording's frames; `number` is the job's, None without a cell."""

    recording: Recording
    number: int | None
    controller: Controller
    poses: RecordedPoses
    tracking: FrameTracking

    @property
    def seam(self) -> SeamTracker[FrameTracking]:
        """The recording's seam."""
        return SeamTracker(self.poses, self.tracking)

    @property
    def refusals(self) -> dict[str, int]:
        """Number of offsets that were held or refused, by reason."""
        return {reason.name.lower(): count for reason, count in sorted(self.controller.reasons.items())}


def with_job(recording: Recording, cell: CellFile | None, number: int | None) -> Recording:
    """Return a recording with the joint and the correction of a cell's job; as it is where there is no cell.

    Raises ArctrackError for a job that there is not, and for a joint that runs against the travel.
    """
    if cell is None:
        if number is not None:
            raise ArctrackError(f"--job {number}: a cell file holds the jobs; say --cell too")
        return recording
    job = cell.jobs[cell.job_numbered(number)]
    chosen = replace(recording, setup=job.setup_for(recording.setup), correction=job.correction)
    # What the reader warned of is the same; another seam line may run against the travel.
    return replace(fitted(chosen), warnings=recording.warnings)


def recorded_job(
    recording: Recording,
    cell: CellFile | None = None,
    job_number: int | None = None,
    use_arc_map: bool = True,
    has_robot: bool = False,
) -> RecordedJob:
    """Return what answers the frames of a recording; see `with_job` of a cell's job.

    Of a cell's jobs it is one alone: a robot that names another is refused. With `has_robot` a live robot
    listens. Raises ArctrackError if the setup's stripe is not in view.
    """
    number = None if cell is None else cell.job_numbered(job_number)
    try:
        tracking = FrameTracking(
            recording.setup,
            recording.correction,
            use_arc_map,
            None if cell is None or number is None else partial(SeamPasses, cell.jobs[number]),
        )
    except ValueError as error:
        raise in_file(recording.setup_path, str(error)) from error
    if recording.steps is not None:
        tracking.tracker.state = recording.steps.state
    if cell is None or number is None:
        job = Job(recording.setup.joint.type, correction=recording.correction, poses_proven=True)
        controller, poses = Controller(job, Source.REPLAY), RecordedPoses(recording, has_robot=has_robot)
    else:
        jobs = {number: cell.jobs[number].to_job(recording.setup, cell.limits)}
        controller = Controller(jobs, Source.REPLAY, cell.policy)
        poses = RecordedPoses(recording, cell.plausibility, cell.policy, has_robot)
    poses.on_begin = tracking.begin
    return RecordedJob(recording, number, controller, poses, tracking)
