"""`<Rob>` in, `<Sen>` out, by KUKA's Ethernet RSI XML and the configuration in `arctrack_rsi.xml`.

Each datagram is answered with its IPOC, whatever counts: RSI stops after some answers that are missing.
"""

import math
from xml.etree import ElementTree

from robot_io.ports.report import PortCorrection, PortError, PortReport, ProgramWord, Quaternion


class RsiDialect:
    """KUKA's side of RSI: RIst and the program's `Word` in, RKorr and `Usable` out."""

    def greeting(self) -> bytes:
        """Return nothing: the robot speaks first."""
        return b""

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
        report = PortReport(
            stamp=ipoc,
            robot_time_s=ipoc / 1000.0,
            position_base_mm=(x_mm, y_mm, z_mm),
            quaternion_xyzw=quaternion_of_zyx(a, b, c),
            status=word.status(),
            command=word.command,
            laser=word.laser,
            job_number=word.job_number,
        )
        return [report], b""

    def answer(self, report: PortReport, correction: PortCorrection) -> bytes:
        """Return the correction in force; where nothing counts it stays, and `Usable` is 0."""
        return (
            f'<Sen Type="ImFree"><RKorr X="0.0000" Y="{correction.y_mm:.4f}" Z="{correction.z_mm:.4f}"'
            f' A="0.0000" B="0.0000" C="0.0000"/><Usable>{correction.is_usable:d}</Usable>'
            f"<IPOC>{report.stamp}</IPOC></Sen>"
        ).encode()


def quaternion_of_zyx(a_deg: float, b_deg: float, c_deg: float) -> Quaternion:
    """Return the quaternion x y z w of KUKA's angles: A about z, then B about the new y, then C about x."""
    (sa, ca), (sb, cb), (sc, cc) = (
        (math.sin(half), math.cos(half))
        for half in (math.radians(deg) / 2.0 for deg in (a_deg, b_deg, c_deg))
    )
    return (
        ca * cb * sc - sa * sb * cc,
        ca * sb * cc + sa * cb * sc,
        sa * cb * cc - ca * sb * sc,
        ca * cb * cc + sa * sb * sc,
    )


def _element(robot: ElementTree.Element, name: str) -> ElementTree.Element:
    element = robot.find(name)
    if element is None:
        raise PortError(f"without {name}")
    return element


def _text(robot: ElementTree.Element, name: str) -> str:
    return _element(robot, name).text or ""
