"""One look for all figures, and how a figure becomes a file or a piece of a page."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsfluent.errors import need
from gsfluent.io.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OURS = "#0b6e4f"
"""Colour of gsfluent wherever it stands beside others."""
COLORS = ("#c1440e", "#31579c", "#8a5fb0", "#111111", "#b58900", "#2a9db0", "#a83264")
"""Colours of the others, told apart by people who see no red or green."""
FAILED = "#b00020"
INK = "#222222"
GRID = "#dddddd"

_STYLE: Any = {  # Any: matplotlib types its keys one by one
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same picture on every machine
    "font.size": 9.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "svg.hashsalt": "gsfluent",  # the same ids in every SVG: files that differ differ in content
}


@contextmanager
def new_figure(width: float, height: float, *, fitted: bool = True) -> Iterator[Figure]:
    """Yield an empty figure of this size [inches] under gsfluent's style; save it inside the block.

    ``fitted`` lets matplotlib find the margins, by drawing everything twice.

    No window system and no global state of pyplot are touched.

    Raises:
        MissingPackage: matplotlib is not installed.
    """
    need("matplotlib", "figures", "a figure")
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained" if fitted else None)
        FigureCanvasAgg(figure)
        yield figure


def save_png(figure: Figure, path: str | Path, *, dpi: int = 110) -> Path:
    """Write a PNG, under a temporary name until it is whole.

    Raises:
        RunError: The disk is full or the folder cannot be written.
    """
    path = Path(path)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format="png", metadata={"Software": None})
    return path


def to_svg(figure: Figure) -> str:
    """Return the figure as an ``<svg>`` element for :mod:`gsfluent.figure.page`."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]
