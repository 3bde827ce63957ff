"""Choices for a cell: bus, camera, limits, jobs."""

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
    from tracker.seam.correction import AxisCorrection, Correction

DEEP = ("v_groove", "half_v")
"""The joints whose depth a track tells."""

MIN_TOKEN_LETTERS = 16
"""A shorter token can be guessed."""

HIGH_LOAD = 0.7
"""Above it messages of low priority wait for long, as for any bus of fixed priorities."""


PORT_NAMES = ("tcp_json", "egm", "rsi", "rtde")
"""Interfaces that are robots' protocols: `robot_io.ports`."""


@dataclass(frozen=True)
class BusChoice:
    """The bus: python-can's interface and channel, and the bit rate, bit/s; or a robot's port.

    `running_word` stands for the program's word where an EGM controller sends none. Raises ValueError, which
    names the key, for what a port cannot use.
    """

    interface: str
    channel: str
    bit_rate_bit_s: int
    running_word: int | None = None

    def __post_init__(self) -> None:
        if self.running_word is not None and self.interface != "egm":
            raise ValueError("[bus] running_word: is of interface egm alone; leave it out")
        if self.is_port:
            from robot_io.ports.port import address_of
            from robot_io.ports.report import PortError, ProgramWord

            try:
                address_of(self.interface, self.channel)
            except PortError as error:
                raise ValueError(f"[bus] {error}") from None
            try:
                ProgramWord(self.running_word or 0)
            except PortError as error:
                _, _, bits = str(error).partition(": ")
                raise ValueError(f"[bus] running_word = {self.running_word}: {bits}") from None

    @property
    def is_port(self) -> bool:
        """True for a robot's own protocol in place of CAN."""
        return self.interface in PORT_NAMES

    def __str__(self) -> str:
        return f"{self.interface}:{self.channel}"


@dataclass(frozen=True)
class CaptureChoice:
    """Capture of a camera's frames by arctrack, as [camera] states it; None for what it lacks."""

    loop: bool = False
    rows: tuple[int, int] | None = None
    trigger: str = "free"
    trigger_line: str | None = None
    laser_line: str | None = None
    laser: str = "strobe"
    interleave: int | None = None
    exposure: str = "fixed"
    exposure_range_s: tuple[float, float] | None = None


@dataclass(frozen=True)
class CameraChoice:
    """The camera, as [camera] states; kind and name are None where nothing is run live."""

    frame_rate_hz: float
    kind: str | None = None
    name: str | None = None
    capture: CaptureChoice = CaptureChoice()


@dataclass(frozen=True)
class ProcessChoice:
    """Scheduling of a live run's process, as [process] states it; None leaves it to the machine."""

    priority: int | None = None
    cpus: tuple[int, ...] | None = None
    lock_memory: bool = False


@dataclass(frozen=True)
class BlackBoxChoice:
    """The black box of a live run, as [black_box] states."""

    seconds: float = 30.0
    folder: str = "black_box"


@dataclass(frozen=True)
class McapChoice:
    """The MCAP files of live runs, as [mcap] states; None for none."""

    folder: str | None = None


@dataclass(frozen=True)
class MonitorChoice:
    """The monitor page of a live run, as [monitor] states.

    Raises ValueError, which names the key, for a page that other machines reach without a token.
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
    """Return True if an address is reached from its own machine alone."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


SYMMETRIC = ("v_groove", "u_groove", "butt", "edge", "outside_corner", "flat")
"""The joints that look the same from either end."""


@dataclass(frozen=True)
class AgainChoice:
    """The earlier pass that a job follows again, as [jobs.N.again] states.

    Raises ValueError, which names the key, for a sigma that is negative and an age that is not above 0.
    """

    seam: Path
    side_mm: float = 0.0
    height_mm: float = 0.0
    tilt_deg: float = 0.0
    reverse: bool = False
    laser: bool = True
    sigma_mm: float = 0.05
    max_age_s: float = 3600.0

    def __post_init__(self) -> None:
        if not self.sigma_mm >= 0.0:
            raise ValueError(f"[again] sigma_mm = {self.sigma_mm}: must be >= 0")
        if not self.max_age_s > 0.0:
            raise ValueError(f"[again] max_age_s = {self.max_age_s}: must be > 0")

    def displaced(self, correction: Correction) -> Correction:
        """Return a correction that leads onto the pass; ValueError where a limit of it is smaller."""
        y = _biased(correction.y, "y", "side_mm", self.side_mm)
        z = _biased(correction.z, "z", "height_mm", self.height_mm)
        return replace(correction, y=y, z=z)


def _biased(axis: AxisCorrection, name: str, key: str, aside_mm: float) -> AxisCorrection:
    """Return an axis that leads farther to one side; ValueError names the pass's key."""
    try:
        return replace(axis, bias_mm=axis.bias_mm + aside_mm)
    except ValueError as error:
        raise ValueError(f"[again] {key} = {aside_mm}: [follow.{name}] {error}") from None


@dataclass(frozen=True)
class CellJob:
    """A job of the cell file, as [jobs.N] states; `joint` is None where it is the setup's.

    `correction` includes how far the pass lies off the one that it follows again.
    """

    name: str
    joint: Joint | None
    correction: Correction
    offsets_in_search: bool
    part: PartLimits
    bridge_mm: float | None
    keep_seam: Path | None = None
    schedule: Path | None = None
    again: AgainChoice | None = None

    def setup_for(self, setup: Setup) -> Setup:
        """Return a setup with the job's joint, its seam along the job's own travel."""
        joint = setup.joint if self.joint is None else self.joint
        if self.again is not None and self.again.reverse:
            normals = joint.surface_normals_in_base
            joint = replace(
                joint,
                seam_in_base_mm=joint.seam_in_base_mm[::-1],
                surface_normals_in_base=None if normals is None else normals[::-1],
            )
        return setup if joint is setup.joint else replace(setup, joint=joint)

    def _check_again(self, again: AgainChoice, joint: Joint, limits: GateLimits) -> None:
        """Raise ValueError, which names the key, for a pass that this job cannot follow."""
        if again.reverse and again.laser and joint.type not in SYMMETRIC:
            raise ValueError(
                f"[again] reverse: from the other end a {joint.type} has its sides changed; "
                "state laser = false, or a joint of " + ", ".join(SYMMETRIC)
            )
        if self.keep_seam == again.seam:
            raise ValueError("keep_seam: is the seam that the job follows; name another file")
        if not again.laser:
            for key, is_stated in (
                ("[part]", self.part.required),
                ("bridge_mm", self.bridge_mm is not None),
                ("keep_seam", self.keep_seam is not None),
            ):
                if is_stated:
                    raise ValueError(f"{key}: without the laser nothing is measured; leave it out")
        for key, aside_mm, range_key, range_mm in (
            ("side_mm", self.correction.y.bias_mm, "range_y_mm", limits.range_y_mm),
            ("height_mm", self.correction.z.bias_mm, "range_z_mm", limits.range_z_mm),
        ):
            if not abs(aside_mm) < range_mm:
                raise ValueError(
                    f"[again] {key}: displaces the pass by {aside_mm:g} mm, [gate] {range_key} lets "
                    f"{range_mm:g} out; raise it"
                )

    def to_job(self, setup: Setup, limits: GateLimits) -> Job:
        """Return the job as the controller takes it; the setup's joint counts where it states none.

        Raises ValueError for a depth that is asked of a joint whose depth no track tells; it names the key.
        """
        from arctrack.control.pose_watch import nominal_path

        setup = self.setup_for(setup)
        if self.part.depth_mm is not None and setup.joint.type not in DEEP:
            raise ValueError(
                f"[part] depth_mm: the depth of a {setup.joint.type} is not measured; leave it out, or "
                f"choose a joint of {', '.join(DEEP)}"
            )
        if self.again is not None:
            self._check_again(self.again, setup.joint, limits)
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
            uses_laser=self.again is None or self.again.laser,
        )


@dataclass(frozen=True)
class CellFile:
    """Content of a cell file."""

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
    mcap: McapChoice

    @property
    def files_read(self) -> tuple[Path, ...]:
        """The files that the jobs read beside the setup: seams of earlier passes, weld schedules."""
        schedules = (job.schedule for job in self.jobs.values() if job.schedule is not None)
        return (*(job.again.seam for job in self.jobs.values() if job.again is not None), *schedules)

    @property
    def bus_load(self) -> float:
        """The share of the bus that all messages take at most; 0 of a port, which is no bus."""
        if self.bus.is_port:
            return 0.0
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
