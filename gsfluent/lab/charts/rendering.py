"""Rendering: how far a picture is from the converged one, by Gaussians, colours, precision, size.

The melon of the demo as glossy opaque splats, whose view-dependent colours are known to third
degree. The truth of the first case is the picture of all of them in float64; that of the others is
taken on three times the pixels each way and averaged, as a camera with square pixels sees it: there
the rasterizer's own low-pass counts as an error.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.demo import make_object
from gsfluent.lab.charts.quality import Job, Outcome, timed

XLABEL = "seconds per picture"
YLABEL = "rms error of display values"
FINE = 3
_LOBE = 8.0
_GLOSS = 0.35
_KEY = (0.45, -0.35, 0.82)


@dataclasses.dataclass(frozen=True)
class Splats:
    """Splats as the rasterizer takes them."""

    means: Tensor  # [N, 3] in metres
    covars: Tensor  # xx, yy, zz, xy, xz, yz [N, 6] in square metres
    opacities: Tensor  # [N]
    sh: Tensor  # spherical harmonics of degree 3 [N, 16, 3]

    def to(self, *args: Any) -> Splats:
        """On another device or in another precision."""
        return Splats(*(getattr(self, f.name).to(*args) for f in dataclasses.fields(self)))


@dataclasses.dataclass(frozen=True)
class View:
    """A camera."""

    viewmat: Tensor  # world to camera [4, 4]
    size: int  # width and height [px]
    focal: float  # [px]

    def picture(self, splats: Splats, *, degree: int = 3, antialiased: bool = False,
                scale: int = 1) -> Tensor:  # fmt: skip
        """Picture [H, W, 3] before white, on ``scale`` times the pixels each way."""
        side = self.size * scale
        like = splats.means
        K = torch.tensor(
            [[self.focal * scale, 0, 0.5 * side], [0, self.focal * scale, 0.5 * side], [0, 0, 1]],
            dtype=like.dtype, device=like.device,
        )  # fmt: skip
        return ops.rasterize(
            like, splats.opacities, self.viewmat.to(like), K, side, side, covars=splats.covars,
            sh=splats.sh[:, : (degree + 1) ** 2].contiguous(),
            background=torch.ones(3, dtype=like.dtype, device=like.device),
            antialiased=antialiased, depth=False,
        ).image.clamp(0.0, 1.0)  # fmt: skip


@functools.lru_cache(maxsize=2)
def glossy_melon(grid: int) -> Splats:
    """Splats on the melon of the demo: six grids of ``grid``^2 rays that look at it, float64.

    Colours are those of its skin plus a Phong lobe about the mirrored key light, projected on
    harmonics of degree 3 by quadrature over the sphere.
    """
    melon = make_object("watermelon")
    reach = 3.0 * max(melon.axes)
    half = 1.05 * max(melon.axes) / reach
    axis = (torch.arange(grid, dtype=torch.float32) + 0.5) / grid * 2.0 - 1.0
    u, v = (half * x.reshape(-1) for x in torch.meshgrid(axis, axis, indexing="ij"))
    hits = []
    for number in range(6):
        along, side = number // 2, 1.0 if number % 2 else -1.0
        eye = melon.center.clone()
        eye[along] += side * reach
        direction = torch.zeros(grid * grid, 3)
        direction[:, along] = -side
        direction[:, (along + 1) % 3], direction[:, (along + 2) % 3] = u, v
        hits.append(melon.intersect(eye, direction)[1])
    points = torch.cat(hits)
    normal = melon.normal(points)
    color = melon.surface_color(points).to(torch.float64)
    width = 1.6 * max(melon.axes) / grid  # 0.8 of the distance of two rays: no gaps
    # flat: a tenth as thick as wide
    n = normal.to(torch.float64)
    outer = n[:, :, None] * n[:, None, :]
    covar = width**2 * (torch.eye(3, dtype=torch.float64) - 0.99 * outer)
    return Splats(
        points.to(torch.float64), geometry.pack_symmetric(covar),
        torch.full((points.shape[0],), 0.9, dtype=torch.float64), _glossy(color, n),
    )  # fmt: skip


def _glossy(color: Tensor, normal: Tensor) -> Tensor:
    """Harmonics of degree 3 of colour plus a lobe, [N, 16, 3]."""
    count = 400
    index = torch.arange(count, dtype=torch.float64) + 0.5
    polar = torch.acos(1.0 - 2.0 * index / count)
    turn = math.pi * (1.0 + math.sqrt(5.0)) * index
    sphere = torch.stack([turn.cos() * polar.sin(), turn.sin() * polar.sin(), polar.cos()], 1)
    basis = geometry.sh_basis(sphere, 3).to(torch.float64)
    key = torch.tensor(_KEY, dtype=torch.float64)
    key = key / key.norm()
    mirrored = 2.0 * (normal @ key)[:, None] * normal - key
    # harmonics take the way from the camera to the splat; the lobe opens towards the camera
    lobe = _GLOSS * ((-sphere @ mirrored.T).clamp(min=0.0) ** _LOBE)
    lobe = lobe * ((normal @ key) > 0.0)
    sh = (4.0 * math.pi / count) * (basis.T @ lobe).T[:, :, None].expand(-1, -1, 3).clone()
    sh[:, 0] += geometry.rgb_to_sh0(0.85 * color)
    return sh


def thinned(splats: Splats, keep: int) -> Splats:
    """Every ``keep``-th splat, larger so that the surface stays covered."""
    generator = torch.Generator().manual_seed(0)
    count = splats.means.shape[0]
    rows = torch.randperm(count, generator=generator)[: max(1, count // keep)].sort().values
    return Splats(
        splats.means[rows], splats.covars[rows] * keep, splats.opacities[rows], splats.sh[rows]
    )


def merged(splats: Splats, target: int) -> Splats:
    """Splats of a cube as one, mean and covariance matched; about ``target`` cubes."""
    low, high = torch.aminmax(splats.means, dim=0)
    edge = float((high - low).max()) * math.sqrt(3.0 / target)  # a surface: cells go as 1 / edge^2
    _, home = torch.unique(torch.floor((splats.means - low) / edge), dim=0, return_inverse=True)
    count = int(home.max()) + 1
    total = splats.opacities.new_zeros(count).index_add(0, home, splats.opacities)
    weight = splats.opacities / total[home]

    def mean(values: Tensor) -> Tensor:
        flat = values.reshape(values.shape[0], -1) * weight[:, None]
        found = flat.new_zeros(count, flat.shape[1]).index_add(0, home, flat)
        return found.reshape(count, *values.shape[1:])

    means = mean(splats.means)
    off = splats.means - means[home]
    spread = geometry.pack_symmetric(off[:, :, None] * off[:, None, :])
    return Splats(means, mean(splats.covars + spread), mean(splats.opacities), mean(splats.sh))


def _views(size: int, count: int, distance: float) -> list[View]:
    melon = make_object("watermelon")
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    reach = distance * max(melon.axes)
    found = []
    for number in range(count):
        turn, height = 2.0 * math.pi * number / count + 0.3, math.radians(25.0 - 20.0 * number)
        unit = [math.cos(turn) * math.cos(height), math.sin(turn) * math.cos(height),
                math.sin(height)]  # fmt: skip
        eye = melon.center + reach * torch.tensor(unit, dtype=torch.float64)
        found.append(View(geometry.look_at(eye, melon.center, up), size, 1.4 * size))
    return found


class _Case:
    """Views, truth and splats of one distance; the truth is made when first asked for."""

    def __init__(
        self, grid: int, size: int, distance: float, fine: int, device: torch.device
    ) -> None:
        self.grid, self.fine, self.device = grid, fine, device
        self.views = _views(size, 3, distance)

    @functools.cached_property
    def truth(self) -> list[Tensor]:
        found = []
        for view in self.views:
            picture = view.picture(glossy_melon(self.grid), scale=self.fine)
            side = view.size
            found.append(picture.reshape(side, self.fine, side, self.fine, 3).mean(dim=(1, 3)))
        return found

    def __call__(self, repeat: int, options: Mapping[str, Any]) -> Outcome:
        splats = glossy_melon(self.grid)
        if "thinned" in options:
            splats = thinned(splats, options["thinned"])
        if "merged" in options:
            splats = merged(splats, splats.means.shape[0] // options["merged"])
        dtype = torch.float64 if options.get("dtype") == "float64" else torch.float32
        splats = splats.to(self.device).to(dtype)
        degree, smooth = options.get("sh", 3), options.get("antialiased", False)
        share = options.get("size", 1.0)
        views = self.views
        if share != 1.0:
            views = [
                dataclasses.replace(v, size=int(v.size * share), focal=v.focal * share)
                for v in views
            ]

        def work() -> list[Tensor]:
            return [v.picture(splats, degree=degree, antialiased=smooth) for v in views]

        made, wall = timed(work, repeat, self.device)
        off = torch.stack([
            _scaled(image.cpu().double(), truth.shape[0]) - truth
            for image, truth in zip(made, self.truth, strict=True)
        ])  # fmt: skip
        error = float(off.square().mean().sqrt())
        return Outcome(
            error, [w / len(views) for w in wall], splats.means.shape[0],
            {"PSNR [dB]": -20.0 * math.log10(error) if error > 0.0 else math.inf,
             "largest": float(off.abs().max())},
        )  # fmt: skip


def _scaled(image: Tensor, side: int) -> Tensor:
    """Bilinear enlargement, or the mean of whole blocks, of a picture [H, W, 3]."""
    if image.shape[0] == side:
        return image
    moved = image.permute(2, 0, 1)[None]
    if image.shape[0] > side:
        small = torch.nn.functional.avg_pool2d(moved, image.shape[0] // side)
        return small[0].permute(1, 2, 0)
    big = torch.nn.functional.interpolate(moved, (side, side), mode="bilinear")
    return big[0].permute(1, 2, 0)


def jobs(*, device: torch.device, quick: bool = False) -> list[Job]:
    """The ladder: Gaussians merged or thinned, degrees of colour, precision, pixels."""
    grid, size = (40, 96) if quick else (150, 400)
    every: list[tuple[str, dict[str, Any]]] = [("", {})]
    every += [(f"merged to 1/{n}", {"merged": n}) for n in (2, 4, 16, 64)]
    every += [(f"every {n}th", {"thinned": n}) for n in (4, 16)]
    every += [(f"degree {n}", {"sh": n}) for n in (2, 1, 0)]
    every += [("float64", {"dtype": "float64"}), ("half size", {"size": 0.5})]
    every += [("merged to 1/16, degree 0", {"merged": 16, "sh": 0})]
    pixels: list[tuple[str, dict[str, Any]]] = [("", {}), ("antialiased", {"antialiased": True})]
    pixels += [("half size", {"size": 0.5}), ("double size, averaged", {"size": 2.0})]
    pixels += [(f"merged to 1/{n}, antialiased", {"merged": n, "antialiased": True})
               for n in (4, 16)]  # fmt: skip
    if quick:
        every = [row for row in every if row[0] in ("", "merged to 1/4", "degree 0", "half size")]
        pixels = pixels[:2]
    found = []
    for name, distance, fine, ladder in (
        ("near", 3.5, 1, every),
        ("near, true pixels", 3.5, FINE, pixels),
        ("far, true pixels", 16.0, FINE, pixels),
    ):
        case = _Case(grid, size, distance, fine, device)
        for words, options in ladder:
            settings = {"grid": grid, "pixels": size, **options}
            work = functools.partial(case, options=options)
            found.append(Job(f"glossy melon, {name}", words, settings, work))
    return found
