"""Time-outs of the controller, and periods of its messages."""

from dataclasses import dataclass

from robot_io.stated_limit import check_limits, stated


@dataclass(frozen=True)
class ServicePolicy:
    """The controller's times. Each field's metadata states `unit`, `role` and `source`.

    Raises
    ------
    ValueError
        For a time that is not positive and finite; `pose_wait_s` may be 0.
    """

    status_age_s: float = stated(0.2, "s", "oldest RobotStatus", "ten periods of 20 ms")
    command_age_s: float = stated(
        0.15, "s", "oldest TrackerCommand, the robot's heartbeat", "one and a half periods: none is missed"
    )
    poses_age_s: float = stated(0.1, "s", "oldest verdict on the poses", "ten periods of 10 ms")
    camera_timeout_s: float = stated(
        0.2, "s", "longest time without a track", "the oldest capture that the gate lets out"
    )
    repeat_s: float = stated(0.1, "s", "time between refusals without a track", "the cycle of TrackerStatus")
    round_trip_s: float = stated(
        0.02, "s", "longest way of a SYNC and its echo", "at 10 mm/s the torch goes 0.2 mm"
    )
    round_trip_age_s: float = stated(
        0.35, "s", "oldest SYNC that states a round trip", "three cycles and a half: two may be lost"
    )
    pose_wait_s: float = stated(
        0.02,
        "s",
        "longest wait of a frame for the pose after it; 0 extrapolates at once",
        "two periods of 10 ms: one until it is sampled, one for its way; extrapolated instead, a weave of "
        "2 mm at 3 Hz is off by 0.04 mm",
    )
    watchdog_s: float = stated(
        2.0,
        "s",
        "longest turn of a live run, after which its process is ended",
        "a hundred times a frame's step; the robot's own time-outs end what was VALID within 0.2 s",
    )
    sync_required: bool = stated(
        False, "", "whether the robot must send RobotSync", "without it what is late on the way is not seen"
    )

    def __post_init__(self) -> None:
        check_limits(self, "service policy", {"pose_wait_s"})


@dataclass(frozen=True)
class LookAheadPolicy:
    """Policy of the lag's estimation during a run.

    - `window_s`: span of commands and motion that is kept (chosen: some periods of a weave, and a soft
      start).
    - `every_s`: time between estimates (chosen: an estimate takes a tenth of a second).
    - `speed_s`: span over which the speed along the path is measured (chosen: the bus' rounding is then 0.02
      mm/s).
    - `timing_sigma_s`: 1 sigma of a lag from the bus' rounding of ages and from computing times (ages are
      rounded to 1 ms).
    - `differ_sigmas`: a new estimate this many sigmas off is of another lag than the one kept (chosen).
    - `guessed_lags`: number of lags at which offsets are separated from the weave (chosen: a tenth of a
      second apart).
    - `weave_hz`: frequency range of the weave (chosen: from slow wide ones to what arms can swing).
    - `harmonics`: number of its harmonics that are removed (chosen: a triangle's third is a ninth).
    """

    window_s: float = 8.0
    every_s: float = 1.0
    speed_s: float = 0.5
    timing_sigma_s: float = 0.001
    differ_sigmas: float = 5.0
    guessed_lags: int = 7
    weave_hz: tuple[float, float] = (0.5, 10.0)
    harmonics: int = 3
