"""The frames of a recording that show the laser alone under one exposure."""

from collections import Counter
from collections.abc import Callable

from arctrack.recording import Recording
from noise_model.compiled.arrays import Integers
from tracker.state import frame_misfit


def read_still_frames(
    recording: Recording, progress: Callable[[int, int], None]
) -> tuple[list[Integers], list[str]]:
    """Return the images (H, W) of the laser alone, of the commonest exposure, and what could not be read.

    `progress` is called with the images read and their number.
    """
    alone = [n for n, row in enumerate(recording.rows) if row.laser_on and not row.arc_on]
    exposures = Counter(recording.rows[n].exposure_s for n in alone)
    wanted = [n for n in alone if recording.rows[n].exposure_s == exposures.most_common(1)[0][0]]
    images, problems = [], []
    for done, image in enumerate(recording.images(wanted)):
        if isinstance(image, str):
            problems.append(image)
        else:
            images.append(image)
        progress(done + 1, len(wanted))
    # Frames that were cut off or turned are no part of one scene, those of fewer bits of another sensor's.
    misfits = [frame_misfit(image.shape, image.dtype, recording.setup) for image in images]
    unlike = [misfit for misfit in misfits if misfit is not None]
    if unlike:
        problems.append(f"{recording.path}: {len(unlike)} frames are left out; the first {unlike[0]}")
    return [image for image, misfit in zip(images, misfits, strict=True) if misfit is None], problems
