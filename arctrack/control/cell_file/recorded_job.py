"""A recording as a job of a cell: with its joint and its correction."""

from __future__ import annotations

from dataclasses import replace

from arctrack.control.cell_file.choices import CellFile
from arctrack.control.job import Job
from arctrack.errors import ArctrackError
from arctrack.recording import Recording
from arctrack.recording.reader import fitted


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


def jobs_for(
    recording: Recording, cell: CellFile | None, number: int | None
) -> tuple[int | None, Job | dict[int, Job]]:
    """Return the number and the job by which a controller replays a recording.

    Of a cell's jobs it is one alone: a robot that names another is refused.
    """
    if cell is None:
        return None, Job(recording.setup.joint.type, correction=recording.correction, poses_proven=True)
    number = cell.job_numbered(number)
    return number, {number: cell.jobs[number].to_job(recording.setup, cell.limits)}
