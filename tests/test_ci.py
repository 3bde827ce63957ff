"""The scripts of .ci: titles of commits, and what the forge's workflow calls."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LONGEST = "Read “CAN logs” that were cut by a power loss, and say so 60"
ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")} | {
    "GIT_CONFIG_GLOBAL": "/dev/null",
    "GIT_CONFIG_COUNT": "2",
    "GIT_CONFIG_KEY_0": "user.name",
    "GIT_CONFIG_VALUE_0": "arctrack",
    "GIT_CONFIG_KEY_1": "user.email",
    "GIT_CONFIG_VALUE_1": "arctrack@localhost",
}


def run(folder: Path, *command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=False)


def commit(folder: Path, title: str, *options: str) -> subprocess.CompletedProcess[str]:
    return run(folder, "git", "commit", "--allow-empty", *options, "--message", f"{title}\n\n{'body ' * 30}")


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """Return a clone of an empty repository, whose hooks are those of the project."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    assert run(tmp_path, "git", "init", "--quiet", "--initial-branch", "main", ".").returncode == 0
    hooks = (ROOT / ".pre-commit-config.yaml").read_text().replace(".ci/", f"{ROOT}/.ci/")
    (tmp_path / ".pre-commit-config.yaml").write_text(hooks)
    return tmp_path


@pytest.mark.slow
def test_the_hook_holds_titles_to_60_characters(clone: Path) -> None:
    installed = run(clone, sys.executable, "-m", "pre_commit", "install")
    assert "commit-msg" in installed.stdout, installed.stderr
    run(clone, "git", "add", ".pre-commit-config.yaml")
    assert len(LONGEST) == 60
    assert commit(clone, LONGEST).returncode == 0
    refused = commit(clone, f"{LONGEST}!")
    assert refused.returncode == 1
    assert "a commit's title has 61 characters, at most 60" in refused.stdout + refused.stderr
    assert commit(clone, f"fixup! {LONGEST}").returncode == 0


def test_titles_that_the_main_branch_lacks_are_held(clone: Path) -> None:
    commit(clone, f"{LONGEST} of old")
    assert run(clone, ROOT / ".ci/titles").returncode == 1, "the last one, where none is known"
    run(clone, "git", "update-ref", "refs/remotes/origin/main", "HEAD")
    commit(clone, LONGEST)
    assert run(clone, ROOT / ".ci/titles").returncode == 0
    commit(clone, f"{LONGEST}!")
    commit(clone, LONGEST)
    checked = run(clone, ROOT / ".ci/titles")
    assert checked.returncode == 1
    assert checked.stderr == f"a commit's title has 61 characters, at most 60: {LONGEST}!\n"


def test_the_workflow_runs_scripts_that_are_there() -> None:
    (workflow,) = (ROOT / ".github/workflows").iterdir()
    text = workflow.read_text()
    assert ".ci/${{ matrix.script }}" in text
    scripts = re.findall(r"script: \[(.*)\]", text)[0].split(", ")
    assert all(os.access(ROOT / ".ci" / script, os.X_OK) for script in scripts)
    target = re.findall(r"docker build --target (\S+)", text)[0]
    assert re.search(rf"^FROM \S+ AS {target}$", (ROOT / "Dockerfile").read_text(), re.M)


def test_system_packages_are_those_of_the_image() -> None:
    page = (ROOT / "docs/reference/cameras.md").read_text()
    aravis = re.search(r"apt-get install (.*)", page)
    installed = re.search(r"for package in (.*);", (ROOT / ".ci/system").read_text())
    assert aravis is not None
    assert installed is not None
    assert set(installed[1].split()) == {"chromium", *aravis[1].split()}
