"""The wheel carries the packs; the container's image copies what is there, and installs as the pages say."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import threading
import tomllib
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from zipfile import ZipFile

import pytest
import yaml
from test_house import MAY_IMPORT

from arctrack.cli import app
from arctrack.control.cell_file.choices import MonitorChoice
from noise_model.compiled.packed import pack_serves
from noise_model.compiled.target import CPU_NAMES

ROOT = Path(__file__).resolve().parents[1]
LINES = (ROOT / "Dockerfile").read_text().replace("\\\n", " ").splitlines()
STEPS = [line.split(maxsplit=1) for line in LINES if line and not line.startswith("#")]


def steps(word: str) -> list[str]:
    """Return what follows an instruction, in order."""
    return [" ".join(rest.split()) for instruction, rest in STEPS if instruction == word]


def built(source: Path, kind: str, folder: Path) -> Path:
    """Return the sdist or the wheel that a source tree makes."""
    words = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(folder)]
    subprocess.run(words, cwd=source, check=True, capture_output=True)
    (path,) = folder.glob("*.whl" if kind == "wheel" else "*.tar.gz")
    return path


def test_there_is_a_small_pack_of_each_target() -> None:
    packs = {file.stem: file.stat().st_size for file in (ROOT / "noise_model/compiled/packs").iterdir()}
    assert packs.keys() == CPU_NAMES.keys()
    assert max(packs.values()) <= 1_500_000


@pytest.mark.slow
def test_a_wheel_carries_the_packs(tmp_path: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    for name in ("pyproject.toml", "README.md", "LICENSE", ".gitignore"):
        shutil.copy(ROOT / name, tmp_path)
    for package in project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").touch()
    pack = "noise_model/compiled/packs/x86-64-v3.pack"
    (tmp_path / pack).parent.mkdir(parents=True)
    (tmp_path / pack).write_bytes(b"machine code")
    assert ZipFile(built(tmp_path, "wheel", tmp_path / "dist")).read(pack) == b"machine code"


def test_the_wheel_leaves_out_what_judges_the_product() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert set(project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]) == set(MAY_IMPORT) - {
        "validation"
    }


def test_the_image_copies_what_the_wheel_needs() -> None:
    copied = {name for step in steps("COPY") if "--from" not in step for name in step.split()[:-1]}
    assert all((ROOT / name).exists() for name in copied)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert copied >= {*packages, "pyproject.toml", project["project"]["readme"], "requirements.lock"}
    assert copied >= set(project["project"]["license-files"])


def test_the_image_installs_as_the_page_says() -> None:
    page = (ROOT / "docs/how_to/deploy.md").read_text()
    documented = re.findall(r"pip (install --.*)", page)
    installed = [part for step in steps("RUN") for part in re.findall(r"pip (install [^&]*)", step)]
    assert [part.replace("--no-cache-dir ", "").strip() for part in installed] == documented


def test_the_image_has_debians_aravis_and_runs_without_rights() -> None:
    page = (ROOT / "docs/reference/cameras.md").read_text()
    packages = re.search(r"apt-get install (.*)", page)
    assert packages is not None
    runtime = steps("RUN")[-2:]
    assert all(package in runtime[0] for package in packages[1].split())
    assert steps("FROM")[-1] == "debian:12-slim", "whose Python 3.11 is the one of python3-gi"
    user = steps("USER")[-1]
    assert f"useradd --create-home --groups video,dialout {user}" in runtime[1]
    last = [instruction for instruction, _ in STEPS][-5:]
    assert last == ["USER", "WORKDIR", "HEALTHCHECK", "ENTRYPOINT", "CMD"]


class Health(BaseHTTPRequestHandler):
    """A page that says what it is told to."""

    status = 200

    def do_GET(self) -> None:
        self.send_response(self.status if self.path == "/health" else 404)
        self.end_headers()

    def log_message(self, *args: object) -> None:
        """Say nothing."""


@pytest.mark.parametrize(("status", "code"), [(200, 0), (503, 1)])
def test_the_image_is_healthy_while_the_page_says_so(
    status: int, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    (check,) = steps("HEALTHCHECK")
    python, *words = json.loads(check[check.index("[") :])
    assert python == "python3"
    assert f":{MonitorChoice().port}/health" in words[-1]
    monkeypatch.setattr(Health, "status", status)
    with HTTPServer(("127.0.0.1", 0), Health) as page:
        answering = threading.Thread(target=page.handle_request)
        answering.start()
        words[-1] = words[-1].replace(f":{MonitorChoice().port}", f":{page.server_port}")
        asked = subprocess.run([sys.executable, *words], stderr=subprocess.DEVNULL, check=False)
        answering.join()
    assert asked.returncode == code


def test_compose_runs_a_simulated_cell_of_the_image() -> None:
    (cell,) = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"].values()
    assert (ROOT / cell["build"] / "Dockerfile").exists()
    with pytest.raises(SystemExit) as ended:
        app([*cell["command"], "--help"])
    assert ended.value.code == 0
    # A page that others reach needs a token.
    assert cell["network_mode"] == "host"


def test_the_bill_of_materials_is_of_the_lock(tmp_path: Path) -> None:
    if shutil.which("cyclonedx-py") is None:
        pytest.skip("cyclonedx-bom is not installed")
    subprocess.run([ROOT / ".ci/sbom", tmp_path / "sbom.json"], check=True, stderr=subprocess.DEVNULL)
    bill = json.loads((tmp_path / "sbom.json").read_text())
    lock = (ROOT / "requirements.lock").read_text()
    pinned = {
        (name, version): set(re.findall(r"--hash=sha256:(\w+)", rest))
        for name, version, rest in re.findall(r"^([\w.-]+)==([^\s;]+)((?:.*\\\n)+.*)", lock, re.MULTILINE)
    }
    assert {
        (each["name"], each["version"]): {
            kept["content"]
            for reference in each["externalReferences"]
            for kept in reference.get("hashes", ())
        }
        for each in bill["components"]
    } == pinned


@pytest.mark.slow
def test_a_release_tracks_the_example_and_compiles_nothing(tmp_path: Path) -> None:
    with tarfile.open(built(ROOT, "sdist", tmp_path)) as sdist:
        sdist.extractall(tmp_path / "source", filter="data")
    (source,) = (tmp_path / "source").iterdir()
    installed, example, cache = (tmp_path / name for name in ("installed", "v_groove", "cache"))
    with ZipFile(built(source, "wheel", tmp_path)) as wheel:
        wheel.extractall(installed)
    shutil.copytree(ROOT / "examples" / "v_groove", example)
    code = "import arctrack, arctrack.cli; print(arctrack.__file__); arctrack.cli.main()"
    run = subprocess.run(
        [sys.executable, "-c", code, "replay", example, "--no-pictures"],
        env={**os.environ, "PYTHONPATH": str(installed), "NUMBA_CACHE_DIR": str(cache)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.splitlines()[0] == str(installed / "arctrack" / "__init__.py")
    assert "17 of 17" in run.stdout
    if pack_serves():
        assert list(cache.glob("arctrack/kernels/*/*")) == []
