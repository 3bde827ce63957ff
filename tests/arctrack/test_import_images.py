"""Images of all kinds made grey: their order, their codecs, colours and mosaics."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made import small_setup
from PIL import Image
from spoiled import png

from arctrack.errors import ArctrackError
from arctrack.recording.importing.colours import Bayer, Channel
from arctrack.recording.importing.grey import camera_of_sites, channel_of_laser, grey, sites
from arctrack.recording.importing.image_decoder import EncodedImage
from arctrack.recording.importing.image_files import distinct_names, find_images
from noise_model.compiled.arrays import Integers

RNG = np.random.default_rng(5)
GREY8, GREY16 = RNG.integers(0, 256, (9, 14), np.uint8), RNG.integers(0, 65536, (9, 14), np.uint16)
COLOUR8, COLOUR16 = RNG.integers(0, 256, (9, 14, 3), np.uint8), RNG.integers(0, 65536, (9, 14, 3), np.uint16)
ALPHA8 = RNG.integers(0, 256, (9, 14, 4), np.uint8)


def touched(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).write_bytes(b"")
    return folder


def names_of(folder: Path, *names: str) -> tuple[list[str], tuple[int, ...], tuple[str, ...]]:
    series = find_images([touched(folder, *names)])
    return [path.name for path in series.paths], series.indices, series.notes


def test_numbers_are_compared_as_numbers(tmp_path: Path) -> None:
    mixed = ["img_10.PNG", "img_2.png", "img_1.jpg", ".img_3.png", "img_4.txt"]
    assert names_of(tmp_path, *mixed) == (
        ["img_1.jpg", "img_2.png", "img_10.PNG"],
        (1, 2, 10),
        ("7 numbers are missing: 3 to 9",),
    )


@pytest.mark.slow
@settings(max_examples=20)
@given(numbers=st.lists(st.integers(0, 10**6), min_size=2, max_size=30, unique=True))
def test_any_numbers_come_in_their_order(
    numbers: list[int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("series")
    series = find_images([touched(folder, *(f"run2_{number}_raw.bmp" for number in numbers))])
    assert series.indices == tuple(sorted(numbers))
    assert [path.name for path in series.paths] == [f"run2_{n}_raw.bmp" for n in sorted(numbers)]


@pytest.mark.parametrize(
    ("names", "indices", "notes"),
    [
        (["a_20.tif", "a_30.tif", "a_40.tif"], (20, 30, 40), ("the numbers go up by 10",)),
        (["a_001.tif", "a_003.tif", "a_004.tif"], (1, 3, 4), ("1 numbers are missing: 2",)),
        (["photo.tif"], (0,), ("frames are counted from 0: their names hold no number",)),
        (["d3_17.tif"], (17,), ()),
        (
            ["1403636579763555584.png", "1403636579813555456.png"],
            (0, 1),
            ("frames are counted from 0: their names hold times or dates",),
        ),
        (
            ["05-59-59_9.png", "06-00-00_1.png"],
            (0, 1),
            ("frames are counted from 0: their names hold times or dates",),
        ),
    ],
)
def test_a_number_is_the_frames_where_it_can_be(
    names: list[str], indices: tuple[int, ...], notes: tuple[str, ...], tmp_path: Path
) -> None:
    assert names_of(tmp_path, *reversed(names)) == (names, indices, notes)


@pytest.mark.parametrize(
    ("names", "line"),
    [
        ([], "holds no image: .bmp, .jpeg, .jpg, .png, .tif, .tiff are read"),
        (
            ["a_1.png", "b_2.png"],
            "a_1.png and b_2.png are of two series, and nothing says which comes first; ",
        ),
        (["a_1.png", "a_01.png"], "a_1.png: has the number of a_01.png; leave one of them out"),
        (["a_1.png", "a_1.jpg"], "a_1.png: has the number of a_1.jpg"),
    ],
)
def test_images_without_an_order(names: list[str], line: str, tmp_path: Path) -> None:
    with pytest.raises(ArctrackError) as refused:
        find_images([touched(tmp_path, *names)])
    assert line in str(refused.value)


def test_sources_are_folders_files_and_patterns(tmp_path: Path) -> None:
    touched(tmp_path, "a_1.png", "a_2.png", "b_1.png")
    for sources in ([tmp_path / "a_*.png"], [tmp_path / "a_2.png", tmp_path / "a_1.png"]):
        assert [path.name for path in find_images(sources).paths] == ["a_1.png", "a_2.png"]
    for source, line in (
        ("c_*.png", "no file fits this pattern"),
        ("c.png", "there is no such file or folder"),
    ):
        with pytest.raises(ArctrackError, match=line):
            find_images([tmp_path / source])


def encoded(pixels: Integers, suffix: str, *parameters: int) -> bytes:
    done, content = cv2.imencode(suffix, pixels, parameters)
    assert done
    return content.tobytes()


def by_pillow(image: Image.Image, kind: str, **options: object) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def read(content: bytes, folder: Path) -> Integers:
    (folder / "image").write_bytes(content)
    return EncodedImage(folder / "image").pixels()


LOSSLESS = {
    f"{suffix}, {pixels.dtype}, {pixels.shape[2:]}": (encoded(pixels, suffix), pixels)
    for suffix, kinds in {
        ".png": (GREY8, GREY16, COLOUR8, COLOUR16, ALPHA8),
        ".bmp": (GREY8, COLOUR8),
        ".tif": (GREY8, GREY16, COLOUR8, COLOUR16),
    }.items()
    for pixels in kinds
}


@pytest.mark.parametrize(("content", "pixels"), LOSSLESS.values(), ids=LOSSLESS)
def test_pixels_of_exact_codecs_come_as_they_are(content: bytes, pixels: Integers, tmp_path: Path) -> None:
    np.testing.assert_array_equal(read(content, tmp_path), pixels)
    assert not EncodedImage(tmp_path / "image").is_lossy
    assert EncodedImage(tmp_path / "image").has_colours == (pixels.ndim == 3)


def test_a_jpeg_is_near_and_is_not_turned(tmp_path: Path) -> None:
    smooth = np.add.outer(np.arange(24), 4 * np.arange(16)).astype(np.uint8)
    exif = Image.Exif()
    exif[274] = 6
    content = by_pillow(Image.fromarray(smooth), "JPEG", quality=98, exif=exif)
    np.testing.assert_allclose(read(content, tmp_path).astype(int), smooth.astype(int), atol=2)
    assert EncodedImage(tmp_path / "image").is_lossy


def test_equal_names_are_told_apart_by_their_folders() -> None:
    paths = [Path("a/1.png"), Path("b/1.png"), Path("a/2.png"), Path("c/b/1.png")]
    assert [*distinct_names(paths).values()] == ["a/1.png", "b/1.png", "2.png", "c/b/1.png"]


def test_a_palette_gives_its_colours(tmp_path: Path) -> None:
    image = Image.fromarray(COLOUR8[..., ::-1]).quantize(7)
    np.testing.assert_array_equal(
        read(by_pillow(image, "PNG"), tmp_path), np.asarray(image.convert("RGB"))[..., ::-1]
    )


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".tif"])
@pytest.mark.parametrize("share", [0.3, 0.7, 0.97])
def test_a_truncated_image_is_refused(
    suffix: str, share: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    content = encoded(RNG.integers(0, 256, (40, 60), np.uint8), suffix)
    with pytest.raises(ArctrackError, match=r"image: is (truncated|no JPEG, PNG, BMP or TIFF)"):
        read(content[: int(share * len(content))], tmp_path)
    assert capfd.readouterr() == ("", "")


def two_pages() -> bytes:
    first, second = Image.fromarray(GREY8), Image.fromarray(GREY8)
    return by_pillow(first, "TIFF", save_all=True, append_images=[second])


def spoiled_png() -> bytes:
    content = bytearray(encoded(GREY8, ".png"))
    content[60] ^= 1
    return bytes(content)


UNFIT = {
    "empty": (b"", "image: is empty"),
    "text": (b"no image", "image: is no JPEG, PNG, BMP or TIFF, or its header is damaged"),
    "another format": (by_pillow(Image.fromarray(COLOUR8), "GIF"), "is no JPEG, PNG, BMP or TIFF"),
    "one bit": (
        by_pillow(Image.fromarray(GREY8).convert("1"), "TIFF"),
        "its tag BitsPerSample = 1: save it with 8 or 16",
    ),
    "four bits": (png(14, 9, bits=4), "has 4 bits a pixel: grey levels of 8 or 16 are needed"),
    "print colours": (
        by_pillow(Image.fromarray(COLOUR8).convert("CMYK"), "JPEG"),
        "holds pixels of kind CMYK",
    ),
    "float": (encoded(GREY8.astype(np.float32), ".tif"), "tag BitsPerSample = 32: save it with 8 or 16"),
    "pages": (two_pages(), "holds several images: save each as a file of its own"),
    "turned": (
        by_pillow(Image.fromarray(GREY8), "TIFF", tiffinfo={274: 6}),
        "its tag Orientation = 6: it is turned",
    ),
    "a checksum": (spoiled_png(), "is damaged: the checksum of its 'IDAT' chunk is wrong"),
    "too wide": (png(17_000, 10), "17000 x 10 px: a side has 16384 px at most"),
    "too large": (png(16_000, 16_000), "is too large: 16.8 million px are the most"),
}


@pytest.mark.parametrize(("content", "line"), UNFIT.values(), ids=UNFIT)
def test_what_is_no_image_is_refused_by_its_header(content: bytes, line: str, tmp_path: Path) -> None:
    with pytest.raises(ArctrackError) as refused:
        read(content, tmp_path)
    assert line in str(refused.value)


def test_a_file_that_is_missing_or_too_large(tmp_path: Path) -> None:
    with pytest.raises(ArctrackError, match="there is no such file"):
        EncodedImage(tmp_path / "none.png")
    with (tmp_path / "large.bmp").open("wb") as file:
        file.truncate(2**28)
    with pytest.raises(ArctrackError, match=r"has 268\.4 MB: 135\.3 MB is the most"):
        EncodedImage(tmp_path / "large.bmp")


def test_one_colour_becomes_grey() -> None:
    for channel, place in {Channel.BLUE: 0, Channel.GREEN: 1, Channel.RED: 2}.items():
        np.testing.assert_array_equal(grey(COLOUR16, channel), COLOUR16[..., place])
        np.testing.assert_array_equal(grey(ALPHA8, channel), ALPHA8[..., place])
        np.testing.assert_array_equal(grey(GREY8, channel), GREY8)
    for pixels in (COLOUR8, ALPHA8, COLOUR16):
        luminance = pixels[..., :3] @ np.array([0.114, 0.587, 0.299])
        np.testing.assert_allclose(
            grey(pixels, Channel.LUMINANCE), luminance, atol=0.51 + 1e-4 * luminance.max()
        )


@pytest.mark.parametrize(
    ("wavelength_nm", "channel"),
    [
        (450.0, Channel.BLUE),
        (520.0, Channel.GREEN),
        (650.0, Channel.RED),
        (690.0, Channel.RED),
        (850.0, Channel.RED),
    ],
)
def test_the_lasers_colour_is_taken(wavelength_nm: float, channel: Channel) -> None:
    setup = small_setup()
    assert (
        channel_of_laser(replace(setup, laser=replace(setup.laser, wavelength_nm=wavelength_nm))) is channel
    )


@pytest.mark.parametrize("bayer", Bayer)
def test_the_sites_of_a_colour_are_taken_as_they_are(bayer: Bayer) -> None:
    """A mosaic is painted site by site from its name, each colour with levels of its own."""
    levels = {"R": 100, "G": 50, "B": 20}
    mosaic = np.array(
        [[levels[bayer[2 * (y % 2) + x % 2]] for x in range(7)] for y in range(5)], dtype=np.uint8
    )
    for channel, letter in {Channel.RED: "R", Channel.GREEN: "G", Channel.BLUE: "B"}.items():
        taken = sites(mosaic, bayer, channel)
        assert set(taken.ravel().tolist()) == {levels[letter]}
        setup = small_setup()
        odd = replace(setup, camera=replace(setup.camera, width=7, height=5))
        keys = camera_of_sites(odd, bayer, channel)
        assert taken.shape == (keys["height"], keys["width"])


@pytest.mark.slow
@settings(max_examples=20)
@given(x=st.floats(-0.2, 0.2), y=st.floats(-0.15, 0.15))
@pytest.mark.parametrize("bayer", Bayer)
def test_a_ray_meets_the_site_that_lies_where_its_pixel_was(bayer: Bayer, x: float, y: float) -> None:
    camera = small_setup().camera
    keys = camera_of_sites(small_setup(), bayer, Channel.RED)
    row, column = divmod(bayer.value.index("R"), 2)
    u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
    assert 2.0 * (keys["fx"] * x + keys["cx"]) + column == pytest.approx(u)
    assert 2.0 * (keys["fy"] * y + keys["cy"]) + row == pytest.approx(v)
    assert keys["psf_sigma_px"] == pytest.approx(0.5 * camera.psf_sigma_px)
