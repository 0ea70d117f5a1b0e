"""What the points of the maps say: margins, tables, pictures, one page."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from gsfluent.figure.map import Cell, Mark, Plane, draw_planes, place_of
from gsfluent.figure.page import Page
from gsfluent.lab.stability.maps import KIND_WORDS, LETTERS, Axis, Map, Point, Value

LETTER_WORDS = {letter: KIND_WORDS[kind] for kind, letter in LETTERS.items()}


@dataclasses.dataclass(frozen=True)
class Boundary:
    """How far the default of one map is from failing along one axis."""

    map: Map  # name of the map
    axis: Axis  # the axis that is walked along
    default: Value  # where the walk starts
    at: Value  # what the other axis stands at
    holds: Value | None  # the last value that held; None when the default itself fails
    fails: Value | None  # the first value that failed; None when none did
    kind: str = ""  # what failed there
    step: int | None = None  # after how many steps

    def factor(self, value: Value | None) -> float | None:
        """How many times the default a value is, or the default is of it; None without a ratio."""
        if isinstance(value, str) or isinstance(self.default, str) or value is None:
            return None
        if value == self.default:
            return 1.0
        if value <= 0 or self.default <= 0:
            return None
        return max(value / self.default, self.default / value)

    @property
    def margin(self) -> float | None:
        """Factor to the last point that held (0 when the default fails, None without a ratio)."""
        return 0.0 if self.holds is None else self.factor(self.holds)

    @property
    def inside(self) -> bool:
        """Whether the default holds."""
        return self.holds is not None


def _walk(
    m: Map, axis: Axis, at: Value, found: dict[tuple[Value, Value], Point], *, along_x: bool
) -> list[Boundary]:
    """From the default of one axis outwards, at one value of the other axis."""

    def of(value: Value) -> Point | None:
        return found.get((value, at) if along_x else (at, value))

    start = of(axis.default)
    if start is None:
        return []
    if not start.holds:
        return [
            Boundary(m, axis, axis.default, at, None, axis.default, start.kind, start.step)
        ]  # fmt: skip
    middle = axis.values.index(axis.default)
    walks = [axis.values[middle + 1 :], axis.values[:middle][::-1]]
    if axis.words:
        walks = [(v,) for v in axis.values if v != axis.default]
    result = []
    for walk in walks:
        last: Value = axis.default
        for value in walk:
            point = of(value)
            if point is None:
                continue
            if not point.holds:
                result.append(
                    Boundary(m, axis, axis.default, at, last, value, point.kind, point.step)
                )
                break
            last = value
        else:
            if walk and last != axis.default:
                result.append(Boundary(m, axis, axis.default, at, last, None))
    return result


def boundaries(m: Map, points: Iterable[Point], variant: str | None = None) -> list[Boundary]:
    """Walks through the star of a map along both axes, of gsfluent or another variant."""
    name = variant or m.variants[0]
    found = {(p.x, p.y): p for p in points if p.map == m.name and p.variant == name}
    return [
        *_walk(m, m.x, m.y.default, found, along_x=True),
        *_walk(m, m.y, m.x.default, found, along_x=False),
    ]


def worst(m: Map, points: Iterable[Point]) -> list[Boundary]:
    """For each setting of a map the walk of least margin, over all scenes it is meant to hold for.

    Along an axis that is a setting of the method the margin must be there whatever the other axis
    (where that is a property of the scene) stands at within its span; along a property of the scene
    the end of its span must hold.
    """
    found = {(p.x, p.y): p for p in points if p.map == m.name and p.variant == m.variants[0]}
    result: list[Boundary] = []
    for axis, other, along_x in ((m.x, m.y, True), (m.y, m.x, False)):
        ats = [other.default]
        if not other.setting:
            ats = [v for v in other.values if other.within(v)]
        for at in ats:
            result += _walk(m, axis, at, found, along_x=along_x)
    return result


def others(m: Map, points: Iterable[Point]) -> list[tuple[str, int, int]]:
    """For each other variant: points that it fails though gsfluent holds there, of how many."""
    chosen = [p for p in points if p.map == m.name]
    ours = {(p.x, p.y): p.holds for p in chosen if p.variant == m.variants[0]}
    rows = []
    for variant in m.variants[1:]:
        theirs = [p for p in chosen if p.variant == variant]
        failed = sum(1 for p in theirs if not p.holds and ours.get((p.x, p.y), False))
        rows.append((variant, failed, len(theirs)))
    return rows


Marks = Mapping[tuple[str, str], Sequence[Mark]]
"""Named points by (map, variant)."""


def planes(m: Map, points: Iterable[Point], marks: Marks | None = None) -> list[Plane]:
    """The panels of a map."""
    marks = marks or {}
    points = [p for p in points if p.map == m.name]
    result = []
    for n, variant in enumerate(m.variants):
        own = [p for p in points if p.variant == variant]
        cells = {
            (m.x.values.index(p.x), m.y.values.index(p.y)): Cell(p.step, LETTERS.get(p.kind, ""))
            for p in own
            if p.x in m.x.values and p.y in m.y.values
        }
        if not cells:
            continue
        star = (m.x.values.index(m.x.default), m.y.values.index(m.y.default))
        result.append(
            Plane(
                title=m.title if n == 0 else "", subtitle=variant, 
                x_label=m.x_labels.get(variant, m.x.label),
                y_label=m.y.label, xs=m.x.values, ys=m.y.values, cells=cells,
                limit=max(p.limit for p in own), star=star if n == 0 else None,
                marks=marks.get((m.name, variant), ()),
            )
        )  # fmt: skip
    return result


def named(m: Map, points: Sequence[Point], marks: Marks) -> list[str]:
    """What became of the named points of a map; one between cells is judged by those around it."""
    lines = []
    for variant in m.variants:
        found = {(p.x, p.y): p for p in points if p.map == m.name and p.variant == variant}
        for mark in marks.get((m.name, variant), ()):
            x, y = place_of(m.x.values, mark.x), place_of(m.y.values, mark.y)
            if x is None or y is None:
                continue
            around = [
                found.get((m.x.values[i], m.y.values[j]))
                for i in {math.floor(x), math.ceil(x)} for j in {math.floor(y), math.ceil(y)}
            ]  # fmt: skip
            bad = [p for p in around if p is not None and not p.holds]
            what = "holds"
            if bad:
                what = f"{bad[0].kind}, step {bad[0].step}"
            elif None in around:
                continue
            at = f"{_shown(mark.x)} and {_shown(mark.y)}"
            lines.append(f"{mark.name}: {m.name}, {variant}, at {at}: {what}")
    return lines


MARGIN = 1.2
"""Factor by which a setting must be able to grow or shrink before anything fails."""
COARSE = 1.8
"""Neighbours further apart than this factor do not tell where between them the boundary lies."""
HEAD = ("map", "along", "default", "at", "holds to", "fails at", "what", "margin")


def row(b: Boundary) -> tuple[str, ...]:
    """A boundary as a row under :data:`HEAD`."""
    factor = b.margin
    margin = "-" if factor is None else f"{factor:.3g}"
    if b.fails is None and factor is not None:
        margin = f"> {factor:.3g}"
    what = "" if b.fails is None else f"{b.kind}, step {b.step}"
    return (
        b.map.name, b.axis.label, _shown(b.default), _shown(b.at),
        "nothing" if b.holds is None else _shown(b.holds),
        "none" if b.fails is None else _shown(b.fails), what, margin,
    )  # fmt: skip


def _shown(value: Value) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def least(found: Sequence[Boundary]) -> Boundary | None:
    """The one of least margin; one that fails before one without a ratio."""
    ranked = [b for b in found if b.fails is not None and b.margin is not None]
    return min(ranked, key=lambda b: b.margin or 0.0) if ranked else None


def table(maps: Sequence[Map], points: Sequence[Point]) -> list[tuple[str, ...]]:
    """One row per map and axis that is no list of words.

    Of a setting the walk of least margin over the scenes it is meant for, of a scene the walk from
    the star.
    """
    rows = []
    for m in maps:
        walks = worst(m, points)
        for axis in (m.x, m.y):
            own = [b for b in walks if b.axis is axis]
            if not axis.setting:
                own = [b for b in own if b.at == _star(m, axis)]
            if axis.words or not own:
                continue
            bounded = [b for b in own if b.fails is not None]
            rows.append(row(least(own) or (bounded or own)[0]))
    return rows


def _star(m: Map, axis: Axis) -> Value:
    return m.y.default if axis is m.x else m.x.default


def meant_to_hold(axis: Axis, value: Value) -> bool:
    """Whether a point is one of the default's: its setting, or a scene within the span."""
    return value == axis.default if axis.setting else axis.within(value)


def verdict(maps: Sequence[Map], points: Sequence[Point]) -> list[str]:
    """What is not inside with margin: empty when all is well."""
    wrong = []
    for m in maps:
        wrong += [
            f"{m.name}: fails at {m.x.name} {_shown(p.x)}, {m.y.name} {_shown(p.y)} ({p.kind})"
            for p in points
            if p.map == m.name and p.variant == m.variants[0] and not p.holds
            and meant_to_hold(m.x, p.x) and meant_to_hold(m.y, p.y)
        ]  # fmt: skip
        for b in worst(m, points):
            near, far = b.margin, b.factor(b.fails)
            if near is None or far is None or not b.inside or not b.axis.setting:
                continue
            if near < MARGIN and far < COARSE * near:
                wrong.append(f"{m.name}: margin {b.margin:.3g} of {b.axis.name} at {_shown(b.at)}")
    return sorted(set(wrong))


def write_all(
    maps: Sequence[Map], points: Sequence[Point], out: Path, marks: Marks | None = None
) -> Path:
    """Draw every map into ``out`` and put all on one page.

    Returns:
        The page.
    """
    out.mkdir(parents=True, exist_ok=True)
    marks = marks or {}
    drawn = [m for m in maps if any(p.map == m.name for p in points)]
    seconds = sum(p.seconds for p in points)
    devices = ", ".join(sorted({p.machine for p in points}))
    page = Page(
        "Where each variant first fails",
        f"{len(points)} points of {len(drawn)} maps, {seconds:.0f} s of computing on {devices}",
    )
    wrong = verdict(drawn, points)
    page.text(
        "The defaults are inside the stable region of every map, settings with a margin of 1.2 "
        "or more." if not wrong else "Not inside with margin:",
        kind="good" if not wrong else "bad",
    ).listing(wrong, kind="bad")  # fmt: skip
    page.heading("Least margins").table(HEAD, table(drawn, points))
    for m in drawn:
        picture = draw_planes(
            planes(m, points, marks), out / f"stability_{m.name}.png",
            kinds=LETTER_WORDS, columns=3,
        )  # fmt: skip
        page.heading(m.title)
        if m.note:
            page.text(m.note)
        page.picture(picture, f"{m.name}; test: {m.test}")
        page.table(HEAD, [row(b) for b in boundaries(m, points)])
        page.listing(
            f"{variant}: fails {failed} of {count} points where gsfluent holds"
            for variant, failed, count in others(m, points)
        )
        page.listing(named(m, points, marks))
    return page.write(out / "stability.html")
