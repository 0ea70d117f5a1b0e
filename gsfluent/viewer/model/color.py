"""Colours that tell something: per splat, with the legend that explains them."""

from __future__ import annotations

import colorsys
import html
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsfluent.results.frames import SavedFrame
from gsfluent.viewer.model import look
from gsfluent.viewer.model.timeline import Timeline

_NONE = (0.62, 0.62, 0.64)  # splats without a material point, debris
# Neighbouring entries differ in hue and lightness, also for most colour-blind eyes.
_DISTINCT = (
    (0.20, 0.42, 0.75),
    (0.96, 0.60, 0.16),
    (0.27, 0.63, 0.36),
    (0.84, 0.22, 0.24),
    (0.56, 0.40, 0.74),
    (0.98, 0.80, 0.26),
    (0.18, 0.68, 0.72),
    (0.90, 0.45, 0.64),
    (0.55, 0.38, 0.28),
    (0.62, 0.78, 0.30),
    (0.42, 0.62, 0.90),
    (0.70, 0.16, 0.46),
)
_DAMAGE = ((0.0, (0.33, 0.44, 0.60)), (0.5, (0.98, 0.82, 0.36)), (1.0, (0.78, 0.10, 0.12)))
_DECADES = 4.0  # of the logarithmic energy scale
_LISTED = 8  # entries of a legend
_PALER = 0.4  # toward white, for broken matter on a piece
_STOPS = 24  # of a scale in the page


@dataclass(frozen=True)
class Legend:
    """What colours mean."""

    title: str  # Quantity and unit
    bar: np.ndarray | None = None  # Colours [B, 3] of a scale from left to right, or None
    ticks: tuple[str, ...] = ()  # Labels along the bar, evenly spaced
    # Colour and label each, for things that are counted.
    entries: tuple[tuple[tuple[float, float, float], str], ...] = ()

    def html(self) -> str:
        """The legend as HTML for the panel."""
        parts = [f'<div style="font-size:0.8em;font-weight:500">{html.escape(self.title)}</div>']
        if self.bar is not None:
            every = max(1, len(self.bar) // _STOPS)
            stops = ",".join(_css(color) for color in self.bar[::every])
            parts.append(
                f'<div style="height:12px;border-radius:3px;margin:4px 0 2px 0;'
                f'background:linear-gradient(to right,{stops})"></div>'
            )
            ticks = "".join(f"<span>{html.escape(tick)}</span>" for tick in self.ticks)
            parts.append(
                '<div style="display:flex;justify-content:space-between;font-size:0.75em;'
                f'opacity:0.75">{ticks}</div>'
            )
        for color, label in self.entries:
            chip = (
                '<span style="display:inline-block;width:11px;height:11px;border-radius:3px;'
                f'margin-right:6px;vertical-align:-1px;background:{_css(color)}"></span>'
            )
            parts.append(f'<div style="font-size:0.8em">{chip}{html.escape(label)}</div>')
        return f'<div style="padding:2px 14px 8px 14px;line-height:1.5">{"".join(parts)}</div>'


def splat_colors(
    frame: SavedFrame, timeline: Timeline, color_by: str
) -> tuple[Tensor | None, Legend | None]:
    """Colours [N, 3] in 0..1 of the splats of a frame, and their legend.

    Args:
        frame: The moment, on any device.
        timeline: Its timeline, for what must not change from frame to frame.
        color_by: One of :data:`gsfluent.viewer.model.look.COLOR_BY`.

    Returns:
        Two times None for the appearance, which needs neither.

    Raises:
        ValueError: Unknown ``color_by``.
    """
    if color_by == look.APPEARANCE:
        return None, None
    if color_by not in _PAINTERS:
        raise ValueError(f"color_by must be one of {', '.join(look.COLOR_BY)}, got {color_by!r}")
    points, legend = _PAINTERS[color_by](frame, timeline)
    anchor = frame.anchor.long()
    colors = points[anchor.clamp(min=0)]
    colors[anchor < 0] = colors.new_tensor(_NONE)
    return colors, legend


def _damage(frame: SavedFrame, timeline: Timeline) -> tuple[Tensor, Legend]:
    ramp = _ramp(_DAMAGE)
    legend = Legend("Damage", ramp, ("0 intact", "0.5", "1 broken"))
    return _mapped(frame.damage, ramp), legend


def _speed(frame: SavedFrame, timeline: Timeline) -> tuple[Tensor, Legend]:
    top = _round_up(timeline.top_speed())
    ramp = _library_ramp("VIRIDIS")
    legend = Legend("Speed [m/s]", ramp, ("0", _text(top / 2), _text(top)))
    return _mapped(frame.velocity.norm(dim=1) / top, ramp), legend


def _energy(frame: SavedFrame, timeline: Timeline) -> tuple[Tensor, Legend]:
    top = _round_up(0.5 * timeline.top_speed() ** 2)
    energy = 0.5 * frame.velocity.square().sum(dim=1)
    ramp = _library_ramp("INFERNO")
    share = 1.0 + torch.log10((energy / top).clamp(min=1e-12)) / _DECADES
    ticks = tuple(_text(top * 10.0 ** -(_DECADES - d)) for d in np.linspace(0, _DECADES, 3))
    return _mapped(share, ramp), Legend("Kinetic energy per mass [J/kg], log scale", ramp, ticks)


def _depth(frame: SavedFrame, timeline: Timeline) -> tuple[Tensor, Legend]:
    depth = timeline.depth(frame)
    top = max(float(timeline.depth(timeline.first).max()), 1e-6)
    unit, factor = ("mm", 1e3) if top < 0.03 else ("cm", 1e2) if top < 1.0 else ("m", 1.0)
    ramp = _library_ramp("PLASMA")
    ticks = ("0 skin", _text(factor * top / 2), _text(factor * top))
    return _mapped(depth / top, ramp), Legend(f"Depth below the skin [{unit}]", ramp, ticks)


def _fragment(frame: SavedFrame, timeline: Timeline) -> tuple[Tensor, Legend]:
    slots, broken = timeline.pieces.of(frame)
    colors, legend = _counted(slots, frame.volumes, "Fragments", "piece", rest="debris", offset=1)
    paler = broken & (slots >= 0)
    colors[paler] = colors[paler].lerp(torch.ones_like(colors[paler]), _PALER)
    if bool(paler.any()):
        note = Legend(legend.title + ", paler where broken", entries=legend.entries)
        return colors, note
    return colors, legend


def _material(frame: SavedFrame, timeline: Timeline) -> tuple[Tensor, Legend]:
    return _counted(frame.material.long(), frame.volumes, "Materials", "material", offset=1)


def _body(frame: SavedFrame, timeline: Timeline) -> tuple[Tensor, Legend]:
    names = [str(name) for name, *_ in frame.facts.get("bodies") or ()]
    return _counted(frame.body.long(), frame.volumes, "Bodies", "body", names=names)


_PAINTERS: dict[str, Callable[[SavedFrame, Timeline], tuple[Tensor, Legend]]] = {
    look.DAMAGE: _damage,
    look.FRAGMENT: _fragment,
    look.MATERIAL: _material,
    look.BODY: _body,
    look.SPEED: _speed,
    look.ENERGY: _energy,
    look.DEPTH: _depth,
}


def _counted(
    numbers: Tensor,
    volumes: Tensor,
    title: str,
    word: str,
    *,
    names: list[str] | None = None,
    rest: str = "none",
    offset: int = 0,
) -> tuple[Tensor, Legend]:
    """Distinct colours [P, 3] for small numbers [P], and a legend, largest share first."""
    found, inverse = numbers.unique(return_inverse=True)
    table = torch.tensor([distinct(int(n)) for n in found.tolist()], device=numbers.device)
    colors = table.reshape(-1, 3)[inverse]
    total = torch.zeros(found.shape[0], dtype=torch.float64, device=numbers.device)
    total.index_add_(0, inverse, volumes.double())
    shares = (total / total.sum().clamp(min=1e-30)).tolist()
    labels = found.tolist()
    rows = sorted(range(len(labels)), key=lambda row: -shares[row])
    entries = []
    for row in rows[:_LISTED]:
        label = labels[row]
        name = rest if label < 0 else f"{word} {label + offset}"
        if names and 0 <= label < len(names):
            name = names[label]
        entries.append((distinct(label), f"{name} · {_percent(shares[row])}"))
    more = len(rows) - len(entries)
    if more > 0:
        left = sum(shares[row] for row in rows[_LISTED:])
        entries.append((_NONE, f"{more} more · {_percent(left)}"))
    count = sum(1 for label in labels if label >= 0)
    return colors, Legend(f"{title}: {count}", entries=tuple(entries))


def distinct(number: int) -> tuple[float, float, float]:
    """A colour for a small number that does not change; grey below 0."""
    if number < 0:
        return _NONE
    if number < len(_DISTINCT):
        return _DISTINCT[number]
    # the golden ratio spreads hues evenly however many there are
    hue = (0.13 + number * 0.6180339887) % 1.0
    light = (0.52, 0.68, 0.42)[number % 3]
    return colorsys.hls_to_rgb(hue, light, 0.55)


def _mapped(share: Tensor, ramp: np.ndarray) -> Tensor:
    """Colours [P, 3] of values [P] in 0..1 on a ramp [B, 3]."""
    table = torch.from_numpy(ramp).to(share.device, torch.float32)
    last = table.shape[0] - 1
    return table[(share.nan_to_num(0.0) * last).round().long().clamp(0, last)]


def _ramp(stops: tuple[tuple[float, tuple[float, float, float]], ...]) -> np.ndarray:
    """256 colours [256, 3] through the given stops."""
    x = np.linspace(0.0, 1.0, 256)
    at = [stop[0] for stop in stops]
    return np.stack([np.interp(x, at, [stop[1][c] for stop in stops]) for c in range(3)], -1)


def _library_ramp(name: str) -> np.ndarray:
    """256 colours [256, 3] of one of OpenCV's colour maps."""
    import cv2

    values = np.arange(256, dtype=np.uint8)[:, None]
    mapped = cv2.applyColorMap(values, getattr(cv2, f"COLORMAP_{name}"))
    return mapped[:, 0, ::-1].astype(np.float64) / 255.0


def _css(color: np.ndarray | tuple[float, float, float]) -> str:
    red, green, blue = (round(255 * float(c)) for c in color)
    return f"rgb({red},{green},{blue})"


def _round_up(value: float) -> float:
    """The next number of the form 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    steps = (step * power for step in (1.0, 2.0, 5.0, 10.0))
    return float(next(step for step in steps if value <= 1.0001 * step))


def _text(value: float) -> str:
    return f"{value:.3g}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share >= 0.001 else "< 0.1 %"
