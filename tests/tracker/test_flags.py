"""The registry of flags: its bits, its decoder and the documentation that it makes."""

from __future__ import annotations

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from tracker import flags

DOCS = Path(__file__).parents[2] / "docs"


def test_bits_and_names_are_unique_and_in_order() -> None:
    assert [flag.bit for flag in flags.FLAGS] == list(range(len(flags.FLAGS)))
    assert len({flag.name for flag in flags.FLAGS}) == len(flags.FLAGS)
    assert all(getattr(flags, flag.name.upper()) is flag for flag in flags.FLAGS)


@given(st.sets(st.sampled_from(flags.FLAGS)))
def test_names_are_those_of_the_bits(chosen: set[flags.Flag]) -> None:
    bits = sum(flag.mask for flag in chosen)
    assert set(flags.names(bits)) == {flag.name for flag in chosen}
    assert bool(bits & flags.INVALIDATING) == any(flag.invalidates for flag in chosen)


def test_the_documentation_is_in_step() -> None:
    """Regenerate with: python -m tracker.flags > docs/reference/flags.md."""
    assert (DOCS / "reference" / "flags.md").read_text() == flags.flags_table()


def test_the_page_on_invalid_frames_has_each_flag_that_invalidates() -> None:
    text = (DOCS / "how_to" / "no_valid_frame.md").read_text(encoding="utf-8")
    for flag in flags.FLAGS:
        assert (f"### {flag.name}\n" in text) == flag.invalidates
