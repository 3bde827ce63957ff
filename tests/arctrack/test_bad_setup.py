"""A recording.toml that cannot be: one line that names the file and the key, exit code 2."""

import shutil
from pathlib import Path

import pytest
from spoiled import Refusal, Spoil, content, gone, toml, toml_end

BAD: dict[str, tuple[Spoil, str, str]] = {
    "no setup": (gone("recording.toml"), "recording.toml", "no such file"),
    "no key": (toml("c2 = 112.0\n", ""), "recording.toml", "[material] c2: missing"),
    "no table": (toml("[sensor]", "[chip]"), "recording.toml", "[sensor]: missing"),
    "an arc without light": (
        toml("radiance_e = ", "radiance_e = 0.0 #"),
        "recording.toml",
        "[arc] radiance_e = 0.0: must be > 0; leave [arc] out for no arc",
    ),
    "a misspelt key of an optional table": (
        toml("radius_mm = ", "radius = "),
        "recording.toml",
        "[arc] radius_mm: missing; did you misspell it as radius?",
    ),
    "an effect of a metal that is not stated": (
        toml("[material]", "[effects.wrong_material]\nkappa_diff_ln = 0.1\n[metal]"),
        "recording.toml",
        "[effects.wrong_material]: needs [material], which is missing; state it",
    ),
    "no key, and what it is": (
        toml("peak_e = ", "# "),
        "recording.toml",
        "[laser] peak_e: missing; state it: the stripe's peak on a flat plate at the tool's height, before ",
    ),
    "a channel that is none": (
        toml_end("[robot]\ncan_channel = 1.5"),
        "recording.toml",
        "[robot] can_channel = 1.5: input should be a valid string",
    ),
    "no dimension": (toml("depth_mm = 4.0\n", ""), "recording.toml", "[joint] depth_mm: missing"),
    "wrong type": (toml("bits = 8", "bits = 'eight'"), "recording.toml", "[sensor] bits = 'eight'"),
    "nan in setup": (toml("c2 = 112.0", "c2 = nan"), "recording.toml", "[material] c2 = nan"),
    "depth beyond a float": (
        toml("depth_mm = 4.0", f"depth_mm = 1{400 * '0'}"),
        "recording.toml",
        " …: must be a finite number from -10000 to 10000",
    ),
    "depth beyond an integer": (
        toml("depth_mm = 4.0", f"depth_mm = 1{5000 * '0'}"),
        "recording.toml",
        "is no valid TOML",
    ),
    "inches": (
        toml("mm, s, deg, e-, DN", "inch, ms, rad"),
        "recording.toml",
        "units = 'inch, ms, rad': must be of mm, s, deg, e-, DN",
    ),
    "black beyond the code": (
        toml("black_level_dn = 4.0", "black_level_dn = -1e300"),
        "recording.toml",
        "[sensor] black_level_dn = -1e+300: input should be greater than or equal to -65535",
    ),
    "exponent of no arc": (
        toml("current_exponent = ", "current_exponent = 13000.0 #"),
        "recording.toml",
        "[arc] current_exponent = 13000.0: input should be less than or equal to 10",
    ),
    "image beyond memory": (
        toml("width = 48", "width = 320000000"),
        "recording.toml",
        "[camera] width = 320000000: input should be less than or equal to 16384",
    ),
    "charge beyond sense": (
        toml("peak_e = ", "peak_e = 1e300 #"),
        "recording.toml",
        "[laser] peak_e = 1e+300: input should be less than or equal to",
    ),
    "a fan that is none": (
        toml("peak_e = ", "fan_half_angle_deg = 95.0\npeak_e = "),
        "recording.toml",
        "[laser] fan_half_angle_deg = 95.0: must lie between 0 and 90",
    ),
    "depth beyond sense": (
        toml("depth_mm = 4.0", "depth_mm = 1e300"),
        "recording.toml",
        "[joint] depth_mm = 1e+300: must be a finite number from -10000 to 10000",
    ),
    "colours": (
        toml('pixel_format = "mono8"', 'pixel_format = "BayerRG8"'),
        "recording.toml",
        "[camera] pixel_format = 'BayerRG8': must be a monochrome one",
    ),
    "c2 zero": (toml("c2 = 112.0", "c2 = 0.0"), "recording.toml", "[material] c2 = 0.0: must be > 0"),
    "c2 negative": (toml("c2 = 112.0", "c2 = -1"), "recording.toml", "[material] c2 = -1.0: must be > 0"),
    "no toml": (toml("[laser]", "[laser"), "recording.toml", "line"),
    "other format": (toml("recording/1", "recording/9"), "recording.toml", "format = "),
    "no rotation": (
        toml("quaternion_xyzw = [0.69", "quaternion_xyzw = [1.69"),
        "recording.toml",
        "[camera.pose_in_tool] quaternion_xyzw",
    ),
    "level laser": (
        toml("plane_in_tool = [1.0, 0.0, 0.0, -35.0]", "plane_in_tool = [0.0, 0.0, 1.0, 0.0]"),
        "recording.toml",
        "[laser] plane_in_tool",
    ),
    "unknown joint": (toml('"v_groove"', '"zigzag"'), "recording.toml", "[joint] type = 'zigzag'"),
    "no bytes": (content("recording.toml", lambda _: b""), "recording.toml", "format: missing (and 5 more)"),
    "utf-16": (
        content("recording.toml", lambda text: text.decode().encode("utf-16")),
        "recording.toml",
        "is UTF-16: save it as UTF-8",
    ),
    "latin-1": (
        content("recording.toml", lambda text: text.replace(b"mild_steel", b"mild_st\xe4hl")),
        "recording.toml, line ",
        "byte 0xe4 is no UTF-8",
    ),
    "a NUL byte": (
        content("recording.toml", lambda text: text.replace(b"mild_steel", b"mild\0steel")),
        "recording.toml, line ",
        "holds a NUL byte",
    ),
    "infinite by its digits": (
        toml("depth_mm = 4.0", "depth_mm = 1e400"),
        "recording.toml",
        "[joint] depth_mm = inf: must be a finite number",
    ),
    "a key twice": (toml("c2 = 112.0", "c2 = 112.0\nc2 = 112.0"), "recording.toml", "is no valid TOML"),
    "an effect that is no table": (
        toml_end("[effects]\ngamma = 0.8"),
        "recording.toml",
        "[effects] gamma = 0.8: must be a table",
    ),
    "a lens without end": (
        toml("fy = ", "fy = 1e9 #"),
        "recording.toml",
        "[camera] fy = 1000000000.0: input should be less than or equal to 1000000",
    ),
    "a lens that is none": (
        toml("fx = ", "fx = 1e-300 #"),
        "recording.toml",
        "[camera] fx = 1e-300: input should be greater than or equal to 1",
    ),
    "a distortion beyond sense": (
        toml("distortion = [0.0", "distortion = [1e15"),
        "recording.toml",
        "[camera] distortion[0] = 1000000000000000.0: input should be less than or equal to 10000",
    ),
    "a camera out of the room": (
        toml("translation_mm = [", "translation_mm = [1e5, 0.0, 130.0] # ["),
        "recording.toml",
        "[camera.pose_in_tool] translation_mm[0] = 100000.0: input should be less than or equal to 10000",
    ),
    "a gamma beyond sense": (
        toml("gamma = 1.0", "gamma = 90.0"),
        "recording.toml",
        "[sensor] gamma = 90.0: input should be less than or equal to 10; usual: 1, or 0.45 with gamma on",
    ),
    "hardly a current": (
        toml("current_a = ", "current_a = 1e-300 #"),
        "recording.toml",
        "[arc] current_a = 1e-300: input should be greater than or equal to 0.001",
    ),
    "an arc larger than the room": (
        toml("radius_mm = ", "radius_mm = 1e9 #"),
        "recording.toml",
        "[arc] radius_mm = 1000000000.0: input should be less than or equal to 1000",
    ),
}


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("command", ["replay", "inspect"])
def test_it_is_one_line_with_the_place(
    command: str, name: str, recording: Path, tmp_path: Path, refusal: Refusal
) -> None:
    refusal.assert_names_the_place(command, Path(shutil.copytree(recording, tmp_path / "r")), BAD[name])
