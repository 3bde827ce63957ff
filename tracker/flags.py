"""The one registry of quality flags: bit, name, meaning; it makes the decoder and the documentation.

A flag that invalidates says that the seam of that frame must not be used; the others say what was seen.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Flag:
    """One quality flag."""

    bit: int
    name: str
    meaning: str
    invalidates: bool = False

    @property
    def mask(self) -> int:
        """The flag's bit as an integer mask."""
        return 1 << self.bit


FRAME_UNREADABLE = Flag(
    0, "frame_unreadable", "the frame could not be read or has the wrong size or type", True
)
LASER_OFF = Flag(1, "laser_off", "the frame was taken with the laser off: there is no stripe to read", True)
POSE_REFUSED = Flag(2, "pose_refused", "no pose is near enough in time, or its numbers make no pose", True)
POSE_EXTRAPOLATED = Flag(3, "pose_extrapolated", "the pose was extrapolated from the last two")
STRIPE_LOST = Flag(
    4, "stripe_lost", "too few columns hold a stripe, or the arc alone would show as much of one", True
)
STRIPE_PARTIAL = Flag(5, "stripe_partial", "more than a quarter of the columns hold no stripe")
SATURATED = Flag(6, "saturated", "saturated pixels were censored within the stripe")
ARC_OFF = Flag(7, "arc_off", "the arc is off, or none of its light was found in the frame")
MAP_MISFIT = Flag(8, "map_misfit", "the arc map does not explain the frame within its stated uncertainty")
JOINT_NOT_FOUND = Flag(9, "joint_not_found", "the profile does not determine the joint", True)
JOINT_MISFIT = Flag(10, "joint_misfit", "the profile departs from the joint's shape beyond its noise")
SEAM_OUT_OF_VIEW = Flag(
    11,
    "seam_out_of_view",
    "the joint lies at or beyond the rim of the profile, or the laser's sheet cannot show it from this pose",
    True,
)
SEAM_JUMP = Flag(
    12, "seam_jump", "the seam departs from where the earlier frames put it beyond its noise", True
)
SEARCHED = Flag(13, "searched", "the stripe was searched over the whole frame")
OFFSET_EXTRAPOLATED = Flag(
    14, "offset_extrapolated", "the torch stands outside the measured stretch of the seam"
)
OFFSET_UNKNOWN = Flag(15, "offset_unknown", "the torch stands too far from the measured stretch of the seam")
BELOW_SURFACE = Flag(
    16, "below_surface", "the camera or the laser stands below the surface at this pose", True
)
ARC_LEVEL_UNKNOWN = Flag(17, "arc_level_unknown", "too few pixels off the stripe to tell the arc's output")
OFFSET_HELD = Flag(
    18, "offset_held", "the torch has passed what is measured of the seam: its last known place is kept"
)
OFFSET_LIMITED = Flag(19, "offset_limited", "the offset was cut to the limit that `[follow]` states")
FOLLOW_STOPPED = Flag(
    20, "follow_stopped", "following has stopped, as `[follow]` demands, until it starts anew"
)
BEFORE_JOINT = Flag(21, "before_joint", "the torch stands before the joint's start, whose offset it is given")
PAST_JOINT = Flag(22, "past_joint", "the torch stands past the joint's end: there is nothing to follow")
JOINT_TYPE_MISMATCH = Flag(
    23, "joint_type_mismatch", "a search shows another type of joint than the setup states, and decidedly"
)
TWO_STRIPES = Flag(24, "two_stripes", "a second stripe runs beside the one that was read: a reflection of it")
STRIPE_LEAVES_IMAGE = Flag(25, "stripe_leaves_image", "the stripe runs off the image within its columns")
SEAM_REVERSED = Flag(
    26,
    "seam_reversed",
    "the laser stands behind the torch along the line: `seam_in_base_mm` runs backwards",
    True,
)
SEAM_BY_LINE = Flag(
    27,
    "seam_by_line",
    "no gap shows in the stripe: the seam is the line that the image shows beside it, the gap is not known",
)

STRIPE_AMBIGUOUS = Flag(
    28,
    "stripe_ambiguous",
    "of two stripes neither is told to be the laser's: one is a reflection of the other",
    True,
)
PASS_FOLLOWED = Flag(
    29, "pass_followed", "the offset rests on the seam of the earlier pass more than on what is seen now"
)
PASS_UNUSABLE = Flag(
    30, "pass_unusable", "the seam of the earlier pass cannot be used: there is no offset without it"
)
PASS_CONTRADICTED = Flag(
    31,
    "pass_contradicted",
    "the seam lies elsewhere than in the earlier pass, beyond the noise of both: there is no offset",
)
PASS_TILTED = Flag(
    32, "pass_tilted", "the tool does not lean about the seam as the pass states: there is no offset"
)
ARC_IGNITED = Flag(33, "arc_ignited", "the arc's light appeared since the latest frame that told")
ARC_LOST = Flag(
    34,
    "arc_lost",
    "the arc's light went out since the latest frame that told, though the arc is said to burn",
)
ARC_NOT_SEEN = Flag(
    35, "arc_not_seen", "the arc is said to burn, and the frame shows less than a fifth of its expected light"
)
ARC_UNANNOUNCED = Flag(
    36, "arc_unannounced", "the arc is said to be off, and its light is in the frame, which is read with it"
)

FLAGS: tuple[Flag, ...] = tuple(value for value in list(globals().values()) if isinstance(value, Flag))
"""Every flag, in order of its bit."""

INVALIDATING = sum(flag.mask for flag in FLAGS if flag.invalidates)
"""The mask of all flags that invalidate a frame's seam."""


def names(flags: int) -> tuple[str, ...]:
    """Return the names of the flags that are set, in order of their bits."""
    return tuple(flag.name for flag in FLAGS if flags & flag.mask)


def flags_table() -> str:
    """Return docs/reference/flags.md: every flag's bit, name and meaning as a table."""
    lines = [
        "# Flags",
        "",
        "What a track says of its frame, from `tracker.flags`; `python -m tracker.flags` prints this page.",
        "A frame with a flag that invalidates has no seam to use.",
        "",
        "| bit | name | meaning | invalidates |",
        "| --- | --- | --- | --- |",
    ]
    lines += [
        f"| {flag.bit} | `{flag.name}` | {flag.meaning} | {'yes' if flag.invalidates else ''} |"
        for flag in FLAGS
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(flags_table(), end="")
