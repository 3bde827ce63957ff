"""What one step hands to the next."""

from __future__ import annotations

from typing import NamedTuple

from tracker import flags
from tracker.seam.gaussian_process import NO_HISTORY, SeamHistory
from tracker.seam.joint_ends import JointEnds
from tracker.state import Pair
from tracker.stripe.scatter import NO_SCATTER, Scatter

LOST_TO_FORGET = 10
"""So many frames in a row without a joint, and what was measured before no longer says where to look.

The torch, which comes later, is steered by it all the same.
"""

LOST_TO_SEARCH = 3
"""So many frames without a joint widen the search to what it was at first."""


class Steering(NamedTuple):
    """What the steering hands on from frame to frame.

    Once stopped it stays so: a new Steering, as a new Tracker has, is the only way to start again.
    `hand_eye_variance_mm2` (y, z) is what the hand-eye tolerance leaves of the latest measurement.
    """

    ends: JointEnds = JointEnds()
    is_stopped: bool = False
    hand_eye_variance_mm2: Pair = (0.0, 0.0)


class TrackerMemory(NamedTuple):
    """What one step hands to the next; it can be saved with a recording.

    Attributes
    ----------
    history : SeamHistory
        The seam from its last jump on.
    beyond : SeamHistory
        What has been measured elsewhere since. It becomes the history if it goes on so.
    behind : tuple of SeamHistory
        The latest stretches before, the oldest first, in which the torch may still stand.
    steering : Steering
        What the steering remembers.
    scatter : Scatter
        What the stripes so far show beyond their photons' noise.
    jumps : int
        How many frames had their joint elsewhere, since it was last where it should be.
    jumped_at : int
        The number of the frame that began them.
    lost : int
        How many frames in a row had no joint.
    frames : int
        How many frames were tracked.
    """

    history: SeamHistory = NO_HISTORY
    beyond: SeamHistory = NO_HISTORY
    behind: tuple[SeamHistory, ...] = ()
    steering: Steering = Steering()
    scatter: Scatter = NO_SCATTER
    jumps: int = 0
    jumped_at: int = 0
    lost: int = 0
    frames: int = 0

    @property
    def lasting_flags(self) -> int:
        """The flags of every frame from now on, one that cannot be read as well."""
        return flags.FOLLOW_STOPPED.mask if self.steering.is_stopped else 0
