from robot_io import CommandHeard, Fault, LaserState, RequestResult, Source, TrackerHeartbeat, TrackerState

BEAT = TrackerHeartbeat(
    TrackerState.DISARMED,
    Source.LIVE,
    LaserState.UNKNOWN,
    Fault.NONE,
    0,
    RequestResult.NONE,
    1,
    0,
    CommandHeard.DISARM,
)
