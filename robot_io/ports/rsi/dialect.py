"""`<Rob>` in, `<Sen>` out, by KUKA's Ethernet RSI XML and the configuration in `arctrack_rsi.xml`.

Each datagram is answered with its IPOC, whatever counts: RSI stops after some answers that are missing.
"""

from xml.etree import ElementTree

from scipy.spatial.transform import Rotation

from robot_io.ports.report import Dialect, PortCorrection, PortError, PortReport, ProgramWord


class RsiDialect(Dialect):
    """KUKA's side of RSI: RIst and the program's `Word` in, RKorr and `Usable` out."""

    def hear(self, data: bytes) -> tuple[list[PortReport], bytes]:
        """Return the report of a datagram."""
        # No declaration is of RSI, and one of entities could grow without end; in UTF-16 it would be hidden.
        # Largest datagram; one of the configuration has some 300 bytes.
        if len(data) > 4096 or not data.isascii() or b"<!" in data or b"\0" in data:
            raise PortError("XML that RSI does not send")
        try:
            robot = ElementTree.fromstring(data)
            if robot.tag != "Rob" or robot.get("TYPE") != "KUKA":
                raise PortError('must be <Rob TYPE="KUKA">')
            place = _element(robot, "RIst")
            x_mm, y_mm, z_mm, a, b, c = (float(place.attrib[name]) for name in "XYZABC")
            ipoc = int(_text(robot, "IPOC"))
            word = ProgramWord(int(_text(robot, "Word")) & 0xFFFF_FFFF)
        except (ElementTree.ParseError, KeyError, ValueError, LookupError) as error:
            raise PortError(f"a message of RSI: {error}") from None
        qx, qy, qz, qw = Rotation.from_euler("ZYX", (a, b, c), degrees=True).as_quat().tolist()
        return [word.report(ipoc, ipoc / 1000.0, (x_mm, y_mm, z_mm), (qx, qy, qz, qw))], b""

    def answer(self, report: PortReport, correction: PortCorrection) -> bytes:
        """Return the correction in force; where nothing counts it stays, and `Usable` is 0."""
        return (
            f'<Sen Type="ImFree"><RKorr X="0.0000" Y="{correction.y_mm:.4f}" Z="{correction.z_mm:.4f}"'
            f' A="0.0000" B="0.0000" C="0.0000"/><Usable>{correction.is_usable:d}</Usable>'
            f"<IPOC>{report.stamp}</IPOC></Sen>"
        ).encode()


def _element(robot: ElementTree.Element, name: str) -> ElementTree.Element:
    element = robot.find(name)
    if element is None:
        raise PortError(f"without {name}")
    return element


def _text(robot: ElementTree.Element, name: str) -> str:
    return _element(robot, name).text or ""
