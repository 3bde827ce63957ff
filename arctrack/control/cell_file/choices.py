"""What is chosen for a cell: bus, camera, limits, jobs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING

from arctrack.control.job import Bridging, Job, PartLimits
from arctrack.errors import ArctrackError, in_file

if TYPE_CHECKING:
    from arctrack.control.policy import ServicePolicy
    from arctrack.recording import SetupFile
    from noise_model.setup import Setup
    from noise_model.surface.joint import Joint
    from robot_io import GateLimits
    from robot_io.poses.plausibility_limits import PlausibilityLimits
    from tracker.seam.correction import Correction

DEEP = ("v_groove", "half_v")
"""The joints whose depth a track tells."""

MIN_TOKEN_LETTERS = 16
"""A shorter token can be guessed."""

HIGH_LOAD = 0.7
"""Above it messages of low priority wait for long, as for any bus of fixed priorities."""


@dataclass(frozen=True)
class BusChoice:
    """The bus: python-can's interface and channel, and the bit rate, bit/s."""

    interface: str
    channel: str
    bit_rate_bit_s: int

    def __str__(self) -> str:
        return f"{self.interface}:{self.channel}"


@dataclass(frozen=True)
class CaptureChoice:
    """How a camera takes frames that arctrack itself captures.

    Parameters
    ----------
    loop : bool
        Whether a file begins again at its end.
    rows : tuple (2,) or None
        The first row of the sensor that is read, and how many; None for the camera's own region.
    trigger : str
        What begins a frame: free, software or hardware.
    trigger_line : str or None
        The camera's line that triggers it.
    laser_line : str or None
        The camera's line that the laser hangs on; None where the camera has no hold on it.
    laser : str
        How the line drives it: strobe, during each exposure, or switch.
    interleave : int or None
        Each such frame is taken without the laser; None for none.
    exposure : str
        Whether the exposure is fixed, the setup's, or predicted.
    exposure_range_s : tuple (2,) or None
        The least and the largest exposure that may be predicted, s.
    """

    loop: bool = False
    rows: tuple[int, int] | None = None
    trigger: str = "free"
    trigger_line: str | None = None
    laser_line: str | None = None
    laser: str = "strobe"
    interleave: int | None = None
    exposure: str = "fixed"
    exposure_range_s: tuple[float, float] | None = None


KEYS_OF_KIND = {
    "shared_memory": ("exposure", "exposure_range_s"),
    "recording": (),
    "video": ("loop",),
    "folder": ("loop",),
    "device": (),
    "gige": (
        "rows",
        "trigger",
        "trigger_line",
        "laser_line",
        "laser",
        "interleave",
        "exposure",
        "exposure_range_s",
    ),
}
"""What may be stated beside kind, name and frame_rate_hz."""


@dataclass(frozen=True)
class CameraChoice:
    """The camera.

    Parameters
    ----------
    frame_rate_hz : float
        Its frames a second.
    kind : str or None
        What it is, such as shared_memory; None where nothing is run live.
    name : str or None
        Which one of its kind.
    capture : CaptureChoice
        How it takes frames.
    """

    frame_rate_hz: float
    kind: str | None = None
    name: str | None = None
    capture: CaptureChoice = CaptureChoice()


@dataclass(frozen=True)
class ProcessChoice:
    """How the process of a live run is scheduled; None leaves a thing to the machine.

    Parameters
    ----------
    priority : int or None
        Its real-time priority, 1 to 99.
    cpus : tuple of int or None
        The processors that it may run on.
    lock_memory : bool
        Whether its memory is kept from being swapped out.
    """

    priority: int | None = None
    cpus: tuple[int, ...] | None = None
    lock_memory: bool = False


@dataclass(frozen=True)
class BlackBoxChoice:
    """The black box of a live run.

    Parameters
    ----------
    seconds : float
        How far back it reaches, s; 0 for none.
    folder : str
        Where its recordings go, from the cell file on.
    """

    seconds: float = 30.0
    folder: str = "black_box"


@dataclass(frozen=True)
class MonitorChoice:
    """The monitor page of a live run.

    Parameters
    ----------
    host : str
        The address on which it is served.
    port : int
        Its port; 0 takes a free one.
    token : str or None
        What a browser must bring; None lets everybody on this machine look.
    enabled : bool
        Whether there is a page.

    Raises
    ------
    ValueError
        For a page that other machines reach without a token; it names the key.
    """

    host: str = "127.0.0.1"
    port: int = 8765
    token: str | None = field(default=None, repr=False)
    enabled: bool = True

    def __post_init__(self) -> None:
        if self.token is None and not is_loopback(self.host):
            raise ValueError(
                f"[monitor] token: missing; with host = {self.host!r} other machines reach the page: state a "
                f"secret of {MIN_TOKEN_LETTERS} letters or more, such as python3 -c 'import secrets; "
                f"print(secrets.token_urlsafe())' prints"
            )


def is_loopback(host: str) -> bool:
    """Say whether an address is reached from its own machine alone."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class CellJob:
    """A job of the cell file.

    Parameters
    ----------
    name : str
        What people call it.
    joint : Joint or None
        The joint, where it is not the setup's.
    correction : Correction
        How the seam is followed.
    offsets_in_search : bool
        Whether offsets go out while the robot commands SEARCH.
    part : PartLimits
        What the part must be like before the arc is lit.
    bridge_mm : float or None
        How far a stretch without a joint may reach, mm; None for without end.
    """

    name: str
    joint: Joint | None
    correction: Correction
    offsets_in_search: bool
    part: PartLimits
    bridge_mm: float | None

    def setup_for(self, setup: Setup) -> Setup:
        """Return a setup with the job's joint."""
        return setup if self.joint is None else replace(setup, joint=self.joint)

    def to_job(self, setup: Setup, limits: GateLimits) -> Job:
        """Return the job as the controller takes it.

        Parameters
        ----------
        setup : Setup
            The facts. Its joint counts where the job states none.
        limits : GateLimits
            What an offset must keep to.

        Raises
        ------
        ValueError
            For a depth that is asked of a joint whose depth no track tells; it names the key.
        """
        from arctrack.control.pose_watch import nominal_path

        setup = self.setup_for(setup)
        if self.part.depth_mm is not None and setup.joint.type not in DEEP:
            raise ValueError(
                f"[part] depth_mm: the depth of a {setup.joint.type} is not measured; leave it out, or "
                f"choose a joint of {', '.join(DEEP)}"
            )
        bridging = None
        if self.bridge_mm is not None:
            x_mm, y_mm, z_mm = setup.laser.point_mm.tolist()
            bridging = Bridging(nominal_path(setup.joint), (x_mm, y_mm, z_mm), self.bridge_mm)
        return Job(
            setup.joint.type,
            limits,
            self.correction,
            self.offsets_in_search,
            poses_proven=True,
            part=self.part,
            bridging=bridging,
        )


@dataclass(frozen=True)
class CellFile:
    """What a cell file holds.

    Parameters
    ----------
    path : Path
        The file.
    setup : SetupFile
        The facts that it points to.
    bus : BusChoice
        The bus.
    camera : CameraChoice
        The camera.
    limits : GateLimits
        What an offset must keep to.
    policy : ServicePolicy
        How long what was heard counts.
    plausibility : PlausibilityLimits
        What poses must keep to.
    jobs : mapping of int to CellJob
        The jobs, by the number by which the robot names them.
    process : ProcessChoice
        How a live run is scheduled.
    monitor : MonitorChoice
        The page of a live run.
    black_box : BlackBoxChoice
        What a live run keeps.
    """

    path: Path
    setup: SetupFile
    bus: BusChoice
    camera: CameraChoice
    limits: GateLimits
    policy: ServicePolicy
    plausibility: PlausibilityLimits
    jobs: Mapping[int, CellJob]
    process: ProcessChoice
    monitor: MonitorChoice
    black_box: BlackBoxChoice

    @property
    def bus_load(self) -> float:
        """The share of the bus that all messages take at most."""
        from robot_io.protocol.bus_load import load_share

        return load_share(self.camera.frame_rate_hz, self.bus.bit_rate_bit_s)

    def job_numbered(self, number: int | None) -> int:
        """Return a job's number: that which is asked for, or that of the only job.

        Raises ArctrackError where there is no such job, and where one of several must be named.
        """
        held = ", ".join(map(str, self.jobs))
        if number is None:
            if len(self.jobs) > 1:
                raise in_file(self.path, f"holds the jobs {held}; say --job and a number")
            return next(iter(self.jobs))
        if number not in self.jobs:
            raise ArctrackError(f"--job {number}: {self.path} holds the jobs {held}")
        return number
