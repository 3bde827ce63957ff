"""CSV files that cannot be: one line that names the file and the line, exit code 2."""

import shutil
from pathlib import Path

import pytest
from spoiled import Refusal, Spoil, content, gone, line


def cut_poses(path: Path) -> None:
    lines = (path / "poses.csv").read_text().splitlines()
    (path / "poses.csv").write_text("\n".join(lines[:5]))


def a_day_earlier(text: bytes) -> bytes:
    head, *rows = text.decode().splitlines()
    cells = [row.split(",", 1) for row in rows]
    return "\n".join([head, *(f"{float(time) - 86_400.0},{rest}" for time, rest in cells)]).encode()


def packed_log(path: Path) -> None:
    (path / "poses.csv").rename(path / "can.log.gz")


BAD: dict[str, tuple[Spoil, str, str]] = {
    "no frames.csv": (gone("frames.csv"), "frames.csv", "no such file"),
    "no poses": (gone("poses.csv"), "poses.csv", "no poses"),
    "frame times fall": (
        line("frames.csv", 4, "2,0.05,1,1,100,0.005"),
        "frames.csv, line 4",
        "times must rise",
    ),
    "frame time nan": (
        line("frames.csv", 3, "1,nan,1,1,100,0.005"),
        "frames.csv, line 3",
        "timestamp_s = 'nan'",
    ),
    "current nan": (line("frames.csv", 3, "1,0.1,1,1,nan,0.005"), "frames.csv, line 3", "current_a = 'nan'"),
    "frame time in ms": (
        line("frames.csv", 5, "3,1700000000000.5,1,1,100,0.005"),
        "frames.csv, line 5",
        "timestamp_s = 1.7e+12: is beyond 1e+11 s; give seconds, not ms or ns",
    ),
    "frame time before all": (
        line("frames.csv", 2, "0,-1e300,1,1,100,0.005"),
        "frames.csv, line 2",
        "timestamp_s = -1e+300: is beyond 1e+11 s",
    ),
    "endless exposure": (
        line("frames.csv", 3, "1,0.1,1,1,100,1e308"),
        "frames.csv, line 3",
        "exposure_s = 1e+308: must be <= 3600; give seconds",
    ),
    "lightning": (
        line("frames.csv", 3, "1,0.1,1,1,1e308,0.005"),
        "frames.csv, line 3",
        "current_a = 1e+308: must be <= 10000; give amperes",
    ),
    "no exposure": (line("frames.csv", 3, "1,0.1,1,1,100,0"), "frames.csv, line 3", "exposure_s = 0"),
    "short line": (line("frames.csv", 3, "1,0.1,1,1"), "frames.csv, line 3", "4 values"),
    "no column": (
        line("frames.csv", 1, "frame,timestamp_s,laser_on,arc_on,current,exposure_s"),
        "frames.csv, line 1",
        "current_a is missing",
    ),
    "laser half on": (line("frames.csv", 2, "0,0,0.5,1,100,0.005"), "frames.csv, line 2", "laser_on = '0.5'"),
    "pose times fall": (line("poses.csv", 9, "-1,0,0,1,0,0,0,1"), "poses.csv, line 9", "times must rise"),
    "pose nan": (line("poses.csv", 2, "-0.2,0,nan,1,0,0,0,1"), "poses.csv, line 2", "y_mm = 'nan'"),
    "pose no rotation": (line("poses.csv", 2, "-0.2,0,0,1,0,0,0,2"), "poses.csv, line 2", "no rotation"),
    "poses stop early": (cut_poses, "poses.csv", "poses stop before the frames"),
    "poses of another day": (content("poses.csv", a_day_earlier), "poses.csv", "s; both need one clock"),
    "a packed log": (packed_log, "poses.csv", "can.log.gz is packed by gzip: unpack it"),
    "no bytes": (content("frames.csv", lambda _: b""), "frames.csv, line 1", "is empty; needed are frame,"),
    "a header alone": (
        content("poses.csv", lambda text: text.split(b"\n")[0]),
        "poses.csv",
        "holds no rows",
    ),
    "utf-16": (
        content("poses.csv", lambda text: text.decode().encode("utf-16")),
        "poses.csv",
        "is UTF-16: save it as UTF-8",
    ),
    "utf-16 without its mark": (
        content("poses.csv", lambda text: text.decode().encode("utf-16-le")),
        "poses.csv, line 1",
        "holds NUL bytes: save it as UTF-8 text",
    ),
    "latin-1": (
        content("frames.csv", lambda text: text + b"\xe4"),
        "frames.csv, line 6",
        "byte 0xe4 is no UTF-8",
    ),
    "a NUL byte": (
        line("frames.csv", 3, "1,0.\0001,1,1,100,0.005"),
        "frames.csv, line 3",
        r"timestamp_s = '0.\x001': must be a finite number",
    ),
    "infinite by its digits": (
        line("poses.csv", 4, "1e400,0,0,1,0,0,0,1"),
        "poses.csv, line 4",
        "timestamp_s = '1e400': must be a finite number",
    ),
    "digits that Python alone takes": (
        line("poses.csv", 4, "-0.18,1_0,0,1,0,0,0,1"),
        "poses.csv, line 4",
        "x_mm = '1_0': must be a finite number",
    ),
    "a number without end": (
        line("frames.csv", 3, f"1,{'1' * 1000},1,1,100,0.005"),
        "frames.csv, line 3",
        "1111 …: must be a finite number",
    ),
    "a place beyond the Earth": (
        line("poses.csv", 4, "-0.18,1e300,0,1,0,0,0,1"),
        "poses.csv, line 4",
        "x_mm = 1e+300: is beyond 1e+07 mm",
    ),
    "pose times in ns": (
        line("poses.csv", 4, "1.7e18,0,0,1,0,0,0,1"),
        "poses.csv, line 4",
        "timestamp_s = 1.7e+18: is beyond 1e+11 s; give seconds, not ms or ns",
    ),
    "two poses of one time": (
        content(
            "poses.csv",
            lambda text: b"\n".join(
                [
                    *(rows := text.split(b"\n"))[:3],
                    rows[2].replace(b",", b",9,", 1).rpartition(b",")[0],
                    *rows[3:],
                ]
            ),
        ),
        "poses.csv, line 4",
        "of line 3: one time has two poses",
    ),
    "a frame twice": (
        line("frames.csv", 4, "1,0.15,1,1,100,0.005"),
        "frames.csv, line 4",
        "frame 1 does not come after 1",
    ),
    "a column twice": (
        content("poses.csv", lambda text: text.replace(b"y_mm", b"x_mm", 1)),
        "poses.csv, line 1",
        "the column x_mm occurs twice",
    ),
    "quotes that do not end": (
        line("frames.csv", 3, '1,"0.1,1,1,100,0.005'),
        "frames.csv",
        "is no valid CSV",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("command", ["replay", "inspect"])
def test_it_is_one_line_with_the_place(
    command: str, name: str, recording: Path, tmp_path: Path, refusal: Refusal
) -> None:
    refusal.assert_names_the_place(command, Path(shutil.copytree(recording, tmp_path / "r")), BAD[name])
