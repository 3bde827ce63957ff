"""The site is built without a warning and without network, and no link in it leads nowhere."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from bs4 import BeautifulSoup
from pages import EVERY_PAGE, ROOT, anchors, links, name

import arctrack

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("sphinx", reason="arctrack[docs] is not installed")
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [
            sys.executable,
            "-m",
            "sphinx",
            "--fail-on-warning",
            "--keep-going",
            "--quiet",
            ROOT / "docs",
            folder,
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    return folder


def read(path: Path) -> BeautifulSoup:
    return BeautifulSoup(path.read_text(encoding="utf-8"), "html.parser")


def pages_of(site: Path) -> list[Path]:
    return [path for path in site.rglob("*.html") if "_static" not in path.parts]


@pytest.mark.slow
def test_every_link_of_the_site_leads_somewhere(site: Path) -> None:
    pages = {path: read(path) for path in pages_of(site)}
    ids = {path: {tag["id"] for tag in page.find_all(id=True)} for path, page in pages.items()}
    lost: list[str] = []
    for path, page in pages.items():
        for tag in page.find_all(["a", "img", "link", "script"]):
            parts = urlsplit(tag.get("href") or tag.get("src") or "")
            if parts.scheme or not (parts.path or parts.fragment):
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            known = ids.get(target, set())
            if not target.exists() or (parts.fragment and known and unquote(parts.fragment) not in known):
                lost.append(f"{path.relative_to(site)}: {parts.geturl()}")
    assert lost == []


@pytest.mark.slow
def test_the_site_loads_nothing_from_elsewhere(site: Path) -> None:
    for path in pages_of(site):
        loaded = read(path).find_all(["img", "link", "script", "iframe"])
        sources = [str(tag.get("src") or tag.get("href") or "") for tag in loaded]
        assert [source for source in sources if urlsplit(source).netloc] == [], path.name


@pytest.mark.slow
def test_the_reference_holds_the_public_names(site: Path) -> None:
    shown = read(site / "reference" / "api.html")
    described = {tag["id"] for tag in shown.find_all("dt", id=True)}
    assert {f"arctrack.{public}" for public in arctrack.__all__} <= described


@pytest.mark.parametrize("path", EVERY_PAGE, ids=name)
def test_every_link_of_a_page_leads_somewhere(path: Path) -> None:
    for link in links(path):
        parts = urlsplit(link)
        target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
        assert target.exists(), link
        if parts.fragment:
            assert unquote(parts.fragment) in anchors(target), link
