import pytest

from noise_model.spelling import cure_for, nearest

KNOWN = ("v_groove", "lap", "half_v", "kappa_diff", "kappa_spec")


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("vgroove", "v_groove"),
        ("V groove", "v_groove"),
        ("kapa_diff", "kappa_diff"),
        ("kappa-spec", "kappa_spec"),
        ("halfv", "half_v"),
        ("weather", None),
        ("", None),
    ],
)
def test_nearest(name: str, meant: str | None) -> None:
    assert nearest(name, KNOWN) == meant


def test_cure() -> None:
    assert cure_for("lapp", KNOWN) == "did you mean 'lap'?"
    assert cure_for("weather", KNOWN) == "there are v_groove, lap, half_v, kappa_diff, kappa_spec"
