"""What a user probably meant: misspelt keys, other formats, other names. The line says what to do."""

import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from made import HEIGHT, WIDTH, level_pose, noise_frames, replace_in, small_setup
from spoiled import Refusal, Spoil, content, gone, line, toml, toml_end

import arctrack
from arctrack.errors import ArctrackError
from arctrack.recording import BadFrame, RecordingWriter, read_recording
from noise_model.setup import Setup
from tracker.state import Frame, Pose


def renamed(names: Iterable[tuple[str, str]]) -> Spoil:
    def rename(path: Path) -> None:
        for old, new in names:
            (path / old).rename(path / new)

    return rename


def frames_as(name: str) -> Spoil:
    return renamed([(f"frames/{n:06d}.png", f"frames/{name.format(n=n)}") for n in range(4)])


def out_of_the_folder(path: Path) -> None:
    renamed([(f"frames/{n:06d}.png", f"{n:06d}.png") for n in range(4)])(path)
    (path / "frames").rmdir()


def images_beside(path: Path) -> None:
    out_of_the_folder(path)
    renamed([(f"{n:06d}.png", f"img{n}.bmp") for n in range(4)])(path)


def video_as(name: str) -> Spoil:
    def put(path: Path) -> None:
        gone("frames")(path)
        (path / name).write_bytes(b"a video")

    return put


HINTS: dict[str, tuple[Spoil, str]] = {
    "a key": (
        toml("kappa_diff", "kapa_diff"),
        "[material] kappa_diff: missing; did you misspell it as kapa_diff?",
    ),
    "a table": (toml("[sensor]", "[senser]"), "[sensor]: missing; did you misspell it as senser?"),
    "a dimension": (
        toml("depth_mm", "dept_mm"),
        "[joint] depth_mm: missing, a v_groove needs it; did you misspell it as dept_mm?",
    ),
    "no key like it": (
        toml("kappa_diff", "reflectance"),
        "[material] kappa_diff: missing; state it: diffuse part of the metal's reflectance",
    ),
    "a joint": (
        toml('"v_groove"', '"vgroove"'),
        "[joint] type = 'vgroove': there is no such joint; did you mean 'v_groove'?",
    ),
    "no joint like it": (
        toml('"v_groove"', '"zigzag"'),
        "there is no such joint; there are flat, v_groove, lap, corrugation, butt, fillet, half_v, "
        "u_groove, edge, outside_corner, free",
    ),
    "jpg": (
        frames_as("{n:06d}.jpg"),
        "000000.jpg is there: arctrack import reads it, though its compression has changed the noise",
    ),
    "heic": (
        frames_as("{n:06d}.heic"),
        "000000.heic is there, but its compression has changed the noise: record PNG",
    ),
    "tif": (frames_as("{n:06d}.tif"), "000000.tif is there: arctrack import reads it"),
    "PNG": (frames_as("{n:06d}.PNG"), "000000.PNG is there: name it 000000.png"),
    "raw": (frames_as("{n:06d}.raw"), "000000.raw is there: make a grey PNG of it, named 000000.png"),
    "four digits of a jpg": (
        frames_as("frame_{n:04d}.JPG"),
        "frame_0000.JPG is there: arctrack import reads it",
    ),
    "four digits": (frames_as("frame_{n:04d}.png"), "frame_0000.png is there: name it 000000.png"),
    "beside the folder": (
        out_of_the_folder,
        "neither this folder nor frames.mkv exists; 000000.png lies beside it: put the PNGs into a folder "
        "frames",
    ),
    "images beside the folder": (
        images_beside,
        "neither this folder nor frames.mkv exists; img0.bmp lies beside it: arctrack import makes a "
        "recording of images",
    ),
    "mp4": (
        video_as("frames.mp4"),
        "frames.mp4 is there: only frames.mkv is read, grey FFV1, since other codecs change the noise",
    ),
    "decimal commas": (
        line("frames.csv", 3, "1,0,1,1,1,100,0,005"),
        "line 3: has 8 values where the header names 6; is the comma a decimal sign? write points",
    ),
    "a quoted decimal comma": (
        line("frames.csv", 3, '1,"0,1",1,1,100,0.005'),
        "line 3: timestamp_s = '0,1': the file writes 0.000000 and 0,1: write all numbers with points",
    ),
    "no header": (
        content("poses.csv", lambda text: text.split(b"\n", 1)[1]),
        "line 1: holds numbers where the header should be: begin the file with "
        "timestamp_s,x_mm,y_mm,z_mm,qx,qy,qz,qw",
    ),
    "a column in ms": (
        content("frames.csv", lambda text: text.replace(b"timestamp_s", b"timestamp_ms")),
        "line 1: the column timestamp_s is missing (there is timestamp_ms); needed are "
        "frame,timestamp_s,laser_on,arc_on,current_a,exposure_s",
    ),
}


@pytest.mark.parametrize("name", HINTS)
def test_the_line_says_what_was_found_and_what_to_do(name: str, recording: Path, tmp_path: Path) -> None:
    spoil, hint = HINTS[name]
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    spoil(path)
    with pytest.raises(ArctrackError) as refusal:
        read_recording(path)
    assert str(refusal.value).endswith(hint)


def test_a_single_frame_that_is_there_as_a_jpeg(recording: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    renamed([("frames/000001.png", "frames/000001.JPG")])(path)
    (bad,) = [frame for frame in read_recording(path).frames() if isinstance(frame, BadFrame)]
    assert bad.problem == (
        "there is no such file, though frames.csv names the frame; 000001.JPG is there: arctrack import "
        "reads it, though its compression has changed the noise"
    )


def test_an_optional_key_that_is_misspelt_is_a_warning(recording: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    toml("hand_eye_deg", "handeye_deg")(path)
    toml_end("[effects.gama]\ngamma = 0.8\n[effects.gamma]\ngama = 0.8\n[weather]\nrain = 1")(path)
    read = read_recording(path)
    file = path / "recording.toml"
    assert set(read.warnings) == {
        f"{file}: [tolerance] handeye_deg is not known and has no effect; did you mean hand_eye_deg?",
        f"{file}: [weather] is not known and has no effect",
        f"{file}: [effects.gama] is not known and has no effect; did you mean gamma?",
        f"{file}: [effects.gamma] gama is not known and has no effect; did you mean gamma?",
    }


@pytest.mark.parametrize(
    ("option", "hint"),
    [
        ("gama.gamma=0.8", "--effect: [effects.gama]: there is no such effect; did you mean 'gamma'?"),
        ("gamma.gama=0.8", "--effect: [effects.gamma] gama: is no parameter of it; did you mean 'gamma'?"),
    ],
)
def test_an_effect_on_the_command_line(option: str, hint: str, tmp_path: Path, refusal: Refusal) -> None:
    assert refusal("simulate", tmp_path / "s", "--effect", option) == hint


WRONG_IMAGES = {
    "is a colour picture, 3 channels: a raw grey frame of 48 x 36 is needed": np.zeros(
        (HEIGHT, WIDTH, 3), np.uint8
    ),
    "has a third axis, 1 channels: a raw grey frame of 48 x 36 is needed": np.zeros(
        (HEIGHT, WIDTH, 1), np.uint8
    ),
    "is 36 x 48, [camera] width and height say 48 x 36; it is turned: swap rows and columns": np.zeros(
        (WIDTH, HEIGHT), np.uint8
    ),
    "is 47 x 36, [camera] width and height say 48 x 36": np.zeros((HEIGHT, WIDTH - 1), np.uint8),
    "has 1 axes: a raw grey frame of 48 x 36 is needed": np.zeros(HEIGHT * WIDTH, np.uint8),
    "holds float64, 64 bits a pixel: [sensor] bits = 8 needs raw codes in uint8": np.zeros((HEIGHT, WIDTH)),
    "holds uint16, 16 bits a pixel: [sensor] bits = 8 needs raw codes in uint8": np.zeros(
        (HEIGHT, WIDTH), np.uint16
    ),
}


@pytest.fixture(scope="module")
def setup() -> Setup:
    return small_setup()


@pytest.mark.parametrize("problem", WRONG_IMAGES)
def test_a_frame_of_another_kind_in_the_api(problem: str, setup: Setup, tmp_path: Path) -> None:
    frame = Frame(7, 0.0, WRONG_IMAGES[problem], 0.005, 100.0)
    with pytest.warns(UserWarning, match=r"^frame 7 ") as told:
        track = arctrack.Tracker(setup).step(frame, Pose(level_pose(0.0)))
    assert [str(warning.message) for warning in told] == [f"frame 7 {problem}"]
    assert told[0].filename == __file__
    assert track.flag_names == ("frame_unreadable",)
    with (
        pytest.raises(ValueError, match=r"^frame 7 ") as refusal,
        RecordingWriter(tmp_path / "r", setup) as writer,
    ):
        writer.write_frame(frame)
    assert str(refusal.value) == f"frame 7 {problem}"


def test_a_right_frame_is_tracked_without_a_word(setup: Setup) -> None:
    (frame,) = noise_frames(setup, 1)
    assert "frame_unreadable" not in arctrack.Tracker(setup).step(frame, Pose(level_pose(0.0))).flag_names


def test_a_word_of_the_text_is_no_hint(recording: Path, tmp_path: Path) -> None:
    """What is there under its right name is not taken for another key, misspelt."""
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    replace_in(path / "recording.toml", "kappa_diff = ", "# kappa_diff = ")
    with pytest.raises(ArctrackError, match=r"kappa_diff: missing; state it: "):
        read_recording(path)
