"""Numbers of a setup in m or rad where mm and degrees are due, found by tracking the frames without each."""

from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np

from arctrack.check.fit import ENOUGH
from arctrack.check.hint import Hint, either
from arctrack.errors import ArctrackError
from arctrack.recording import Recording
from arctrack.recording.reader import fitted
from arctrack.replay.replay_loop import rows_to_try, try_out
from noise_model.setup import Setup
from tracker.geometry import SEARCH_REACH_MM

UNITS = {"_mm": ("m", "mm", 1000.0), "_deg": ("rad", "degrees", float(np.degrees(1.0)))}
"""For the end of a key: the unit that may be meant, the one that is due, and the ratio of the two."""

TABLES = ("laser", "joint", "arc", "tolerance")

MAX_TRIED = 12
"""Number of frames that are tracked for each number."""


def likely_unit(recording: Recording) -> Hint | None:
    """Return the number in whose other unit most offsets go out and frames are valid, None if few do."""
    if _share(recording) >= ENOUGH:
        return None
    hints = [
        Hint(f"{key} is in {stated}", f"recording.toml: give it in {due}", _share(recording, setup))
        for key, stated, due, setup in _in_other_units(recording.setup)
    ]
    most = max((hint.probability for hint in hints), default=0.0)
    return either([hint for hint in hints if hint.probability == most]) if most >= ENOUGH else None


def _share(recording: Recording, setup: Setup | None = None) -> float:
    """Return the share of wanted offsets sent or of frames valid, whichever is less; 0 if it is refused."""
    changed = recording if setup is None else replace(recording, setup=setup)
    positions = rows_to_try(changed, MAX_TRIED)
    try:
        trial = try_out(fitted(changed), positions)
    except ArctrackError:
        return 0.0
    lit = [t.valid for n, t in zip(positions, trial.tracks, strict=True) if recording.rows[n].laser_on]
    return min(trial.offsets.sent / max(trial.offsets.wanted, 1), sum(lit) / max(len(lit), 1))


def _in_other_units(setup: Setup) -> Iterator[tuple[str, str, str, Setup]]:
    """Yield each key with the unit it may be in, the one that is due, and the setup without that mistake."""
    for end, (stated, due, factor) in UNITS.items():
        for table in TABLES:
            part = getattr(setup, table)
            numbers = {f.name: getattr(part, f.name) for f in fields(part)}
            dimensions = dict(numbers.get("dimensions", {}))
            for name, value in {**numbers, **dimensions}.items():
                if not name.endswith(end) or value is None or not np.any(value):
                    continue
                numbers_due = factor * np.asarray(value, dtype=np.float64)
                # A tolerance wider than the search lets everything through: that explains nothing.
                if table == "tolerance" and numbers_due.max() > SEARCH_REACH_MM:
                    continue
                scaled = numbers_due.tolist()
                if isinstance(scaled, list):
                    scaled = tuple(tuple(v) if isinstance(v, list) else v for v in scaled)
                changed = {name: scaled} if name in numbers else {"dimensions": {**dimensions, name: scaled}}
                try:
                    yield (
                        f"[{table}] {name}",
                        stated,
                        due,
                        replace(setup, **{table: replace(part, **changed)}),
                    )
                except ValueError:
                    # Numbers that no setup can hold.
                    continue
