"""A self-contained HTML page: headings, words, tables, figures; no script, nothing fetched."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path

_CSS = """
:root { color-scheme: light dark; --ink: #1c1c1c; --paper: #ffffff; --line: #d9d9d9;
  --soft: #f4f5f3; --good: #0b6e4f; --bad: #b00020; --warn: #8a6100; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e8; --paper: #161816; --line: #3a3d3a;
  --soft: #202320; --good: #5fd0a5; --bad: #ff7b8a; --warn: #e6bf5a; } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 68rem; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .6rem 0; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid var(--line); text-align: left;
  vertical-align: top; } th { background: var(--soft); }
td.number { text-align: right; white-space: nowrap; } .wide { overflow-x: auto; }
.good { color: var(--good); font-weight: 600; } .bad { color: var(--bad); font-weight: 600; }
.warn { color: var(--warn); font-weight: 600; }
figure { margin: 1rem 0; } figcaption { font-size: .9rem; opacity: .8; }
figure img, figure video { max-width: 100%; height: auto; }
figure .paper { background: #ffffff; display: inline-block; max-width: 100%; }
figure svg { max-width: 100%; height: auto; }
.sheet { display: grid; gap: .6rem; grid-template-columns: repeat(auto-fill, minmax(11rem, 1fr)); }
.sheet figure { margin: 0; }
code { background: var(--soft); padding: .05rem .3rem; }
"""
_KINDS = ("", "good", "bad", "warn")


def shown(value: object) -> str:
    """A value as a cell shows it: four digits of a number, yes and no, nothing for None."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", " ")
    if isinstance(value, float):
        if not math.isfinite(value):
            return str(value)
        size = abs(value)
        return f"{value:.4g}" if size == 0.0 or 1e-3 <= size < 1e5 else f"{value:.2e}"
    return str(value)


def markdown_table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown, a line a row."""
    lines = (head, ["---"] * len(head), *rows)
    cells = ([shown(cell).replace("|", "\\|") for cell in line] for line in lines)
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)


class Page:
    """A page under construction; every method but :meth:`write` returns the page.

    Args:
        title: Title and first heading.
        subtitle: One line under it.
    """

    def __init__(self, title: str, subtitle: str = "") -> None:
        self.title = title
        self._parts = [f"<h1>{html.escape(title)}</h1>"]
        if subtitle:
            self.text(subtitle)

    def heading(self, text: str) -> Page:
        """Begin a section."""
        self._parts.append(f"<h2>{html.escape(text)}</h2>")
        return self

    def text(self, text: str, *, kind: str = "") -> Page:
        """Add a paragraph.

        Args:
            text: Plain text.
            kind: ``good``, ``bad`` or ``warn`` to colour it.

        Raises:
            ValueError: Another kind.
        """
        self._parts.append(f"<p{_class(kind)}>{html.escape(text)}</p>")
        return self

    def listing(self, items: Iterable[str], *, kind: str = "") -> Page:
        """Add a list; nothing for no items."""
        rows = "".join(f"<li{_class(kind)}>{html.escape(item)}</li>" for item in items)
        if rows:
            self._parts.append(f"<ul>{rows}</ul>")
        return self

    def table(self, head: Sequence[str], rows: Iterable[Sequence[object]]) -> Page:
        """Add a table; numbers stand to the right.

        Raises:
            ValueError: A row has another length than the head.
        """
        lines = ["".join(f"<th>{html.escape(cell)}</th>" for cell in head)]
        for row in rows:
            if len(row) != len(head):
                raise ValueError(f"table: a row of {len(row)} cells under {len(head)} headings")
            lines.append("".join(_cell(cell) for cell in row))
        body = "".join(f"<tr>{line}</tr>" for line in lines)
        self._parts.append(f'<div class="wide"><table>{body}</table></div>')
        return self

    def svg(self, svg: str, caption: str = "") -> Page:
        """Add a drawing of :func:`gsfluent.figure.style.to_svg`, on white in the dark too."""
        return self._figure(f'<div class="paper">{svg}</div>', caption)

    def picture(self, path: str | Path, caption: str = "") -> Page:
        """Add a PNG or JPEG, kept inside the page.

        Raises:
            InputError: The file is not there or of another kind.
        """
        path = Path(path)
        kinds = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}
        if path.suffix.lower() not in kinds or not path.is_file():
            raise InputError(f"{path}: no picture (.png, .jpg)", "name a picture that exists")
        data = base64.b64encode(path.read_bytes()).decode()
        kind, words = kinds[path.suffix.lower()], html.escape(caption or path.stem)
        return self._figure(f'<img alt="{words}" src="data:image/{kind};base64,{data}">', caption)

    def sheet(self, pictures: Iterable[tuple[str, str, str]]) -> Page:
        """Add small pictures side by side that lie beside the page.

        Args:
            pictures: Name of each, of what it leads to, and its caption.
        """
        cells = (
            f'<figure><a href="{html.escape(target, quote=True)}"><img loading="lazy" alt="" '
            f'src="{html.escape(name, quote=True)}"></a>'
            f"<figcaption>{html.escape(caption)}</figcaption></figure>"
            for name, target, caption in pictures
        )
        self._parts.append(f'<div class="sheet">{"".join(cells)}</div>')
        return self

    def video(self, name: str, caption: str = "") -> Page:
        """Add a video that lies beside the page under this name."""
        source = html.escape(name, quote=True)
        return self._figure(f'<video controls loop muted src="{source}"></video>', caption)

    def render(self) -> str:
        """The page as text."""
        body = "\n".join(self._parts)
        return (
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{html.escape(self.title)}</title><style>{_CSS}</style></head>\n"
            f"<body>\n{body}\n</body></html>\n"
        )

    def write(self, path: str | Path) -> Path:
        """Write the page, under a temporary name until it is whole.

        Raises:
            RunError: The disk is full or the folder cannot be written.
        """
        path = Path(path)
        with atomic_path(path) as temporary:
            temporary.write_text(self.render(), encoding="utf-8")
        return path

    def _figure(self, inner: str, caption: str) -> Page:
        words = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
        self._parts.append(f"<figure>{inner}{words}</figure>")
        return self


def _class(kind: str) -> str:
    if kind not in _KINDS:
        raise ValueError(f"kind must be one of {', '.join(_KINDS[1:])}, got {kind!r}")
    return f' class="{kind}"' if kind else ""


def _cell(value: object) -> str:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    kind = ' class="number"' if number else ""
    return f"<td{kind}>{html.escape(shown(value))}</td>"
