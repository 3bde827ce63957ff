"""A serial CAN adapter: python-can's, but its writes end, and its frames are as old as they may be."""

import time
from contextlib import suppress

import can
from can.interfaces.slcan import slcanBus

WRITE_TIMEOUT_S = 0.01
"""A line takes 2.3 ms at 115200 bit/s."""


class SlcanBus(slcanBus):
    """python-can's adapter with writes that end, and no old lines before new ones.

    python-can waits until all is written, for ever where nobody reads. Here a line that cannot be written in
    time is an error. It takes with it what still waits to go out: that is older than what comes next.

    A line says nothing of its time. It came after the buffer was last seen empty, so that is a frame's time.
    """

    _is_line_cut = False
    _was_empty_at_s = 0.0

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._buffer and not self.serialPortOrig.in_waiting:
            self._was_empty_at_s = time.monotonic()
        try:
            frame, is_filtered = super()._recv_internal(timeout)
        except Exception:
            # python-can keeps a line that is no text, and would fail with it for ever.
            self._buffer.clear()
            raise
        if frame is not None:
            frame.timestamp = time.time() - (time.monotonic() - self._was_empty_at_s)
        return frame, is_filtered

    def _write(self, string: str) -> None:
        port = self.serialPortOrig
        if port.write_timeout != WRITE_TIMEOUT_S:
            port.write_timeout = WRITE_TIMEOUT_S
        line = string.encode() + self.LINE_TERMINATOR
        try:
            # Ten lines, 22 ms at 115200 bit/s: what waits longer is older than the next offset.
            if port.out_waiting > 256:
                self._drop_what_waits()
            if self._is_line_cut:
                line = self.LINE_TERMINATOR + line
            port.write(line)
            self._is_line_cut = False
        except OSError as error:
            # A serial error of pyserial is an OSError, its time-out too.
            with suppress(OSError):
                self._drop_what_waits()
            raise can.CanOperationError(f"Could not write to serial device: {error}") from error

    def _drop_what_waits(self) -> None:
        self._is_line_cut = True
        self.serialPortOrig.reset_output_buffer()

    def shutdown(self) -> None:
        """Leave the bus, whether or not the adapter still listens."""
        try:
            with suppress(can.CanError, OSError):
                super().shutdown()
        finally:
            self.serialPortOrig.close()
