"""Aravis' fake GigE Vision camera on loopback, a process of its own: python fake_gige.py SERIAL LOST_SHARE.

It says ready, and ends once its input is closed. Its description gets a line that switches, which Aravis' own
lacks.
"""

from __future__ import annotations

import sys
import tempfile

from arctrack.live.cameras.capture.genicam import aravis

Aravis, _ = aravis()

SWITCHED = """
<Category Name="DigitalIOControl" NameSpace="Standard"><pFeature>LineSelector</pFeature>
<pFeature>LineMode</pFeature><pFeature>LineSource</pFeature></Category>
<Enumeration Name="LineSelector" NameSpace="Standard">
<EnumEntry Name="Line1" NameSpace="Standard"><Value>0</Value></EnumEntry>
<pValue>LineSelectorRegister</pValue></Enumeration>
<Enumeration Name="LineMode" NameSpace="Standard">
<EnumEntry Name="Input" NameSpace="Standard"><Value>0</Value></EnumEntry>
<EnumEntry Name="Output" NameSpace="Standard"><Value>1</Value></EnumEntry>
<pValue>LineModeRegister</pValue></Enumeration>
<Enumeration Name="LineSource" NameSpace="Standard">
<EnumEntry Name="Off" NameSpace="Standard"><Value>0</Value></EnumEntry>
<EnumEntry Name="ExposureActive" NameSpace="Standard"><Value>1</Value></EnumEntry>
<pValue>LineSourceRegister</pValue></Enumeration>
"""

REGISTER = """
<IntReg Name="{name}Register" NameSpace="Custom"><Address>{address:#x}</Address><Length>4</Length>
<AccessMode>RW</AccessMode><pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>
"""


def description(plain: str) -> str:
    """Return a camera's description with a line that switches."""
    registers = (
        REGISTER.format(name=name, address=0x8000 + 4 * n)
        for n, name in enumerate(("LineSelector", "LineMode", "LineSource"))
    )
    return plain.replace("</RegisterDescription>", SWITCHED + "".join(registers) + "</RegisterDescription>")


def main() -> None:
    serial, lost_share = sys.argv[1], float(sys.argv[2])
    Aravis.enable_interface("Fake")
    plain, _ = Aravis.Camera.new("Fake_1").get_device().get_genicam_xml()
    Aravis.disable_interface("Fake")
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(description(plain))
        file.flush()
        camera = Aravis.GvFakeCamera.new_full("127.0.0.1", serial, file.name)
    if not camera.is_running():
        sys.exit("the fake camera does not run: is its port in use?")
    camera.set_property("gvsp-lost-ratio", lost_share)
    print("ready", flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()
