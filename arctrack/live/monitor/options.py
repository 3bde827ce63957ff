"""Options of a monitor page, and of a run's MCAP file."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from arctrack.control.cell_file import CellFile
from arctrack.live.black_box.recorder import JobSetup
from noise_model.setup import Setup


@dataclass(frozen=True)
class MonitorOptions:
    """Options of a monitor page.

    `journal` is the run's name, `setups` has at least one setup by job number. Port 0 takes a free one;
    without a `token` everybody may look who reaches `host`. `title` tells the run, such as its cell file and
    camera.
    """

    journal: str
    setups: Mapping[int, Setup]
    host: str = "127.0.0.1"
    port: int = 0
    token: str | None = field(default=None, repr=False)
    title: str = ""
    job_names: Mapping[int, str] = field(default_factory=dict)
    is_simulated: bool = False


@dataclass(frozen=True)
class McapOptions:
    """Options of a run's MCAP file: the run's name, the folder of the file, and each job's setup."""

    run: str
    folder: Path
    jobs: Mapping[int, JobSetup]


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
