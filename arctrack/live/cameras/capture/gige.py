"""A GigE Vision camera as a source, by Aravis: each frame whole, or counted as lost.

The stamp of a frame is taken as the beginning of its exposure (SFNC: the event FrameStart), and comes onto
the host's clock by `DeviceClock`. Its first packet leaves once the exposure is over, so arrival less
exposure is what the clock is given. How long read-out and the shortest way take stays in the time, and in the
delay that `arctrack calibrate delay` finds.
"""

import time
from collections import deque
from typing import Any

import numpy as np

from arctrack.control.cell_file import CameraChoice
from arctrack.errors import ArctrackError
from arctrack.live.cameras.camera_line import trigger_at_s
from arctrack.live.cameras.capture import genicam
from arctrack.live.cameras.capture.device_clock import DeviceClock
from arctrack.live.cameras.capture.source import LONGEST_WAIT_S, Ask, wait_until
from noise_model.setup import Setup
from tracker.state import Frame

IDS_GO_ROUND = 65_535
"""Frame ids of 16 bits go from 1 to this."""

BUFFERS = 16
"""Frames that the stream holds until they are read."""

Since = tuple[float, float]
"""A value, and from which time on, s, it holds for what begins then."""


class GigeSource:
    """An open GigE Vision camera.

    `ask` returns the tracker's current request. Raises ArctrackError if there is no such camera, or it cannot
    do what is asked.
    """

    is_over = False

    def __init__(self, choice: CameraChoice, setup: Setup, ask: Ask) -> None:
        self._Aravis, self._GLib = genicam.aravis()
        self._choice, self._setup, self._ask = choice, setup, ask
        self._is_software = choice.capture.trigger == "software"
        self.clock = DeviceClock()
        self._camera = self._opened()
        try:
            self._exposure_s = genicam.set_up(self._camera, choice, setup)
            self._stream = self._streaming()
        except self._GLib.Error as error:
            raise self._failed(error) from None
        now_s = time.monotonic()
        self._exposures: deque[Since] = deque([(self._exposure_s, now_s)])
        self._lasers: deque[Since] = deque([(float(choice.capture.laser_line is None), now_s)])
        self._index, self._id = -1, 0
        self._due_s = self._heard_s = now_s
        self._triggered, self._triggered_s = 0, now_s
        self._is_waited_for = self._shot_lit = False

    def begin(self) -> None:
        """Take frames from now on."""
        self._due_s = self._heard_s = time.monotonic()
        try:
            self._camera.start_acquisition()
        except self._GLib.Error as error:
            raise self._failed(error) from None

    def read(self) -> Frame | None:
        """Return the next frame; None where none came yet, or one that is not whole."""
        try:
            self._heed()
            if self._is_software and not self._trigger():
                return None
            buffer = self._stream.timeout_pop_buffer(round(1e6 * LONGEST_WAIT_S))
            if buffer is None:
                since_s = time.monotonic() - self._triggered_s
                # After three periods a triggered frame is lost: not even one packet of it came.
                self._is_waited_for &= since_s < self._exposure_s + 3 / self._choice.frame_rate_hz
                self._ask_whether_there()
                return None
            self._heard_s = time.monotonic()
            frame = self._frame(buffer)
            self._is_waited_for = False
            self._stream.push_buffer(buffer)
            return frame
        except self._GLib.Error as error:
            raise self._failed(error) from None

    def close(self) -> None:
        """Take no more frames; the laser goes off."""
        try:
            if self._choice.capture.laser_line is not None:
                genicam.switch_laser(self._camera, self._choice, False)
            self._camera.stop_acquisition()
        except self._GLib.Error:
            # It is gone: its own watchdog has it stop.
            return

    def counts(self) -> dict[str, int]:
        """Return what the stream has counted, by Aravis' names."""
        names = [self._stream.get_info_name(n) for n in range(self._stream.get_n_infos())]
        return {name: self._stream.get_info_uint64_by_name(name) for name in names}

    def _opened(self) -> Any:
        name = self._choice.name
        try:
            return self._Aravis.Camera.new(name)
        except self._GLib.Error as error:
            raise ArctrackError(
                f"[camera] name = {name!r}: no such camera ({error.message}); state its id or its address"
            ) from None

    def _streaming(self) -> Any:
        stream = self._camera.create_stream(None, None)
        if self._camera.is_gv_device():
            stream.set_property("packet-resend", self._Aravis.GvStreamPacketResend.ALWAYS)
            # What is not whole once the next frame is there is of no use, and would hold that one up.
            retained_us = round(1e6 / self._choice.frame_rate_hz)
            stream.set_property("frame-retention", retained_us)
            stream.set_property("packet-timeout", min(stream.get_property("packet-timeout"), retained_us))
        for _ in range(BUFFERS):
            stream.push_buffer(self._Aravis.Buffer.new_allocate(self._camera.get_payload()))
        return stream

    def _heed(self) -> None:
        """Set exposure and laser as the tracker wants them."""
        wanted = self._ask()
        is_on = time.monotonic() < wanted.laser_until_s
        # A frame that was triggered keeps what it was triggered with; but off is off.
        if self._is_software:
            if not is_on:
                self._switch(False)
        else:
            self._switch(is_on)
        if self._is_waited_for:
            return
        # Cameras round exposures to their own steps.
        if wanted.exposure_s > 0.0 and abs(wanted.exposure_s / self._exposure_s - 1.0) > 1e-3:
            self._exposure_s = genicam.set_exposure(self._camera, wanted.exposure_s)
            # A camera that runs free may have begun to prepare the next frame.
            self._exposures.append((self._exposure_s, time.monotonic() + 1.0 / self._choice.frame_rate_hz))

    def _switch(self, is_on: bool) -> None:
        if self._choice.capture.laser_line is None or bool(self._lasers[-1][0]) is is_on:
            return
        if not is_on:
            # A frame that is exposed while it goes off has less than all of its light.
            self._lasers.append((0.0, time.monotonic() - self._exposure_s))
            self._shot_lit = False
        genicam.switch_laser(self._camera, self._choice, is_on)
        if is_on:
            self._lasers.append((1.0, time.monotonic()))

    def _trigger(self) -> bool:
        """Trigger the next frame once it is due; return whether one is on its way."""
        if self._is_waited_for:
            return True
        wanted, now_s = self._ask(), time.monotonic()
        at_s = trigger_at_s(wanted, self._exposure_s, max(self._due_s, now_s), now_s)
        if not wait_until(at_s):
            return False
        interleave = self._choice.capture.interleave
        if time.monotonic() < wanted.laser_until_s:
            self._switch(interleave is None or self._triggered % interleave != interleave - 1)
        self._shot_lit = bool(self._lasers[-1][0])
        self._camera.software_trigger()
        self._triggered, self._triggered_s = self._triggered + 1, time.monotonic()
        self._is_waited_for = True
        period_s = 1.0 / self._choice.frame_rate_hz
        # A frame that comes late for its base phase does not put the next ones off.
        self._due_s = max(self._due_s + period_s, time.monotonic() - period_s)
        return True

    def _frame(self, buffer: Any) -> Frame | None:
        """Return a buffer's frame, None for one that is not whole; its number counts."""
        step = frames_between(self._id, buffer.get_frame_id())
        if step <= 0:
            # It was waited for until a later one had come, and counts as lost already; or it has no id.
            return None
        self._index, self._id = self._index + step, buffer.get_frame_id()
        if buffer.get_status() != self._Aravis.BufferStatus.SUCCESS:
            return None
        camera = self._setup.camera
        dtype = np.dtype(self._setup.sensor.dtype).newbyteorder("<")
        pixels = np.frombuffer(buffer.get_data(), dtype, count=camera.height * camera.width)
        image_dn = pixels.astype(self._setup.sensor.dtype).reshape(camera.height, camera.width)
        arrived_s = time.monotonic() - (time.time() - 1e-9 * buffer.get_system_timestamp())
        ended_s = arrived_s - self._exposure_s
        begun_s = self.clock.host_s(1e-9 * buffer.get_timestamp(), ended_s)
        if self._is_software:
            exposure_s, laser_on = self._exposure_s, self._shot_lit
        else:
            exposure_s = _held(self._exposures, begun_s)
            laser_on = bool(_held(self._lasers, begun_s))
        return Frame(
            self._index, begun_s + exposure_s / 2.0, image_dn, exposure_s, laser_on=laser_on, arc_on=False
        )

    def _ask_whether_there(self) -> None:
        """Raise ArctrackError where a camera gives no frame that should, or is not ours any more."""
        # Silence after which a camera counts as lost, unless it waits for its trigger's line, s.
        if time.monotonic() - self._heard_s <= 2.0:
            return
        # One that was switched off and on answers, and knows nothing of us.
        waits_for_line = self._choice.capture.trigger == "hardware"
        if not (waits_for_line and self._is_ours()):
            raise ArctrackError(f"[camera] name = {self._choice.name!r}: gives no frame any more")
        self._heard_s = time.monotonic()

    def _is_ours(self) -> bool:
        self._camera.get_exposure_time()
        return not self._camera.is_gv_device() or bool(self._camera.get_device().is_controller())

    def _failed(self, error: Any) -> ArctrackError:
        return ArctrackError(f"[camera] name = {self._choice.name!r}: {error.message}")


def gige_source(choice: CameraChoice, setup: Setup, ask: Ask) -> GigeSource:
    """Return a GigE Vision camera as a source; ArctrackError if it cannot be opened."""
    return GigeSource(choice, setup, ask)


def frames_between(before: int, frame_id: int) -> int:
    """Return the number of frames from one id to another; 0 as `before` means none before.

    GigE Vision gives no frame the id 0. A buffer that has it is of a frame whose id did not arrive: the next
    id shows that it is lost.
    """
    if frame_id == 0:
        return 0
    if before == 0:
        return 1
    step = frame_id - before
    if max(before, frame_id) > IDS_GO_ROUND:
        return step
    return (step + IDS_GO_ROUND // 2) % IDS_GO_ROUND - IDS_GO_ROUND // 2


def _held(values: deque[Since], begun_s: float) -> float:
    """Return the value that held as a frame began; older ones are forgotten."""
    while len(values) > 1 and values[1][1] <= begun_s:
        values.popleft()
    return values[0][0]
