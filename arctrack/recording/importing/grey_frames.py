"""Grey frames of images or of a video, each held against the setup; and the setup of a mosaic's sites."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.recording import SetupFile, ffv1
from arctrack.recording.importing.colours import Bayer, Channel
from arctrack.recording.importing.grey import camera_of_sites, channel_of_laser, grey, sites
from arctrack.recording.importing.image_decoder import EncodedImage
from arctrack.recording.importing.image_files import ImageSeries
from arctrack.recording.setup_file import parse_setup, setup_text, with_camera_keys
from noise_model.compiled.arrays import Integers
from noise_model.effects import acting
from noise_model.setup import Setup
from tracker.state import frame_misfit


@dataclass(frozen=True)
class GreyFrames:
    """Conversion of an image series to grey frames, and the setup that they fit.

    `toml` is the text of `setup`; `size` is the required (width, height); `has_colours` is that of the first
    image. `doubts` are warnings by image; `taken_s` are the capture times by tags. `is_converted` says that
    `[camera]` is no longer the stated one.
    """

    series: ImageSeries
    channel: Channel
    bayer: Bayer | None
    size: tuple[int, int]
    setup: Setup
    toml: str
    has_colours: bool
    doubts: dict[str, list[Path]] = field(default_factory=dict)
    taken_s: list[float] = field(default_factory=list)
    is_converted: bool = False

    @property
    def note(self) -> str:
        """Description of how the grey levels are made."""
        camera = self.setup.camera
        if self.bayer is None:
            why = f"the laser has {self.setup.laser.wavelength_nm:g} nm"
            return f"{self.channel.value} of the colours ({why})" if self.has_colours else "as it is"
        note = f"{self.channel.value} sites of {self.bayer.value}, {camera.width} x {camera.height} px"
        if not self.is_converted:
            return f"{note}, the size of [camera]"
        lens = f"fx {camera.fx:.6g}, fy {camera.fy:.6g}, cx {camera.cx:.6g}, cy {camera.cy:.6g} px"
        return f"{note}; [camera] of the mosaic made theirs: {lens}"

    @property
    def warnings(self) -> list[str]:
        """Warnings about the images that were read, a line each."""
        return [
            f"{paths[0]}: {doubt}"
            + (f"; the same holds for {len(paths) - 1} more images" if len(paths) > 1 else "")
            for doubt, paths in self.doubts.items()
        ]

    def __iter__(self) -> Iterator[Integers]:
        """Yield the frames' grey levels (H, W); ArctrackError names the image that does not fit."""
        if self.series.video is not None:
            yield from self._of_video(self.series.video)
            return
        for path in self.series.paths:
            image = EncodedImage(path)
            self._check_size(image.size, path)
            self.taken_s.append(image.taken_s)
            for doubt in image.doubts:
                self.doubts.setdefault(doubt, []).append(path)
            yield self._grey(image.pixels(), path)

    def _of_video(self, video: Path) -> Iterator[Integers]:
        self._check_size(ffv1.grey_size(video), video)
        names = self.series.paths
        for name, image in zip(names, ffv1.read_video(video, range(len(names))), strict=True):
            if isinstance(image, str):
                raise in_file(video, image)
            yield self._grey(image, name)

    def _grey(self, pixels: Integers, path: Path) -> Integers:
        if self.bayer is None:
            image_dn = grey(pixels, self.channel)
        elif pixels.ndim > 2:
            raise in_file(path, "has colours: a mosaic is grey; leave --bayer out")
        else:
            image_dn = sites(pixels, self.bayer, self.channel)
        misfit = frame_misfit(image_dn.shape, image_dn.dtype, self.setup) or _too_bright(image_dn, self.setup)
        if misfit is not None:
            raise in_file(path, misfit)
        return image_dn

    def _check_size(self, size: tuple[int, int], path: Path) -> None:
        if size == self.size:
            return
        width, height = self.size
        turned = "; it is turned: swap rows and columns" if size == (height, width) else ""
        what = "[camera] width and height are" if self.bayer is None else "a mosaic has"
        raise in_file(path, f"is {size[0]} x {size[1]} px, {what} {width} x {height}{turned}")


def grey_frames(
    series: ImageSeries, stated: SetupFile, channel: Channel | None, bayer: Bayer | None
) -> GreyFrames:
    """Return the conversion of a series to grey frames under a setup.

    A setup of the whole mosaic's size becomes that of its sites; one of the sites' size stays.

    Raises ArctrackError for the luminance of a mosaic, and for an effect that is stated in px of one.
    """
    setup = stated.setup
    channel = channel or channel_of_laser(setup)
    text = setup_text(stated.path)
    size, has_colours = _first(series)
    height, width = setup.frame_shape
    stated_size = (width, height)
    if bayer is None:
        return GreyFrames(series, channel, None, stated_size, setup, text, has_colours)
    if channel is Channel.LUMINANCE:
        raise ArctrackError(
            "--channel luminance: a mosaic's sites have one colour each; give red, green or blue"
        )
    if stated_size in _sizes_of_sites(*size):
        return GreyFrames(series, channel, bayer, size, setup, text, has_colours)
    for effect, _ in acting(setup):
        for parameter in effect.parameters:
            if parameter.unit == "px":
                raise in_file(
                    stated.path,
                    f"[effects.{effect.id}] {parameter.name} is in px of the whole mosaic; state effects and "
                    "[camera] as those of its sites, half the width and height",
                )
    text = with_camera_keys(stated.path, camera_of_sites(setup, bayer, channel))
    setup = parse_setup(text, stated.path).setup
    return GreyFrames(series, channel, bayer, stated_size, setup, text, has_colours, is_converted=True)


def _first(series: ImageSeries) -> tuple[tuple[int, int], bool]:
    """Return the size of a series' first image, and whether it has colours."""
    if series.video is not None:
        return ffv1.grey_size(series.video), False
    image = EncodedImage(series.paths[0])
    return image.size, image.has_colours


def _sizes_of_sites(width: int, height: int) -> list[tuple[int, int]]:
    return [((width + a) // 2, (height + b) // 2) for a in (0, 1) for b in (0, 1)]


def _too_bright(image_dn: Integers, setup: Setup) -> str | None:
    """Return the problem of levels that the sensor cannot give, None if it can give them.

    Noise leaves no image of several levels in multiples of a shift, however dark it is.
    """
    bits, highest, brightest = setup.sensor.bits, setup.sensor.max_dn, int(image_dn.max())
    step = 1 << (8 * image_dn.dtype.itemsize - bits)
    is_shifted = not np.bitwise_or.reduce(image_dn, axis=None) % step and brightest > image_dn.min()
    if brightest <= highest and not (step > 1 and is_shifted):
        return None
    problem = f"holds {brightest} DN, [sensor] bits = {bits} ends at {highest}"
    if not is_shifted:
        return problem
    return (
        f"{problem}; its levels are multiples of {step}: state bits = 16, with gain and black level of these"
    )
