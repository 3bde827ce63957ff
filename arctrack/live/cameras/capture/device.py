"""A V4L2 device as a source, by OpenCV: grey levels as the driver gives them.

OpenCV's CAP_PROP_POS_MSEC is the time that the driver put on the buffer (modules/videoio/src/cap_v4l.cpp,
`getProperty`). V4L2 drivers take it of the monotonic clock, as a rule at the end of the exposure. Nothing in
OpenCV says of which clock it is: a time that is not within a second before the arrival is not believed, and
the time of arrival counts instead.
"""

import time
from typing import Any

import cv2
import numpy as np

from arctrack.errors import ArctrackError
from arctrack.live.cameras.capture.source import Ask
from noise_model.setup import Setup
from tracker.state import Frame, frame_misfit

EXPOSURE_UNIT_S = 1e-4
"""V4L2_CID_EXPOSURE_ABSOLUTE counts in 100 us."""


class DeviceSource:
    """An open video device, by path such as /dev/video0 or by number.

    Raises ArctrackError if it cannot be opened, or its frames do not fit the setup.
    """

    def __init__(self, name: str, setup: Setup, rate_hz: float) -> None:
        self._name, self._setup, self._rate_hz = name, setup, rate_hz
        is_device = name.isdigit() or name.startswith("/dev/")
        backend = cv2.CAP_V4L2 if is_device else cv2.CAP_ANY
        self._capture = cv2.VideoCapture(int(name) if name.isdigit() else name, backend)
        if not self._capture.isOpened():
            raise ArctrackError(f"[camera] name = {name!r}: cannot be opened; state a path as /dev/video0")
        # V4L2's raw grey by the sensor's bits; "Y16 " for all else.
        fourcc = {8: "GREY", 10: "Y10 ", 12: "Y12 "}.get(setup.sensor.bits, "Y16 ")
        for key, value in (
            (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*fourcc)),
            (cv2.CAP_PROP_FRAME_WIDTH, setup.camera.width),
            (cv2.CAP_PROP_FRAME_HEIGHT, setup.camera.height),
            (cv2.CAP_PROP_FPS, rate_hz),
            (cv2.CAP_PROP_CONVERT_RGB, 0),
            (cv2.CAP_PROP_BUFFERSIZE, 1),
            # V4L2_EXPOSURE_MANUAL.
            (cv2.CAP_PROP_AUTO_EXPOSURE, 1),
            (cv2.CAP_PROP_EXPOSURE, setup.camera.exposure_s / EXPOSURE_UNIT_S),
        ):
            # What a driver does not know it leaves as it is; what counts is read back, or seen in the frame.
            self._capture.set(key, value)
        stated_s = EXPOSURE_UNIT_S * self._capture.get(cv2.CAP_PROP_EXPOSURE) if is_device else 0.0
        self._exposure_s = stated_s if stated_s > 0.0 else setup.camera.exposure_s
        self._index, self._before_s = -1, 0.0
        self._first = self._grab()
        if self._first is None:
            self.close()
            raise ArctrackError(f"[camera] name = {name!r}: gives no frame; is another program using it?")
        problem = frame_misfit(self._first.shape, self._first.dtype, setup)
        if problem is not None:
            self.close()
            raise ArctrackError(f"[camera] name = {name!r}: a frame {problem}")

    @property
    def is_over(self) -> bool:
        """True once it was closed."""
        return not self._capture.isOpened()

    def begin(self) -> None:
        """Take frames from now on."""
        self._first = None

    def read(self) -> Frame | None:
        """Return the next frame; ArctrackError once the driver gives none."""
        image_dn = self._grab()
        arrived_s = time.monotonic()
        if image_dn is None:
            raise ArctrackError(f"[camera] name = {self._name!r}: gives no frame any more")
        stamped_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        # One of another clock is hardly ever within a second before the arrival.
        is_believed = 0.0 <= arrived_s - stamped_s <= 1.0
        exposed_s = stamped_s if is_believed else arrived_s
        periods = round((exposed_s - self._before_s) * self._rate_hz) if is_believed and self._before_s else 1
        self._index, self._before_s = self._index + max(periods, 1), exposed_s
        if frame_misfit(image_dn.shape, image_dn.dtype, self._setup) is not None:
            return None
        middle_s = exposed_s - self._exposure_s / 2.0
        return Frame(self._index, middle_s, image_dn, self._exposure_s, arc_on=False)

    def close(self) -> None:
        """Let go of the device."""
        self._capture.release()

    def _grab(self) -> np.ndarray[Any, np.dtype[Any]] | None:
        is_there, image = self._capture.read()
        if not is_there:
            return None
        image_dn = image.reshape(image.shape[:2]) if image.ndim == 3 and image.shape[2] == 1 else image
        return np.ascontiguousarray(image_dn)


def device_source(name: str, setup: Setup, rate_hz: float, _ask: Ask) -> DeviceSource:
    """Return a device as a source; ArctrackError if it cannot be opened."""
    return DeviceSource(name, setup, rate_hz)
