"""The site is built without a warning and without network, and no link in it leads nowhere."""

from __future__ import annotations

import importlib
import subprocess
import sys
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from browser import CHROMIUM, WIDTHS_PX, Page
from bs4 import BeautifulSoup
from once import once
from pages import EVERY_PAGE, README, ROOT, Command, anchors, links, name, steps

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


FEW_COPIED = {"index.html": 2, "reference/api.html": 0, "tutorial/gallery.html": 10}
"""Pages, and how many of their blocks have a button that copies them."""


@pytest.mark.skipif(CHROMIUM is None, reason="no browser")
def test_a_browser_opens_the_site_without_an_error(site: Path, tmp_path: Path) -> None:
    with Page(tmp_path) as page:
        for shown, n_copied in FEW_COPIED.items():
            for width in WIDTHS_PX:
                page.resize(width, 900)
                page.open(site / shown)
                assert page.value("document.documentElement.scrollWidth <= innerWidth"), (shown, width)
            assert page.value("document.querySelectorAll('.copybtn').length") == n_copied, shown
        assert [text for text in page.complaints if '"type": "log"' not in text] == []


def test_the_first_page_shows_the_commands_of_the_readme() -> None:
    first, readme = (
        [step.text for step in steps(page) if isinstance(step, Command)]
        for page in (ROOT / "docs" / "index.md", README)
    )
    assert len(first) == 2
    assert set(first) <= set(readme)


@pytest.mark.slow
def test_the_reference_holds_the_public_names(site: Path) -> None:
    shown = read(site / "reference" / "api.html")
    described = {tag["id"] for tag in shown.find_all("dt", id=True)}
    assert {f"arctrack.{public}" for public in arctrack.__all__} <= described
    assert next(tag["id"] for tag in shown.find_all("dt", id=True)) == "arctrack.Tracker"


def test_signatures_show_no_values_that_fill_lines(site: Path) -> None:
    signatures = [
        " ".join(tag.get_text().split())
        for path in sorted((site / "reference").glob("api*.html"))
        for tag in read(path).find_all("dt", class_="sig")
    ]
    assert any("…" in text for text in signatures)
    assert [text for text in signatures if "<" in text or "array(" in text] == []


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
    """Return what numpydoc misses in a docstring; a class without parameters lists its attributes.

    What the metadata of a record's fields states is listed on the page.
    """
    numpydoc = importlib.import_module("numpydoc.validate")

    class Validator(numpydoc.Validator):  # type: ignore[misc, name-defined]
        def __init__(self, obj_name: str) -> None:
            stated = {"show_class_members": False}
            super().__init__(numpydoc.get_doc_object(self._load_obj(obj_name), config=stated))

        @property
        def doc_all_parameters(self) -> dict[str, tuple[str, str]]:
            stated = fields(self.obj) if isinstance(self.obj, type) and is_dataclass(self.obj) else ()
            roles = {f.name: (str(f.type), [f.metadata["role"]]) for f in stated if "role" in f.metadata}
            return roles or self.doc_parameters or self._doc_parameters(["Attributes"])

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
