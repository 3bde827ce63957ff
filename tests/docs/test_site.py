"""The site is built without a warning and without network, and no link in it leads nowhere."""

from __future__ import annotations

import importlib
import subprocess
import sys
from enum import Enum
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from bs4 import BeautifulSoup
from once import once
from pages import EVERY_PAGE, ROOT, anchors, links, name

import arctrack

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(shared: Path) -> Path:
    pytest.importorskip("sphinx", reason="arctrack[docs] is not installed")
    return once(shared, "site", build)


def build(folder: Path) -> None:
    options = ["--fail-on-warning", "--keep-going", "--quiet"]
    command = [sys.executable, "-m", "sphinx", *options, ROOT / "docs", folder]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr


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


UNDESCRIBED = {"GL08", "SS01", "PR01", "PR02", "PR03", "PR04", "PR06", "PR07", "RT01", "RT03", "YD01"}
"""numpydoc's codes of a summary, a parameter or a result that is not there, not typed or not described."""


def undescribed(public: str) -> list[str]:
    """Return what numpydoc misses in a docstring; a class without parameters lists its attributes."""
    numpydoc = importlib.import_module("numpydoc.validate")

    class Validator(numpydoc.Validator):  # type: ignore[misc, name-defined]
        def __init__(self, obj_name: str) -> None:
            stated = {"show_class_members": False}
            super().__init__(numpydoc.get_doc_object(self._load_obj(obj_name), config=stated))

        @property
        def doc_all_parameters(self) -> dict[str, tuple[str, str]]:
            return self.doc_parameters or self._doc_parameters(["Attributes"])

    held = Validator._load_obj(public)
    if isinstance(held, type) and issubclass(held, Enum):
        listed = Validator(public)._doc_parameters(["Attributes"])
        return [f"{public}.{name}: is not described" for name in held.__members__ if name not in listed]
    found = numpydoc.validate(public, validator_cls=Validator)["errors"]
    return [f"{public}: {text}" for code, text in found if code in UNDESCRIBED]


def test_every_name_of_the_reference_is_described(site: Path) -> None:
    pages = sorted((site / "reference").glob("api*.html"))
    names = {tag["id"] for page in pages for tag in read(page).find_all("dt", class_="sig", id=True)}
    assert len(names) > len(arctrack.__all__)
    described = sorted(names - {"arctrack.__version__"})
    assert [text for public in described for text in undescribed(public)] == []
