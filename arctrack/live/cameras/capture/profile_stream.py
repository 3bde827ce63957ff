"""A laser profiler's profiles over TCP as a source: `arctrack.live.cameras.profile_message`.

The sensor's program listens, arctrack connects. It fails closed: a stream that is silent, breaks, or holds
anything but profiles of the setup's columns raises, and is connected to anew.
"""

import socket
import time

from arctrack.errors import ArctrackError
from arctrack.live.cameras.capture.device_clock import DeviceClock
from arctrack.live.cameras.capture.source import LONGEST_WAIT_S, Ask
from arctrack.live.cameras.profile_message import ProfileMessage, ProfileMessageError, take_profile
from noise_model.instrument.profiler import Profiler
from tracker.state import Frame

SILENT_S = 2.0
"""Time without a whole profile, or to connect, after which a sensor counts as lost, s; as of GigE Vision.

Offsets end long before, by the age of their frame: this is when the connection is made anew.
"""

CHUNK_BYTES = 1 << 18


class ProfileStream:
    """Profiles of the program that listens at HOST:PORT.

    It reads one profile at the start, and connects anew to begin, so that none is from before. Raises
    ArctrackError for a name that is no HOST:PORT, where nobody listens, or if its profiles do not fit.
    """

    is_over = False

    def __init__(self, name: str, profiler: Profiler) -> None:
        host, _, port = name.rpartition(":")
        if not host or not (port.isascii() and port.isdigit() and 0 < int(port) <= 65_535):
            raise ArctrackError(f"[camera] name = {name!r}: must be HOST:PORT, such as '192.168.0.10:5021'")
        self._name, self._address, self._profiler = name, (host, int(port)), profiler
        self._socket: socket.socket | None = None
        self._received, self._clock = bytearray(), DeviceClock()
        self._first, self._latest, self._heard_s = 0, -1, 0.0
        while self._message() is None:
            pass
        self.close()

    def begin(self) -> None:
        """Take profiles from now on: `read` connects."""

    def read(self) -> Frame | None:
        """Return the next profile, None where none is whole yet; ArctrackError if the stream fails."""
        message = self._message()
        if message is None:
            return None
        if message.number <= self._latest:
            raise self._failed(f"gives number {message.number} after {self._latest}: numbers must rise")
        # A first profile has the number 0, whatever the sensor counted before.
        self._first = message.number if self._latest < 0 else self._first
        self._latest = message.number
        middle_s = self._clock.host_s(1e-9 * message.time_ns, time.monotonic())
        if message.sigma_mm is not None and not self._profiler.point_sigma:
            raise self._failed("gives sigmas: state [camera] point_sigma = true in the setup, or send none")
        image_dn = self._profiler.profile(message.z_mm, message.intensity, message.sigma_mm)
        index = message.number - self._first
        return Frame(index, middle_s, image_dn, self._profiler.exposure_s, arc_on=False)

    def close(self) -> None:
        """End the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _message(self) -> ProfileMessage | None:
        """Return the next whole message, None after LONGEST_WAIT_S; it connects where that is not done."""
        if self._socket is None:
            self._connect()
        assert self._socket is not None
        message = self._taken()
        if message is None:
            try:
                chunk = self._socket.recv(CHUNK_BYTES)
            except TimeoutError:
                chunk = None
            except OSError as error:
                raise self._failed(f"the connection broke ({error.strerror})") from None
            if chunk == b"":
                raise self._failed("the sensor's program closed the connection")
            self._received += chunk or b""
            message = self._taken()
        if message is not None:
            self._heard_s = time.monotonic()
        elif time.monotonic() - self._heard_s > SILENT_S:
            raise self._failed(f"no whole profile came in {SILENT_S:g} s; does the sensor measure?")
        return message

    def _taken(self) -> ProfileMessage | None:
        try:
            return take_profile(self._received, self._profiler.columns)
        except ProfileMessageError as error:
            raise self._failed(str(error)) from None

    def _connect(self) -> None:
        try:
            self._socket = socket.create_connection(self._address, SILENT_S)
        except OSError as error:
            why = error.strerror or str(error)
            raise self._failed(f"cannot be reached ({why}); start the sensor's program first") from None
        self._socket.settimeout(LONGEST_WAIT_S)
        self._received.clear()
        self._clock, self._first, self._latest = DeviceClock(), 0, -1
        self._heard_s = time.monotonic()

    def _failed(self, problem: str) -> ArctrackError:
        self.close()
        return ArctrackError(f"[camera] name = {self._name!r}: {problem}")


def profile_stream(name: str, profiler: Profiler, _ask: Ask) -> ProfileStream:
    """Return a profiler's stream as a source; ArctrackError if it cannot be opened, or gives no profiles."""
    return ProfileStream(name, profiler)
