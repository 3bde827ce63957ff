"""Names and texts from files on a terminal, in a picture and on a page: shown, never obeyed."""

import io
import shutil
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spoiled import Refusal, toml, toml_end

from arctrack import cli
from arctrack.errors import ArctrackError
from arctrack.output import write_whole
from arctrack.printable import LONGEST_SHOWN, MAX_REPORTED, cut, first_of, printable, shown
from arctrack.recording import read_recording
from arctrack.report import style

HOSTILE = "a$\\frac$b\x1b[31m[bold]x[blink] 溶接\udcff\u202e"
"""A formula without end, an escape code, markup, letters that a font lacks, a byte, a turn to the left."""


@given(st.text(st.characters(exclude_categories=())))
def test_what_is_printable_is_one_line_that_any_encoding_takes(text: str) -> None:
    fit = printable(text)
    assert fit.isprintable()
    fit.encode("utf-8")
    assert printable(fit) == fit
    assert (fit == text) == text.isprintable()


def test_printable() -> None:
    assert printable("σ ≤ 1 mm, Ångström 溶接") == "σ ≤ 1 mm, Ångström 溶接"
    assert printable("\x1b[31m\n\u202e\udcff") == r"\x1b[31m\n\u202e\udcff"


def test_a_value_is_cut_where_it_is_long() -> None:
    assert shown("x") == "'x'"
    assert shown("x" * 1000) == f"'{'x' * (LONGEST_SHOWN - 3)} …"
    assert shown(int("F" * 5000, 16)) == "an integer of 20000 bits"
    deep: dict[str, object] = {}
    for _ in range(5000):
        deep = {"a": deep}
    assert shown(deep) == "tables within tables"
    assert cut("y" * LONGEST_SHOWN) == "y" * LONGEST_SHOWN


def test_of_many_names_the_first_are_said() -> None:
    assert first_of(["a", "b"], "more") == ["a", "b"]
    names = [str(n) for n in range(MAX_REPORTED + 5)]
    assert first_of(names, "keys are not known") == [*names[:MAX_REPORTED], "5 more keys are not known"]


def test_an_error_is_fit_to_print() -> None:
    assert str(ArctrackError(f"{HOSTILE}\n  x")).isprintable()


@pytest.fixture
def hostile(recording: Path, tmp_path: Path) -> Path:
    """Return a recording with hostile names: its folder's, its metal's, a key's, a column's."""
    path = Path(shutil.copytree(recording, tmp_path / HOSTILE))
    toml('name = "mild_steel"', 'name = "\\u001b[31mred [bold]$\\\\frac$[/nothing]"')(path)
    toml_end('["\\u001b[2J [bold]"]\nx = 1')(path)
    header, *rows = (path / "frames.csv").read_text().splitlines()
    text = "\n".join([f"{header},\x1b[31m[/bold]", *(f"{row},1" for row in rows)])
    (path / "frames.csv").write_text(text)
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [["inspect"], ["replay"], ["explain", "2"], ["plan", "--out"], ["diagnose"]],
    ids=lambda c: c[0],
)
def test_names_are_shown_and_not_obeyed(
    command: list[str],
    hostile: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name, *rest = command
    rest = [*rest, str(tmp_path / "plan")] if name == "plan" else rest
    monkeypatch.setattr("sys.argv", ["arctrack", name, str(hostile), *rest])
    with pytest.raises(SystemExit) as end:
        cli.main()
    # Frames of noise hold no seam: what is said of that is another test's.
    assert end.value.code in (0, 2, 3)
    printed = capsys.readouterr()
    for text in (printed.out, printed.err):
        assert "\x1b" not in text
        assert "\udcff" not in text
        assert "Traceback" not in text
    if name not in ("plan", "diagnose"):
        assert r"\x1b[31m[/bold] is not known" in printed.err
    for page in (*hostile.rglob("*.html"), *hostile.rglob("*.json")):
        assert "\x1b" not in page.read_text(encoding="utf-8")


def test_a_recordings_name_is_fit_to_print(hostile: Path) -> None:
    assert read_recording(hostile).name == printable(HOSTILE)


def test_a_title_is_no_formula() -> None:
    figure = style.new_figure(4.0, 2.0, f"{HOSTILE}\nbelow")
    figure.savefig(io.BytesIO(), format="png")
    (title,) = figure.texts
    assert title.get_text() == "a$\\frac$b\\x1b[31m[bold]x[blink] ??\\udcff\\u202e\nbelow"


def test_a_page_of_a_folder_whose_name_is_no_utf8(tmp_path: Path) -> None:
    write_whole(tmp_path / "page.html", "a\udcffb")
    assert (tmp_path / "page.html").read_text(encoding="utf-8") == "a\\udcffb"


def test_a_terminal_that_knows_ascii_alone(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refusal: Refusal
) -> None:
    path = Path(shutil.copytree(recording, tmp_path / "Ångström"))
    said = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", said)
    monkeypatch.setattr("sys.argv", ["arctrack", "inspect", str(path)])
    with pytest.raises(SystemExit, match="0"):
        cli.main()
    said.flush()
    assert b"\\xc5ngstr\\xf6m" in said.buffer.getvalue()
