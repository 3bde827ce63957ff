"""Does `arctrack calibrate camera` find the same lens at every size of the images?

    python benchmarks/camera_sizes.py

The pictures of examples/make_boards.py are resized, compressed as JPEG, and given more noise. Printed for
each is the distortion chosen, k1 and fx over the factor, their errors over sigma, and the seconds it took.
"""

from __future__ import annotations

import itertools
import runpy
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from calibration.boards.board import Board
from calibration.boards.detect import find_corners
from calibration.camera.calibrate import calibrate_camera
from calibration.camera.enough import UndeterminedError
from calibration.camera.sightings import BoardView
from noise_model.compiled.arrays import UInt8

BOARD = Board.parse("chessboard:9x6:4mm")
FX_PX, K1 = 2186.0, -0.35
WAYS = {
    "Lanczos": cv2.INTER_LANCZOS4,
    "bilinear": cv2.INTER_LINEAR,
    "area": cv2.INTER_AREA,
    "nearest": cv2.INTER_NEAREST,
}
FACTORS = (0.4, 0.5, 0.6, 0.75, 1.3, 1.5, 2.0)
QUALITIES, NOISES_DN = (60, 75, 85, 95), (2.0, 5.0, 10.0)
CASES = (
    *((factor, way, 0, 0.0) for factor, way in itertools.product(FACTORS, WAYS)),
    *((factor, "area", quality, 0.0) for factor, quality in itertools.product((0.5, 1.0, 2.0), QUALITIES)),
    *((factor, "area", 0, noise) for factor, noise in itertools.product((0.5, 1.0, 1.5), NOISES_DN)),
)


def changed(picture: UInt8, factor: float, way: str, quality: int, noise_dn: float, seed: int) -> UInt8:
    """Return a picture resized, with noise, and compressed where a JPEG's quality is given."""
    resized = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=WAYS[way])
    noise = noise_dn * np.random.default_rng(seed).standard_normal(resized.shape)
    result = np.rint(resized + noise).clip(0, 255).astype(np.uint8)
    if quality:
        stored = cv2.imencode(".jpg", result, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        result = np.asarray(cv2.imdecode(stored, cv2.IMREAD_UNCHANGED), dtype=np.uint8)
    return result


def line(pictures: list[UInt8], factor: float, way: str, quality: int, noise_dn: float) -> str:
    """Return a row of the table."""
    begun = time.perf_counter()
    images = [changed(picture, factor, way, quality, noise_dn, n) for n, picture in enumerate(pictures)]
    found = [(f"{n}", find_corners(image, BOARD)) for n, image in enumerate(images)]
    views = [BoardView(name, each.corners, each.points_px) for name, each in found if each is not None]
    case = f"| {factor:g} | {way} | {quality or '-'} | {noise_dn:g} |"
    height, width = images[0].shape
    try:
        result = calibrate_camera(BOARD, views, (width, height))
    except UndeterminedError as error:
        return f"{case} refused: {str(error).split(';')[0]} |"
    lens = result.scene.lens
    value, sigma = (dict(zip(lens.names, each, strict=False)) for each in (lens.values, result.sigma))
    z = {name: (value[name] - truth) / sigma[name] for name, truth in (("k1", K1), ("fx", FX_PX * factor))}
    return (
        f"{case} {result.order}: k1 {value['k1']:.3f} ({z['k1']:+.1f} sigma), "
        f"fx {value['fx'] / factor:.1f} ({z['fx']:+.1f} sigma), {time.perf_counter() - begun:.1f} s |"
    )


def main() -> None:
    """Draw the pictures, and print the table."""
    example = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "make_boards.py"))
    with tempfile.TemporaryDirectory() as folder:
        example["main"](Path(folder))
        paths = sorted(Path(folder).glob("*.png"))
        pictures = [np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), dtype=np.uint8) for path in paths]
    for case in CASES:
        print(line(pictures, *case), flush=True)


if __name__ == "__main__":
    main()
