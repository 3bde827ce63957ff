"""Flat and dark frames from a folder: what each is, and its exposure, by its name or by a table.

A name, or that of the folder it lies in, says `flat` or `dark` and the exposure with its unit:
flat_2.5ms_1.png, dark_500us/0002.tif. Where the folder holds exposures.csv, its columns file, exposure_ms,
lit (1 or 0) say so instead.
"""

import csv
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.recording.csv_file import number, read_csv, whole
from arctrack.recording.files import blamed_on, read_text
from arctrack.recording.frame_hints import IMPORTED
from arctrack.recording.importing.colours import Channel
from arctrack.recording.importing.grey import grey
from arctrack.recording.importing.image_decoder import EncodedImage
from calibration.sensor.levels import Level, level_from

TABLE = "exposures.csv"

_UNITS_S = {"us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0}
_KIND = re.compile(r"(flat|dark)", re.IGNORECASE)
_EXPOSURE = re.compile(r"(?<![\d.])(?<!\d,)(\d+(?:\.\d+)?)\s*(us|µs|ms|s)(?![a-z])", re.IGNORECASE)


@dataclass(frozen=True)
class FlatFile:
    """An image, its exposure, and whether light fell on it."""

    path: Path
    exposure_s: float
    is_lit: bool


def find_flat_frames(folder: Path) -> tuple[list[FlatFile], list[str]]:
    """Return a folder's flat and dark frames, and one line on those that say too little.

    Raises ArctrackError for a folder without any, and for a table that names a file that is not there.
    """
    table = folder / TABLE
    if table.exists():
        return list(_by_table(table)), []
    images = sorted(
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in IMPORTED and not path.name.startswith(".")
    )
    if len(images) > LIMITS.csv_rows:
        raise in_file(folder, f"holds {len(images)} images: {LIMITS.csv_rows} are the most")
    files = [_by_name(path, folder) for path in images]
    known = [file for file in files if file is not None]
    if not known:
        raise in_file(
            folder,
            "holds no flat or dark frames: name them like flat_2.5ms_1.png and dark_2.5ms_1.png, or put a "
            f"table {TABLE} beside them, file,exposure_ms,lit",
        )
    vague = [path for path, file in zip(images, files, strict=True) if file is None]
    if not vague:
        return known, []
    what = f"{len(vague)} images, the first {vague[0].name}, name no kind or no exposure and are left out"
    return known, [f"{folder}: {what}"]


def read_levels(
    files: list[FlatFile], channel: Channel, bits: int, on_level: Callable[[int, int], None]
) -> tuple[list[Level], list[str]]:
    """Return the levels of flat and dark frames, and warnings, one line each.

    Lossy files are left out. Raises ArctrackError for a file that cannot be read, and ValueError for a level
    that determines nothing.
    """
    lossy: list[Path] = []
    groups: dict[tuple[bool, float], list[Path]] = {}
    for file in files:
        groups.setdefault((file.is_lit, file.exposure_s), []).append(file.path)
    levels = []
    for done, ((is_lit, exposure_s), paths) in enumerate(sorted(groups.items())):
        on_level(done, len(groups))
        encoded = [EncodedImage(path) for path in paths]
        lossy += [image.path for image in encoded if image.is_lossy]
        images = [grey(image.pixels(), channel) for image in encoded if not image.is_lossy]
        if images:
            levels.append(level_from(images, exposure_s, is_lit, bits))
    on_level(len(groups), len(groups))
    warnings = []
    if lossy:
        warnings.append(
            f"{lossy[0]}: is a JPEG, whose codec takes the noise away: {len(lossy)} of them are left out; "
            "save PNG or TIFF"
        )
    if len({level.mean_dn.shape for level in levels}) > 1:
        raise ValueError("the exposures' frames differ in size: leave out those of another camera or crop")
    return levels, warnings


def _by_name(path: Path, folder: Path) -> FlatFile | None:
    name = str(path.relative_to(folder))
    kinds, exposures = _KIND.findall(name), _EXPOSURE.findall(name)
    if not kinds or not exposures:
        return None
    value, unit = exposures[-1]
    return FlatFile(path, float(value) * _UNITS_S[unit.lower()], kinds[-1].lower() == "flat")


def _by_table(path: Path) -> Iterator[FlatFile]:
    table = read_csv(path, {"exposure_ms": number, "lit": whole(1)})
    with blamed_on(path):
        rows = list(csv.DictReader(read_text(path, LIMITS.csv_bytes).splitlines()))
    if rows and "file" not in rows[0]:
        raise in_file(path, "the column file is missing; needed are file,exposure_ms,lit", line=1)
    for row, exposure_ms, lit, line in zip(
        rows, table.column("exposure_ms"), table.column("lit"), table.lines.tolist(), strict=True
    ):
        name = (row.get("file") or "").strip()
        file = path.parent / name
        if not name or not file.is_file():
            raise in_file(path, f"file = {name!r}: there is no such file beside the table", line=line)
        if not exposure_ms > 0.0:
            raise in_file(path, f"exposure_ms = {exposure_ms:g}: must be > 0", line=line)
        yield FlatFile(file, 1e-3 * float(exposure_ms), bool(lit))
