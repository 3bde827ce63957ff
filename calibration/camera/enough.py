"""Do the images determine the lens? If not, which image is missing."""

import numpy as np
from scipy.spatial import ConvexHull

from calibration.camera.adjustment import BoardScene
from calibration.camera.lens import Lens
from calibration.camera.sightings import Sightings
from noise_model.compiled.arrays import Float64

MIN_VIEWS = 6
"""Images: two halves of three each determine a lens by themselves."""

GOOD_COVER = 0.6
"""Share below which a user is shown the parts of the image without corners."""

CELLS = (("upper", "", "lower"), ("left", "", "right"))


class UndeterminedError(ValueError):
    """The images do not determine the lens; the text says why, and which image is missing."""


def check_count(views: int, left_out: int) -> None:
    """Raise UndeterminedError if there are too few images."""
    if views < MIN_VIEWS:
        others = f" ({left_out} left out)" if left_out else ""
        raise UndeterminedError(
            f"{views} image{'s show' if views != 1 else ' shows'} the board{others}: {MIN_VIEWS} at least "
            "are needed, and 15 are good; "
            "take more, the board leaning another way and elsewhere in the image in each"
        )


def check_focal_length(scene: BoardScene, sigma: Float64, corner_sigma_px: float) -> None:
    """Raise UndeterminedError if the boards do not determine the focal length.

    `sigma` (m,) is of the scene's lens and warp, `corner_sigma_px` of a corner.
    """
    worst = float(np.max(sigma[:2] / scene.lens.values[:2]))
    if worst <= 0.01:
        return
    known = "unknown" if not worst < 1.0 else f"known to {100.0 * worst:.1f} % only"
    about_x, about_y = tilts_deg(scene)
    # With 20 deg either way about both axes the boards are not to blame: the corners are noisy.
    if min(np.ptp(about_x), np.ptp(about_y)) >= 40.0:
        raise UndeterminedError(
            f"the focal length is {known}: corners scatter by {corner_sigma_px:.2g} px, too much for their "
            "number; give sharper images, at the camera's own size and well lit, or more of them"
        )
    if max(np.ptp(about_x), np.ptp(about_y)) < 20.0:
        reason = "all boards lie nearly parallel to the sensor"
        missing = "leans 20 to 40 deg about the image's horizontal in some, about its vertical in others"
    else:
        axis = "horizontal" if np.ptp(about_x) < np.ptp(about_y) else "vertical"
        reason = "the boards lean too little or about one axis alone"
        missing = f"leans 20 to 40 deg about the image's {axis}, either way"
    raise UndeterminedError(
        f"the focal length is {known}: {reason}; take images in which the board {missing}, and nearer by"
    )


def check_cover(lens: Lens, seen: Sightings) -> None:
    """Raise UndeterminedError if the boards keep to a small part of the image."""
    share = cover(lens, seen)
    if share < 0.15:
        raise UndeterminedError(
            f"the boards cover {100.0 * share:.0f} % of the image: the lens is not seen beyond; take images "
            f"with the board nearer by, so that it fills the image, and in its {empty_parts(lens, seen)}"
        )


def cover(lens: Lens, seen: Sightings) -> float:
    """Return the share of the image within the hull of all corners."""
    return float(ConvexHull(seen.points_px).volume) / (lens.width * lens.height)


def empty_parts(lens: Lens, seen: Sightings) -> str:
    """Return the parts of the image without a corner, of three by three, in words; empty if none is."""
    parts = np.floor(3.0 * seen.points_px / [lens.width, lens.height]).astype(int).clip(0, 2)
    shown = {(int(row), int(column)) for column, row in parts}
    missing = [
        " ".join(filter(None, (CELLS[0][row], CELLS[1][column]))) or "middle"
        for row in range(3)
        for column in range(3)
        if (row, column) not in shown
    ]
    return ", ".join(missing)


def tilts_deg(scene: BoardScene) -> tuple[Float64, Float64]:
    """Return the tilt of each board about the image's horizontal and its vertical (V,), deg."""
    normal = scene.T_camera_board[:, :3, 2]
    toward = np.sign(normal[:, 2])
    about_x = np.degrees(np.arctan2(-normal[:, 1] * toward, np.abs(normal[:, 2])))
    return about_x, np.degrees(np.arctan2(normal[:, 0] * toward, np.abs(normal[:, 2])))
