from .find_answer import FindAnswer as FindAnswer, FindAssembler as FindAssembler
from .gate import (
    Conditions as Conditions,
    Decision as Decision,
    LastSent as LastSent,
    Proposal as Proposal,
    Verdict as Verdict,
    decide as decide,
    forbidden_by as forbidden_by,
)
from .gate_limits import GateLimits as GateLimits
from .link.bus_log import BusLogError as BusLogError, BusLogWriter as BusLogWriter
from .link.bus_log_reader import (
    LOG_SUFFIXES as LOG_SUFFIXES,
    AmbiguousChannelError as AmbiguousChannelError,
    BusLogReader as BusLogReader,
)
from .link.inbox import (
    ANY_SOURCE as ANY_SOURCE,
    LIVE as LIVE,
    Inbox as Inbox,
    Received as Received,
    SkipReason as SkipReason,
    Trusted as Trusted,
)
from .link.link import Link as Link, LinkError as LinkError
from .link.reconnecting import LinkFault as LinkFault
from .offset_use import OffsetUse as OffsetUse
from .poses.pose_assembler import PoseAssembler as PoseAssembler, PoseSample as PoseSample
from .poses.pose_buffer import (
    PoseAt as PoseAt,
    PoseBuffer as PoseBuffer,
    PoseError as PoseError,
    PoseRefusal as PoseRefusal,
    PoseStatus as PoseStatus,
)
from .protocol.codec import (
    CodecError as CodecError,
    decode as decode,
    encode as encode,
    out_of_range_as_unknown as out_of_range_as_unknown,
)
from .protocol.dbc import (
    cycle_time_s as cycle_time_s,
    database as database,
    dbc_version as dbc_version,
    layout_checksum as layout_checksum,
    message_layout as message_layout,
)
from .protocol.messages import (
    MESSAGE_TYPES as MESSAGE_TYPES,
    BusMessage as BusMessage,
    Command as Command,
    CommandHeard as CommandHeard,
    DbcVersion as DbcVersion,
    Fault as Fault,
    FindRefusal as FindRefusal,
    FindResult as FindResult,
    FoundPosition as FoundPosition,
    FoundRotation as FoundRotation,
    GateReason as GateReason,
    JointType as JointType,
    LaserState as LaserState,
    MotionState as MotionState,
    PoseKind as PoseKind,
    QuaternionComponent as QuaternionComponent,
    RequestResult as RequestResult,
    RobotMode as RobotMode,
    RobotPosePosition as RobotPosePosition,
    RobotPoseRotation as RobotPoseRotation,
    RobotPulse as RobotPulse,
    RobotStatus as RobotStatus,
    RobotSync as RobotSync,
    SeamGeometry as SeamGeometry,
    SeamOffset as SeamOffset,
    SeamPoint as SeamPoint,
    Source as Source,
    Switch as Switch,
    TrackerCommand as TrackerCommand,
    TrackerHeartbeat as TrackerHeartbeat,
    TrackerState as TrackerState,
    TrackerStatus as TrackerStatus,
    TrackerSyncEcho as TrackerSyncEcho,
    Validity as Validity,
    WeldingState as WeldingState,
)
from .protocol.protect import (
    SOURCES as SOURCES,
    Checker as Checker,
    CheckStatus as CheckStatus,
    Protector as Protector,
)
