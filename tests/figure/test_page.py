"""Pages and figures: whole, self-contained, the same bytes from the same numbers."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import pytest

from gsfluent.errors import InputError
from gsfluent.figure.page import Page, shown
from gsfluent.figure.style import new_figure, save_png, to_svg

VOID = {"meta", "img", "br", "path", "use", "rect", "line"}


class Balance(HTMLParser):
    """Every element that opens closes, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.words: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [v or "" for k, v in attrs if k in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def drawing() -> str:
    with new_figure(3.0, 2.0) as figure:
        axes = figure.subplots()
        axes.plot([1, 2, 3], [1.0, 4.0, 9.0])
        axes.set_xlabel("x < y & z")
        return to_svg(figure)


def page() -> Page:
    return (
        Page("A <b> & c", "what it is")
        .heading("one")
        .text("words", kind="good")
        .listing(["first", "<second>"])
        .table(["a", "b"], [["x", 1.0], ["<y>", 2]])
        .svg(drawing(), "a line")
    )


def test_page_is_balanced_escaped_and_fetches_nothing() -> None:
    pytest.importorskip("matplotlib")
    reader = Balance()
    reader.feed(page().render())
    assert reader.open == []
    text = "".join(reader.words)
    assert "A <b> & c" in text and "<second>" in text and "<y>" in text
    assert not [link for link in reader.links if "//" in link]


def test_same_numbers_same_bytes() -> None:
    pytest.importorskip("matplotlib")
    assert page().render() == page().render()


def test_a_row_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="2 headings"):
        Page("t").table(["a", "b"], [["x"]])


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="purple"):
        Page("t").text("x", kind="purple")


def test_pictures_travel_inside(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    with new_figure(1.0, 1.0) as figure:
        figure.subplots().plot([0, 1], [0, 1])
        save_png(figure, tmp_path / "a.png")
    Page("t").picture(tmp_path / "a.png", "words").write(tmp_path / "p.html")
    text = (tmp_path / "p.html").read_text()
    assert "data:image/png;base64," in text and sorted(p.name for p in tmp_path.iterdir()) == [
        "a.png",
        "p.html",
    ]
    with pytest.raises(InputError, match="no picture"):
        Page("t").picture(tmp_path / "none.png")


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, ""), (True, "yes"), (1234567, "1 234 567"), (0.12345678, "0.1235"), (1e-7, "1.00e-07"),
     (float("nan"), "nan"), ("x", "x")],
)  # fmt: skip
def test_how_values_are_shown(value: object, text: str) -> None:
    assert shown(value) == text
