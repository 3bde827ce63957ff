"""A bus on which frames are lost, doubled, spoilt or late."""

from dataclasses import dataclass, field, replace

import numpy as np

from arctrack.simulation.cell.bus import FRAME_S, Bus, BusFrame


@dataclass
class BusTrouble:
    """Disturbance of the frames of some senders and identifiers; empty tuples mean all.

    `lost` and `doubled` are shares of frames, `flipped` is the probability of a bit flip. Frames arrive
    `late_s` later, and each by up to `shuffled_s` more, drawn for each, so that they overtake each other.
    """

    senders: tuple[str, ...] = ()
    lost: float = 0.0
    doubled: float = 0.0
    flipped: float = 0.0
    late_s: float = 0.0
    shuffled_s: float = 0.0
    ids: tuple[int, ...] = ()

    def concerns(self, frame: BusFrame) -> bool:
        """Return True if a frame is affected."""
        return (not self.senders or frame.sender in self.senders) and (
            not self.ids or frame.arbitration_id in self.ids
        )


@dataclass
class FaultyBus(Bus):
    """Simulated bus; `trouble` lists the present disturbances."""

    trouble: list[BusTrouble] = field(default_factory=list)

    def _deliver(self, frame: BusFrame, delay_s: float) -> None:
        copies = 1
        for trouble in self.trouble:
            if not trouble.concerns(frame):
                continue
            if self.rng.random() < trouble.lost:
                return
            copies += self.rng.random() < trouble.doubled
            delay_s += trouble.late_s + self.rng.uniform(0.0, trouble.shuffled_s)
            if trouble.flipped:
                frame = replace(frame, data=self._flipped(frame.data, trouble.flipped))
        for copy in range(copies):
            super()._deliver(frame, delay_s + copy * FRAME_S)

    def _flipped(self, data: bytes, probability: float) -> bytes:
        # Bits of a frame that a flip is drawn for.
        flips = self.rng.random(64) < probability
        if not flips.any():
            return data
        mask = np.packbits(flips).tobytes()
        return bytes(byte ^ flip for byte, flip in zip(data, mask, strict=True))
