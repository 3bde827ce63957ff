"""The picture of the joints in the docs is the one that the code draws, and has every type."""

from __future__ import annotations

from pathlib import Path

from noise_model.setup_keys import DIMENSIONS
from validation.figures.joint_sections import draw_joints, drawn_joints

DOCS = Path(__file__).parents[2] / "docs/reference"


def test_the_docs_show_every_joint_as_it_is_drawn() -> None:
    """Make it anew with: python -m validation.figures joints --out docs/reference/pictures."""
    assert (DOCS / "pictures/joints.svg").read_text() == draw_joints()
    assert {joint.type for _, joint in drawn_joints()} == set(DIMENSIONS) - {"flat"}
