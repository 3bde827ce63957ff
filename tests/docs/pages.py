"""The pages of the documentation, as the tests read them."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(path for path in (ROOT / "docs").rglob("*.md"))
README = ROOT / "README.md"
EVERY_PAGE = [README, *PAGES]

_MARKDOWN = MarkdownIt("commonmark").enable("table")


def name(path: Path) -> str:
    """Return a page's path below the root, for a test's id."""
    return str(path.relative_to(ROOT))


@cache
def tokens(path: Path) -> list[Token]:
    """Return a page's tokens, those within a paragraph, heading or cell among them, in order."""
    flat: list[Token] = []
    for token in _MARKDOWN.parse(path.read_text(encoding="utf-8")):
        flat += [token, *(token.children or ())]
    return flat


def links(path: Path) -> list[str]:
    """Return the targets of a page's links and pictures that lie within the repository."""
    targets = [str(token.attrs.get("href") or token.attrs.get("src") or "") for token in tokens(path)]
    return [target for target in targets if target and "://" not in target]


def anchors(path: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    found: set[str] = set()
    flat = tokens(path)
    for token, inline in itertools.pairwise(flat):
        if token.type == "heading_open":
            text = "".join(child.content for child in inline.children or ())
            found.add(re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-"))
    return found


@dataclass(frozen=True)
class Command:
    """A command of a page, and the lines of its output that the page shows; "…" stands for others."""

    text: str
    shown: tuple[str, ...] = ()


@dataclass(frozen=True)
class Script:
    """A block of Python, and the lines of its output, where a block of text behind it shows them."""

    text: str
    shown: tuple[str, ...] = ()


def steps(path: Path) -> list[Command | Script]:
    """Return what a page has its reader run, in order: `sh`, `console` and `python` blocks."""
    found: list[Command | Script] = []
    fences = [token for token in tokens(path) if token.type == "fence"]
    for before, token in itertools.pairwise([Token("", "", 0), *fences]):
        if token.info == "python":
            found.append(Script(token.content))
        elif token.info == "text" and before.info == "python":
            lines = [" ".join(line.split()) for line in token.content.splitlines()]
            found[-1] = replace(found[-1], shown=tuple(lines))
        elif token.info in ("sh", "console"):
            found += _commands(token.content, is_shell=token.info == "sh")
    return found


def _commands(block: str, is_shell: bool) -> list[Command]:
    """Return a block's commands, continued lines joined; in a console they stand behind a $."""
    found: list[Command] = []
    for line in filter(str.strip, block.replace("\\\n", " ").splitlines()):
        text = " ".join(line.split())
        if is_shell or text.startswith("$ "):
            found.append(Command(text.removeprefix("$ ")))
        else:
            found[-1] = replace(found[-1], shown=(*found[-1].shown, text))
    return found


def quoted_commands(path: Path) -> list[str]:
    """Return the commands that a page names within its text: benchmarks, tests and modules with arguments."""
    quoted = (token.content for token in tokens(path) if token.type == "code_inline")
    starts = ("python benchmarks/", "python examples/", "python -m ", "pytest tests/")
    return [text for text in quoted if text.startswith(starts)]
