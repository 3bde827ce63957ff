"""Style of all pictures: Okabe and Ito's colours, which the colour-blind distinguish, and plain axes."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font

from arctrack.printable import printable

BLUE, VERMILLION, GREEN, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9"
YELLOW, GREY, BLACK = "#F0E442", "#7F7F7F", "#000000"


def new_figure(width_inch: float, height_inch: float, title: str) -> Figure:
    """Return an empty figure that arranges itself, without pyplot and its state."""
    figure = Figure(figsize=(width_inch, height_inch), dpi=110, layout="constrained")
    lines = (_drawable(printable(line)) for line in title.splitlines())
    # A dollar in a name begins no formula.
    figure.suptitle("\n".join(lines), fontsize=12, fontweight="bold", x=0.01, ha="left", parse_math=False)
    return figure


def _drawable(text: str) -> str:
    font = get_font(findfont(FontProperties(weight="bold")))
    return "".join(letter if font.get_char_index(ord(letter)) else "?" for letter in text)


def over_image(axes: Axes, width: int, height: int) -> Axes:
    """Show axes over a whole image of `width` x `height` px, the first row on top."""
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    return axes


def plain(axes: Axes, xlabel: str, ylabel: str, title: str = "") -> Axes:
    """Label axes and take what is not needed off them."""
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.set_title(title, loc="left", fontsize=10)
    axes.grid(visible=True, color="#DDDDDD", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_axisbelow(True)
    return axes
