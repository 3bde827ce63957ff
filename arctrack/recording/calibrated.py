"""Results of a calibration in a recording.toml: values where they are read, and their covariance.

The values go into their table, such as `[camera]`. Their sigmas and covariance go into a table of their own,
`[calibration.camera]`, which no reader needs.
"""

from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from tomlkit.items import InlineTable

from arctrack.recording.setup_file import end_joint_covariance, parse_setup, read_setup_file, setup_text
from arctrack.recording.setup_writer import covariance_table
from noise_model.compiled.arrays import Float64

Value = float | int | Sequence[float]


@dataclass(frozen=True)
class CalibrationValues:
    """Calibrated values of one table of recording.toml, with their covariance.

    `table` is such as "camera", or "camera.pose_in_tool" for one within it; `values` maps its keys to numbers
    or arrays. `parameters` name the rows of `covariance` (n, n), with the unit where the key has none.
    `made_by` is the command, `about` has counts, residuals and the like. `[calibration.NAME]` is the table's
    name unless stated. Raises ValueError where the covariance is not finite or not of that shape.
    """

    table: str
    values: Mapping[str, Value]
    parameters: tuple[str, ...]
    covariance: Float64
    made_by: str
    about: Mapping[str, Value | str | Sequence[str]] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        n = len(self.parameters)
        if self.covariance.shape != (n, n) or not np.isfinite(self.covariance).all():
            raise ValueError(f"the covariance of {n} parameters must be {n} x {n} finite numbers")

    @property
    def sigma(self) -> Float64:
        """1 sigma of each parameter (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def with_calibrated(path: Path, *results: CalibrationValues) -> str:
    """Return a recording.toml's text with calibrated values; all else, comments included, stays.

    An earlier `[calibration.NAME]` of the same name is replaced. A camera or a sheet that is calibrated anew
    ends the joint covariance of the former ones. Raises ArctrackError for a file that cannot be read, and for
    a value that it could not hold.
    """
    read_setup_file(path)
    document = tomlkit.parse(setup_text(path))
    for result in results:
        table = document
        for name in result.table.split("."):
            is_inline = isinstance(table, InlineTable)
            table = table.setdefault(name, tomlkit.inline_table() if is_inline else tomlkit.table())
        for key, value in result.values.items():
            table[key] = _plain(value)
        records = document.setdefault("calibration", tomlkit.table(is_super_table=True))
        if result.values and result.table in ("camera", "camera.pose_in_tool", "laser"):
            end_joint_covariance(document)
        _replace(records, result.name or result.table, _record(result))
    text = tomlkit.dumps(document)
    parse_setup(text, path)
    return text


def _replace(tables: MutableMapping[str, Any], name: str, record: Mapping[str, object]) -> None:
    """Put a record into its table, key by key: comments that stand in it, or before the next one, stay."""
    if name not in tables:
        tables[name] = record
        return
    table = tables[name]
    for key in [key for key in table if key not in record]:
        del table[key]
    for key, value in record.items():
        table[key] = value


def _record(result: CalibrationValues) -> dict[str, object]:
    return {
        "made_by": result.made_by,
        **result.about,
        **covariance_table(result.parameters, result.covariance),
    }


def _plain(value: Value | Float64) -> object:
    # Numbers of NumPy and tuples are no TOML.
    return np.asarray(value).tolist()
