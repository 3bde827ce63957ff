"""A replay with a pack of its kernels compiles nothing, keeps nothing, and gives the same tracks."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

from noise_model.compiled.target import target

ROOT = Path(__file__).resolve().parents[2]

REPLAY = """
import sys
from arctrack.cli import main
sys.argv = ["arctrack", "replay", {recording!r}, "--out", {out!r}]
main()
"""
PACK = """
from pathlib import Path
from noise_model.compiled import numba_internals as internals, packed, target
from validation.packs import pack_of, write_pack
used = {}
find, keep = internals.find_records, internals.write_record

def find_and_note(kernel, key):
    for record in find(kernel, key):
        used[kernel, key] = record
        yield record

def keep_and_note(kernel, key, record):
    used[kernel, key] = record
    keep(kernel, key, record)

def write():
    records = [(kernel, key, record) for (kernel, key), record in used.items()]
    write_pack(Path(FILE) / f"{target.target()}.pack", pack_of(records, {}))

internals.find_records, internals.write_record = find_and_note, keep_and_note
import atexit
atexit.register(write)
"""


@pytest.mark.slow
@pytest.mark.skipif(target() is None, reason="this machine compiles for no level of processors")
def test_a_replay_with_a_pack_compiles_nothing(compiled: None, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    tracks = []
    for name, before in (("compiled", f"FILE = {str(tmp_path)!r}\n{PACK}"), ("packed", "")):
        code = REPLAY.format(recording=str(ROOT / "examples/v_groove"), out=str(tmp_path / name))
        subprocess.run([sys.executable, "-c", before + code], env=environment, check=True)
        environment |= {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "ARCTRACK_PACKS": str(tmp_path)}
        with (tmp_path / name / "results.csv").open() as file:
            rows = list(csv.DictReader(file))
        tracks.append([{column: row[column] for column in row if column != "compute_ms"} for row in rows])
    assert [file for file in (tmp_path / "cache").rglob("*") if file.is_file()] == []
    assert tracks[0] == tracks[1]
