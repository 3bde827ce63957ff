"""`arctrack import`: raw files become the recording that they came from, or one line says why not."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from made import HEIGHT, WIDTH, replace_in, small_setup
from scipy.spatial.transform import Rotation
from spoiled import Refusal
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.recording import BadFrame, format_setup, read_recording, read_setup_file
from arctrack.recording.ffv1 import VideoWriter
from arctrack.recording.importing import import_recording as run
from noise_model.compiled.arrays import Integers

EXAMPLE = Path(__file__).parents[2] / "examples" / "v_groove"
RUNNER = CliRunner(env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"})


def imported(*arguments: object) -> str:
    done = RUNNER.invoke(app, ["import", *map(str, arguments)])
    assert done.exit_code == 0, done.output
    return done.output


def images_of(recording: Path) -> list[Integers]:
    images = []
    for frame in read_recording(recording).frames():
        assert not isinstance(frame, BadFrame), frame.message
        images.append(frame.image_dn)
    return images


def write_csv(path: Path, header: list[str], rows: list[list[object]]) -> Path:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return path


def exported_poses(path: Path, sequence: str, header: list[str], scale: float, *, degrees: bool) -> Path:
    """Write the example's poses as a controller would: times in ms, angles of a sequence."""
    poses = read_recording(EXAMPLE).poses
    rows = []
    for t, T in zip(poses.timestamps_s, poses.T_base_tool, strict=True):
        angles = Rotation.from_matrix(T[:3, :3]).as_euler(sequence, degrees=degrees)
        rows.append([repr(float(value)) for value in (1e3 * t, *(scale * T[:3, 3]), *angles)])
    return write_csv(path, header, rows)


KUKA = ("ZYX", ["t [ms]", "X", "Y", "Z", "A", "B", "C"], 1.0, True, ["--rotation", "kuka"])
STAUBLI = (
    "XYZ",
    ["t [ms]", "x", "y", "z", "rx", "ry", "rz"],
    1e-3,
    True,
    ["--rotation", "staubli", "--units", "m"],
)
OWN = ("zxy", ["stamp_ms", "a", "b", "c", "rz", "rx", "ry"], 1.0, False, [
    "--rotation", "zxy", "--units", "rad mm", "--column", "x=a", "--column", "y=b", "--column", "z=c"
])  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "poses"), [(".bmp", KUKA), (".tif", STAUBLI), (".png", OWN)], ids=["bmp", "tiff", "png"]
)
def test_the_example_comes_back_from_raw_files(suffix: str, poses: tuple, tmp_path: Path) -> None:
    example = read_recording(EXAMPLE)
    images = images_of(EXAMPLE)
    (tmp_path / "raw").mkdir()
    for row, image_dn in zip(example.rows, images, strict=True):
        cv2.imwrite(str(tmp_path / "raw" / f"shot{row.index}{suffix}"), image_dn)
    conditions = [
        [
            row.index,
            f"{1e3 * row.timestamp_s:.3f}",
            int(row.laser_on),
            int(row.arc_on),
            row.current_a,
            1e6 * row.exposure_s,
        ]
        for row in reversed(example.rows)
    ]
    header = ["frame", "time_ms", "laser", "arc", "current", "exposure_us"]
    frames = write_csv(tmp_path / "frames.csv", header, conditions)
    sequence, names, scale, degrees, options = poses
    robot = exported_poses(tmp_path / "robot.csv", sequence, names, scale, degrees=degrees)
    out = tmp_path / "back"
    said = imported(
        tmp_path / "raw", "--setup", EXAMPLE, "--poses", robot, "--frames", frames, "--out", out, *options
    )
    assert f"{out}: 24 frames, {len(example.poses.timestamps_s)} poses\nNext: arctrack check {out}\n" in said
    back = read_recording(out)
    assert back.rows == example.rows
    for image_dn, original in zip(images_of(out), images, strict=True):
        np.testing.assert_array_equal(image_dn, original)
    np.testing.assert_array_equal(back.poses.timestamps_s, example.poses.timestamps_s)
    np.testing.assert_allclose(back.poses.T_base_tool, example.poses.T_base_tool, atol=1e-9, rtol=0.0)
    assert (out / "recording.toml").read_bytes() == (EXAMPLE / "recording.toml").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["back", "frames.csv", "raw", "robot.csv"]


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """Return a folder of three small grey images, their setup and three poses as KUKA writes them."""
    (tmp_path / "photos").mkdir()
    for n in range(3):
        cv2.imwrite(str(tmp_path / "photos" / f"img_{n + 9}.png"), small_image(n))
    (tmp_path / "recording.toml").write_text(format_setup(small_setup()))
    rows: list[list[object]] = [[8.0 * n, 0, 501, 10, 0, 0] for n in range(3)]
    write_csv(tmp_path / "robot.csv", ["X", "Y", "Z", "A", "B", "C"], rows)
    return tmp_path


def small_image(seed: int, *shape: int) -> Integers:
    return np.random.default_rng(seed).integers(0, 256, shape or (HEIGHT, WIDTH), dtype=np.uint8)


def arguments(raw: Path, *more: object, rate: bool = True) -> list[object]:
    rate_hz = ["--rate-hz", 10] if rate else []
    files = [raw / "photos", "--setup", raw / "recording.toml", "--poses", raw / "robot.csv"]
    return [*files, "--rotation", "kuka", *rate_hz, "--out", raw / "out", *more]


def test_a_pose_an_image_is_the_pose_of_each(raw: Path) -> None:
    said = imported(*arguments(raw))
    recording = read_recording(raw / "out")
    assert [row.index for row in recording.rows] == [9, 10, 11]
    assert [row.timestamp_s for row in recording.rows] == [0.0, 0.1, 0.2]
    assert {row.condition for row in recording.rows} == {(True, False, 0.0, small_setup().camera.exposure_s)}
    buffer = recording.pose_buffer()
    for n, row in enumerate(recording.rows):
        pose = recording.pose_at(buffer, row.timestamp_s)
        assert pose is not None
        np.testing.assert_allclose(pose.T_base_tool[:3, 3], [8.0 * n, 0.0, 501.0], atol=1e-9)
    assert (
        "laser_on 1, arc_on 0, current_a 0 (no --current-a), exposure_s 0.005 (that of [camera]) in all"
        in said
    )
    assert "3 in mm, deg, one an image" in said


def test_a_missing_image_leaves_its_time(raw: Path) -> None:
    (raw / "photos" / "img_11.png").rename(raw / "photos" / "img_13.png")
    said = imported(*arguments(raw, "--current-a", 120, "--exposure-s", 0.002))
    recording = read_recording(raw / "out")
    assert [row.timestamp_s for row in recording.rows] == [0.0, 0.1, 0.4]
    assert {row.condition for row in recording.rows} == {(True, True, 120.0, 0.002)}
    assert "2 numbers are missing: 11 to 12" in said


def test_times_stand_in_names(raw: Path) -> None:
    for n, time in enumerate(("12.5", "12.25", "13.125")):
        (raw / "photos" / f"img_{n + 9}.png").rename(raw / "photos" / f"cam_{time}.png")
    imported(*arguments(raw, "--times-in-names", "--units", "s", rate=False))
    assert [row.timestamp_s for row in read_recording(raw / "out").rows] == [12.25, 12.5, 13.125]
    np.testing.assert_array_equal(images_of(raw / "out")[0], small_image(1))


def test_times_of_another_unit_are_refused(raw: Path, refusal: Refusal) -> None:
    for n in range(3):
        (raw / "photos" / f"img_{n + 9}.png").rename(raw / "photos" / f"{14 * 10**17 + n * 10**8}.png")
    options = arguments(raw, "--times-in-names", "--units", "s", rate=False)
    assert "1.4e+18 s, by the times in the names, is beyond 1e+11 s" in refusal("import", *options)


def test_times_stand_beside_the_poses(raw: Path) -> None:
    rows: list[list[object]] = [[f"img_{n + 9}.png", 1.5 + n, 8.0 * n, 0, 501, 10, 0, 0] for n in (1, 0, 2)]
    rows.sort(key=lambda row: float(str(row[1])))
    write_csv(raw / "robot.csv", ["File", "t_s", "X", "Y", "Z", "A", "B", "C"], rows)
    imported(*arguments(raw, rate=False))
    assert [row.timestamp_s for row in read_recording(raw / "out").rows] == [1.5, 2.5, 3.5]


def test_a_colour_becomes_grey(raw: Path) -> None:
    colours = [small_image(n, HEIGHT, WIDTH, 3) for n in range(3)]
    for n, image in enumerate(colours):
        cv2.imwrite(str(raw / "photos" / f"img_{n + 9}.png"), image)
    assert "red of the colours (the laser has 690 nm)" in imported(*arguments(raw))
    np.testing.assert_array_equal(images_of(raw / "out")[1], colours[1][..., 2])
    shutil.rmtree(raw / "out")
    imported(*arguments(raw, "--channel", "green"))
    np.testing.assert_array_equal(images_of(raw / "out")[1], colours[1][..., 1])


def test_jpegs_are_read_with_a_warning(raw: Path) -> None:
    smooth = np.add.outer(np.arange(HEIGHT), np.arange(WIDTH)).astype(np.uint8)
    for n in range(3):
        (raw / "photos" / f"img_{n + 9}.png").unlink()
        cv2.imwrite(str(raw / "photos" / f"img_{n + 9}.jpg"), smooth)
    assert "img_9.jpg: JPEG has changed the noise" in imported(*arguments(raw))
    np.testing.assert_allclose(images_of(raw / "out")[0].astype(int), smooth.astype(int), atol=2)


def test_a_mosaic_gives_its_red_sites_and_their_camera(raw: Path) -> None:
    setup = read_setup_file(raw / "recording.toml").setup
    said = imported(*arguments(raw, "--bayer", "GBRG"))
    recording = read_recording(raw / "out")
    np.testing.assert_array_equal(images_of(raw / "out")[2], small_image(2)[1::2, ::2])
    camera, mosaic = recording.setup.camera, setup.camera
    assert (camera.width, camera.height) == (WIDTH // 2, HEIGHT // 2)
    assert (camera.fx, camera.cx, camera.cy) == (mosaic.fx / 2, mosaic.cx / 2, (mosaic.cy - 1) / 2)
    assert recording.setup.sensor == setup.sensor
    assert "red sites of GBRG, 24 x 18 px; [camera] of the mosaic made theirs: fx" in said
    # A setup of the sites themselves stays as it is.
    shutil.copy(raw / "out" / "recording.toml", raw / "recording.toml")
    shutil.rmtree(raw / "out")
    assert "24 x 18 px, the size of [camera]" in imported(*arguments(raw, "--bayer", "GBRG"))
    assert read_recording(raw / "out").setup.camera.cx == camera.cx


def test_sixteen_bits_are_kept(raw: Path) -> None:
    (raw / "recording.toml").write_text(format_setup(small_setup(12)))
    images = [np.random.default_rng(n).integers(0, 4096, (HEIGHT, WIDTH), np.uint16) for n in range(3)]
    for n, image in enumerate(images):
        (raw / "photos" / f"img_{n + 9}.png").unlink()
        cv2.imwrite(str(raw / "photos" / f"img_{n + 9}.tiff"), image)
    imported(*arguments(raw))
    np.testing.assert_array_equal(images_of(raw / "out"), images)


def test_a_log_that_begins_with_the_first_image_reaches_it(raw: Path) -> None:
    rows: list[list[object]] = [[0.1 * n, 8.0 * n, 0, 501, 10, 0, 0] for n in range(3)]
    write_csv(raw / "robot.csv", ["time", "X", "Y", "Z", "A", "B", "C"], rows)
    imported(*arguments(raw, "--units", "s"))
    recording = read_recording(raw / "out")
    assert recording.poses.timestamps_s.tolist() == [-0.1, 0.0, 0.1, 0.2]
    assert recording.pose_at(recording.pose_buffer(), 0.0) is not None


def test_matrices_are_poses_of_images(raw: Path) -> None:
    (raw / "T.txt").write_text("".join(f"1 0 0 {n}\n0 0 -1 0\n0 1 0 0.5\n0 0 0 1\n" for n in range(3)))
    files = [
        raw / "photos",
        "--setup",
        raw / "recording.toml",
        "--poses",
        raw / "T.txt",
        "--out",
        raw / "out",
    ]
    said = imported(*files, "--rotation", "matrix", "--units", "m", "--rate-hz", 2)
    poses = read_recording(raw / "out").poses
    assert poses.timestamps_s.tolist() == [-0.5, 0.0, 0.5, 1.0]
    np.testing.assert_allclose(poses.T_base_tool[3, :3, 3], [2000.0, 0.0, 500.0])
    np.testing.assert_allclose(poses.T_base_tool[0, :3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-9)
    assert "3 in m, one an image" in said


def test_an_arc_that_is_on_takes_the_stated_current(raw: Path) -> None:
    (raw / "f.csv").write_text("arc_on\n0\n1\n1\n")
    said = imported(*arguments(raw, "--frames", raw / "f.csv", "--current-a", 90))
    assert [row.current_a for row in read_recording(raw / "out").rows] == [0.0, 90.0, 90.0]
    assert f"in all; as {raw / 'f.csv'} states" in said


def test_a_current_says_that_the_arc_is_on(raw: Path) -> None:
    (raw / "f.csv").write_text("Current_A,Exposure [us]\n0,500\n120,500\n,250\n")
    imported(*arguments(raw, "--frames", raw / "f.csv"))
    rows = read_recording(raw / "out").rows
    assert [row.arc_on for row in rows] == [False, True, False]
    assert [row.exposure_s for row in rows] == [0.0005, 0.0005, 0.00025]


def test_a_grey_video_is_read(raw: Path) -> None:
    with VideoWriter(raw / "scan.mkv", WIDTH, HEIGHT, np.uint8, 25.0) as video:
        for n in range(3):
            video.write(small_image(n), 0.04 * n)
    said = imported(raw / "scan.mkv", *arguments(raw)[1:])
    assert "3, scan.mkv frame 0 to scan.mkv frame 2" in said
    np.testing.assert_array_equal(images_of(raw / "out"), [small_image(n) for n in range(3)])


def test_what_does_not_fit_together_is_kept_with_a_warning(raw: Path) -> None:
    """`arctrack check` can say what is wrong with it, and nothing else could."""
    rows: list[list[object]] = [[900.0 + n, 8.0 * n, 0, 501, 10, 0, 0] for n in range(3)]
    write_csv(raw / "robot.csv", ["t_s", "X", "Y", "Z", "A", "B", "C"], rows)
    assert "warning: " in (said := imported(*arguments(raw)))
    assert "the poses start after the frames" in said
    assert (raw / "out" / "frames.csv").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("scan.avi", "scan.avi: only grey FFV1 in .mkv is read; export the frames of other videos as PNG"),
        ("scan.mkv", "scan.mkv: cannot be read as a video"),
        ("scan.txt", "scan.txt: is no JPEG, PNG, BMP or TIFF"),
    ],
)
def test_a_source_that_is_neither_images_nor_video(name: str, line: str, raw: Path, refusal: Refusal) -> None:
    (raw / name).write_bytes(b"something else")
    options = ["--poses", raw / "one.csv"]
    write_csv(raw / "one.csv", ["X", "Y", "Z", "A", "B", "C"], [[1, 2, 503, 10, 0, 0]])
    assert line in refusal("import", raw / name, *arguments(raw)[1:], *options)


def image(name: str, pixels: Integers):
    def put(raw: Path) -> None:
        cv2.imwrite(str(raw / "photos" / name), pixels)

    return put


def text(name: str, content: str):
    return lambda raw: (raw / name).write_text(content) and None


def cut(raw: Path) -> None:
    path = raw / "photos" / "img_10.png"
    path.write_bytes(path.read_bytes()[:300])


def setup_with(old: str, new: str):
    return lambda raw: replace_in(raw / "recording.toml", old, new)


def nothing(raw: Path) -> None:
    pass


def there_already(raw: Path) -> None:
    (raw / "out").mkdir()
    (raw / "out" / "mine.txt").write_text("mine")


def with_bits(raw: Path) -> None:
    (raw / "recording.toml").write_text(format_setup(small_setup(12)))
    shifted = 16 * np.random.default_rng(0).integers(0, 4096, (HEIGHT, WIDTH), np.uint16)
    for n in (9, 10, 11):
        cv2.imwrite(str(raw / "photos" / f"img_{n}.png"), shifted)


def with_few_bits_used(raw: Path) -> None:
    with_bits(raw)
    dark = 16 * np.random.default_rng(0).integers(0, 200, (HEIGHT, WIDTH), np.uint16)
    cv2.imwrite(str(raw / "photos" / "img_9.png"), dark)


def with_effect(raw: Path) -> None:
    with (raw / "recording.toml").open("a") as file:
        file.write("\n[effects.defocus]\nsigma_px = 1.0\n")


BAD = {
    "truncated": (cut, [], "photos/img_10.png: is truncated after 300 bytes"),
    "another size": (
        image("img_10.png", small_image(0, 20, 30)),
        [],
        f"photos/img_10.png: is 30 x 20 px, [camera] width and height are {WIDTH} x {HEIGHT}",
    ),
    "turned": (image("img_10.png", small_image(0, WIDTH, HEIGHT)), [], "it is turned: swap rows and columns"),
    "other bits": (
        image("img_11.png", np.zeros((HEIGHT, WIDTH), np.uint16)),
        [],
        "photos/img_11.png: holds uint16, 16 bits a pixel: [sensor] bits = 8 needs",
    ),
    "shifted bits": (
        with_bits,
        [],
        "[sensor] bits = 12 ends at 4095; its levels are multiples of 16: state bits = 16",
    ),
    "shifted bits of a dark image": (
        with_few_bits_used,
        [],
        "img_9.png: holds 3184 DN, [sensor] bits = 12 ends at 4095; its levels are multiples of 16",
    ),
    "a mosaic in colour": (
        image("img_10.png", small_image(0, HEIGHT, WIDTH, 3)),
        ["--bayer", "RGGB"],
        "photos/img_10.png: has colours: a mosaic is grey; leave --bayer out",
    ),
    "a mosaic's luminance": (
        nothing,
        ["--bayer", "RGGB", "--channel", "luminance"],
        "--channel luminance: a mosaic's sites have one colour",
    ),
    "an effect in px": (
        with_effect,
        ["--bayer", "RGGB"],
        "recording.toml: [effects.defocus] sigma_px is in px of the whole mosaic",
    ),
    "two series": (
        image("ref_1.png", small_image(0)),
        [],
        "are of two series, and nothing says which comes first",
    ),
    "the poses' count": (
        text("robot.csv", "X,Y,Z,A,B,C\n1,2,500,10,0,0\n"),
        [],
        "robot.csv: has 1 rows for 3 images: add a column time, file or frame",
    ),
    "a setup's key": (
        setup_with("kappa_diff", "kapa_diff"),
        [],
        "recording.toml: [material] kappa_diff: missing",
    ),
    "there already": (there_already, [], "exists already; remove it or choose another name"),
    "a column": (nothing, ["--column", "x=TCP_X"], "--column x=TCP_X: no file has a column of this name"),
    "a column's role": (
        nothing,
        ["--column", "rx=X"],
        "--column rx=X: rx is not known; there are x, y, z, a, b, c, time",
    ),
    "a column's form": (nothing, ["--column", "x"], "--column x: give NAME=COLUMN, such as x=tcp_x"),
    "translations": (
        nothing,
        ["--translations", "t.txt"],
        "--translations: has no effect with --rotation kuka",
    ),
    "a rate": (nothing, ["--rate-hz", "0"], "--rate-hz 0: must be from 0.0001 to 100000"),
    "an exposure": (nothing, ["--exposure-s", "0"], "--exposure-s 0: must be from 1e-09 to 3600"),
    "two times": (
        text("f.csv", "time_s\n1\n2\n3\n"),
        ["--frames", "f.csv"],
        "the times of f.csv and --rate-hz 10 both state the images' times; leave one of them",
    ),
    "no condition": (
        text("f.csv", "speed\n1\n2\n3\n"),
        ["--frames", "f.csv"],
        "f.csv: has none of the columns time, frame, file, laser_on, arc_on, current_a",
    ),
    "a switch": (
        text("f.csv", "laser_on\n1\n2\n1\n"),
        ["--frames", "f.csv"],
        "f.csv, line 3: laser_on = '2': must be a whole number from 0 to 1",
    ),
    "an exposure's unit": (
        text("f.csv", "exposure\n1\n2\n1\n"),
        ["--frames", "f.csv"],
        "f.csv: the column exposure states no unit: give --units s or ms or us or ns",
    ),
    "an exposure's size": (
        text("f.csv", "exposure_s\n1\n1\n0\n"),
        ["--frames", "f.csv"],
        "f.csv, line 4: exposure_s = 0: must be > 0",
    ),
    "two exposures": (
        text("f.csv", "exposure_s\n1\n1\n1\n"),
        ["--frames", "f.csv", "--exposure-s", "0.01"],
        "--exposure-s 0.01: --frames states it image by image; leave one of them",
    ),
    "names without times": (
        nothing,
        ["--times-in-names"],
        "--times-in-names: names state no unit: give --units s, ms, us or ns",
    ),
    "matrices without a unit": (
        nothing,
        ["--rotation", "matrix"],
        "robot.csv: states no unit: give --units mm or m",
    ),
}


@pytest.mark.parametrize(("spoil", "options", "line"), BAD.values(), ids=BAD)
def test_what_is_wrong_is_one_line_and_leaves_nothing(
    spoil, options: list[str], line: str, raw: Path, refusal: Refusal, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil(raw)
    monkeypatch.chdir(raw)
    before = sorted(raw.rglob("*"))
    assert line in refusal("import", *arguments(raw, *options))
    assert sorted(raw.rglob("*")) == before


def test_no_times_at_all(raw: Path, refusal: Refusal) -> None:
    said = refusal("import", *arguments(raw, rate=False))
    assert (
        "img_9.png: nothing states the images' times; give --rate-hz, --times-in-names, or --frames" in said
    )


def test_an_interrupt_leaves_nothing(raw: Path) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    before = sorted(raw.rglob("*"))
    with pytest.raises(KeyboardInterrupt):
        run.import_recording(
            run.ImportSources(
                [raw / "photos"], raw / "recording.toml", raw / "robot.csv", rotation="kuka", rate_hz=10.0
            ),
            raw / "out",
            on_frame=stop,
        )
    assert sorted(raw.rglob("*")) == before
