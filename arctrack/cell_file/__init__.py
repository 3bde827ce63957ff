"""The cell file: the choices for a cell, beside the facts that its setup holds."""

from arctrack.cell_file.choices import (
    BusChoice,
    CameraChoice,
    CaptureChoice,
    CellFile,
    CellJob,
    MonitorChoice,
    ProcessChoice,
)
from arctrack.cell_file.reader import is_cell_file, read_cell_file
from arctrack.cell_file.recorded import as_the_job_says, jobs_for

__all__ = [
    "BusChoice",
    "CameraChoice",
    "CaptureChoice",
    "CellFile",
    "CellJob",
    "MonitorChoice",
    "ProcessChoice",
    "as_the_job_says",
    "is_cell_file",
    "jobs_for",
    "read_cell_file",
]
