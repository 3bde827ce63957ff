"""State that one step hands to the next."""

from __future__ import annotations

from typing import NamedTuple

from tracker import flags
from tracker.arc.burning import NOTHING_SEEN, ArcMemory
from tracker.seam.earlier_pass import EarlierPass
from tracker.seam.gaussian_process import NO_HISTORY, SeamHistory
from tracker.seam.joint_ends import JointEnds
from tracker.state import Pair
from tracker.stripe.scatter import NO_SCATTER, Scatter

LOST_TO_FORGET = 10
"""Number of frames in a row without a joint after which earlier measurements no longer predict the seam.

The torch, which comes later, is steered by it all the same.
"""

LOST_TO_SEARCH = 3
"""Number of frames without a joint after which the search is as wide as at first."""


class Steering(NamedTuple):
    """State of the steering from frame to frame.

    Once stopped it stays so: a new Steering, as a new Tracker has, is the only way to start again.
    `hand_eye_variance_mm2` (y, z) is the part of the calibration's errors in the latest measurement; files of
    earlier runs name it so.
    """

    ends: JointEnds = JointEnds()
    is_stopped: bool = False
    hand_eye_variance_mm2: Pair = (0.0, 0.0)


class TrackerMemory(NamedTuple):
    """State that one step hands to the next; it can be saved with a recording.

    `history` is the seam since its last jump, `beyond` what was measured elsewhere since, which becomes the
    history if it goes on; `behind` are the latest stretches before, the oldest first, in which the torch may
    still stand. `scatter` is the stripes' scatter beyond photon noise. `jumps` counts frames with the joint
    elsewhere since it was last where expected, the first of which has number `jumped_at`; `lost` counts the
    latest frames in a row without a joint. `earlier` is the pass that is followed again, None for none.
    `arc` is what frames have shown of the arc.
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
    earlier: EarlierPass | None = None
    arc: ArcMemory = NOTHING_SEEN

    @property
    def lasting_flags(self) -> int:
        """The flags of every frame from now on, one that cannot be read as well."""
        return flags.FOLLOW_STOPPED.mask if self.steering.is_stopped else 0
