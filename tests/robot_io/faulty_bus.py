"""A bus on which everything goes wrong that can, the same for the same seed."""

from __future__ import annotations

import errno
import random
from dataclasses import dataclass

import can
from can.interfaces.virtual import VirtualBus

OPENED: list[FaultyBus] = []
"""Every one that was opened."""


@dataclass
class Faults:
    """How likely each fault is, of a frame."""

    drop: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    flip: float = 0.0
    delay: float = 0.0
    garbage: float = 0.0
    full: float = 0.0
    block: float = 0.0
    is_gone: bool = False
    is_off: bool = False


class FaultyBus(VirtualBus):
    """A virtual bus that sends and receives as `faults` has it; they may be changed at any time."""

    def __init__(self, channel: str, faults: Faults, seed: int = 0, **options) -> None:
        if faults.is_gone:
            raise can.CanInitializationError("no such device")
        super().__init__(channel, preserve_timestamps=True, **options)
        self.faults = faults
        self._random = random.Random(seed)
        self._late: list[can.Message] = []
        OPENED.append(self)

    def _happens(self, fault: str) -> bool:
        return self._random.random() < getattr(self.faults, fault)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.faults.is_gone:
            raise OSError(errno.ENODEV, "No such device")
        if self._happens("full"):
            raise can.CanOperationError("No buffer space available", errno.ENOBUFS)
        if self._happens("block"):
            raise can.CanTimeoutError(f"not sent within {timeout} s")
        super().send(msg, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.faults.is_gone:
            raise OSError(errno.ENODEV, "No such device")
        if self.faults.is_off:
            self.faults.is_off = False
            return can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False), False
        if self._happens("garbage"):
            raise IndexError("index out of range")
        frame, is_filtered = super()._recv_internal(timeout)
        if frame is None:
            return (self._late.pop(0), False) if self._late else (None, is_filtered)
        if self._happens("drop"):
            return None, is_filtered
        if self._happens("flip"):
            bit = self._random.randrange(64)
            frame.data[bit // 8] ^= 1 << bit % 8
        if self._happens("duplicate"):
            self._late.append(frame)
        if self._happens("delay"):
            self._late.append(frame)
            return None, is_filtered
        if self._late and self._happens("reorder"):
            self._late.append(frame)
            return self._late.pop(0), is_filtered
        return frame, is_filtered
