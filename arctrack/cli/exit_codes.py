"""The command line's exit codes."""

BAD_INPUT = 2
"""An input that cannot be used; the shell's own for a command line that makes no sense."""

WARNED = 1
"""A check that has warnings, of a recording that can be tracked."""

UNFIT = 1
"""A machine that cannot run a cell live."""

NOTHING_TRACKED = 3
"""A recording of which no frame is valid, or no offset goes out though the robot wants some;
a live run that no robot could follow."""

CRASHED = 70
"""A fault of arctrack itself, `EX_SOFTWARE` of sysexits.h; no other code ever means one."""

INTERRUPTED = 130
"""The shell's own for a command that an interrupt ended: 128 + SIGINT."""

READER_GONE = 141
"""The shell's own for a command whose output nobody reads to its end: 128 + SIGPIPE."""
