"""What a monitor page needs to know of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from arctrack.control.cell_file import CellFile
from noise_model.setup import Setup


@dataclass(frozen=True)
class MonitorOptions:
    """What a monitor page needs to know of a run.

    Parameters
    ----------
    journal : str
        The run's name.
    setups : mapping of int to Setup
        The setup of each job, by the job's number; one at least.
    host : str
        The address on which the page is served.
    port : int
        Its port; 0 takes a free one.
    token : str or None
        What a browser must bring; None lets everybody look who reaches the address.
    title : str
        What the run is, such as its cell file and its camera.
    job_names : mapping of int to str
        What people call the jobs.
    is_simulated : bool
        Whether robot and camera are simulated.
    """

    journal: str
    setups: Mapping[int, Setup]
    host: str = "127.0.0.1"
    port: int = 0
    token: str | None = field(default=None, repr=False)
    title: str = ""
    job_names: Mapping[int, str] = field(default_factory=dict)
    is_simulated: bool = False


def options_of(cell: CellFile, journal: str, is_simulated: bool = False) -> MonitorOptions:
    """Return what the page of a cell's run needs; a simulated cell takes any free port."""
    camera = cell.camera
    return MonitorOptions(
        journal=journal,
        setups={number: job.setup_for(cell.setup.setup) for number, job in cell.jobs.items()},
        host=cell.monitor.host,
        port=0 if is_simulated else cell.monitor.port,
        token=cell.monitor.token,
        title=f"{cell.path}, {camera.kind} {camera.name}",
        job_names={number: job.name for number, job in cell.jobs.items()},
        is_simulated=is_simulated,
    )
