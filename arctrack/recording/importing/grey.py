"""Grey levels of colour images and Bayer mosaics: of the colour that lets the laser through.

Behind a bandpass filter on the laser's line, a colour sensor's red sites see a red laser almost at their
best, its green and blue sites hardly. A mean over the colours would add their noise and little light.
Sites of one colour are taken as they are, on a grid of twice the pitch. Interpolated ones would repeat
the same photons in several pixels, whose noise the tracker takes as independent.
"""

import cv2
import numpy as np

from arctrack.recording.importing.colours import Bayer, Channel
from noise_model.compiled.arrays import Integers
from noise_model.setup import Setup


def channel_of_laser(setup: Setup) -> Channel:
    """Return the colour whose sites see a setup's laser best; beyond red all colours see it, red no worse."""
    wavelength_nm = setup.laser.wavelength_nm
    # Wavelengths from which red and green sites respond most: where the curves of colour sensors cross.
    if wavelength_nm >= 580.0:
        return Channel.RED
    return Channel.GREEN if wavelength_nm >= 490.0 else Channel.BLUE


def grey(pixels: Integers, channel: Channel) -> Integers:
    """Return the grey levels (H, W) of pixels that are grey or have colours, blue first; alpha is left out.

    The luminance is 0.299 R + 0.587 G + 0.114 B (ITU-R BT.601), rounded.
    """
    if pixels.ndim == 2:
        return pixels
    if channel is Channel.LUMINANCE:
        return np.asarray(cv2.cvtColor(pixels[..., :3], cv2.COLOR_BGR2GRAY))
    # The order in which OpenCV holds colours.
    return np.ascontiguousarray(pixels[..., (Channel.BLUE, Channel.GREEN, Channel.RED).index(channel)])


def first_site(bayer: Bayer, channel: Channel) -> tuple[int, int]:
    """Return row and column of a mosaic's first site of a colour; of the two greens that of the first row."""
    place = bayer.value.index(channel.value[0].upper())
    return place // 2, place % 2


def sites(mosaic: Integers, bayer: Bayer, channel: Channel) -> Integers:
    """Return the sites of one colour, as they are: every other row and column of a mosaic (H, W)."""
    row, column = first_site(bayer, channel)
    return np.ascontiguousarray(mosaic[row::2, column::2])


def camera_of_sites(setup: Setup, bayer: Bayer, channel: Channel) -> dict[str, int | float]:
    """Return the keys of `[camera]` that differ for a mosaic's sites of one colour.

    A pixel u of the mosaic is (u - column) / 2 of the sites, so that focal lengths and blur halve. Light of a
    site, noise and black level are as before.
    """
    camera = setup.camera
    row, column = first_site(bayer, channel)
    return {
        "width": (camera.width - column + 1) // 2,
        "height": (camera.height - row + 1) // 2,
        "fx": camera.fx / 2.0,
        "fy": camera.fy / 2.0,
        "cx": (camera.cx - column) / 2.0,
        "cy": (camera.cy - row) / 2.0,
        "psf_sigma_px": camera.psf_sigma_px / 2.0,
    }
