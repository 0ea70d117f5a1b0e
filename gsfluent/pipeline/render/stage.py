"""The Render stage: Gaussians, a camera and light in; a picture with shadows and a floor out.

Shading is deferred: one pass of the rasterizer gives colour, opacity, depth and blended normals per
pixel, a second one from the lamps their shadow maps, and
:mod:`gsfluent.pipeline.light.shade` then lights
each pixel once. Siblings that repair created are composited nearest-only through ``groups``
(equations.md section 14).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsfluent import ops
from gsfluent.data import Camera, Gaussians
from gsfluent.draw import draw_at
from gsfluent.errors import InputError
from gsfluent.pipeline.light.lamps import SHININESS, SPECULAR, Lighting, pack_lamps
from gsfluent.pipeline.light.normals import Grid, grid_for, plate_normals, splat_normals
from gsfluent.pipeline.light.occlusion import Occupancy
from gsfluent.pipeline.light.shade import irradiance, pixel_rays, to_display, to_linear
from gsfluent.pipeline.light.shadow_maps import Bulk, Lit, bulk, faces_of, shadow_maps
from gsfluent.pipeline.liquid.clear import (
    OPACITY,
    Clear,
    Surface,
    body_opacities,
    ceiling,
    in_front,
    mirrored,
    single,
    smoothed,
    surface_normals,
)
from gsfluent.pipeline.liquid.closing import closed
from gsfluent.pipeline.liquid.sheet import TENSION
from gsfluent.pipeline.render.backdrop import Backdrop
from gsfluent.pipeline.render.merge import merged
from gsfluent.pipeline.render.studio import Studio
from gsfluent.pipeline.stage import Stage

# Pictures whose longest side is above this get shadow maps of the second size.
_LARGE = 800
_RESOLUTIONS = (512, 1024)
# Room of the occupancy grid for matter that flies apart; beyond, a new one is laid out.
_ROOM = 1.25
_NEAR = 0.01  # camera z [m] from which on splats are drawn
# Opacity of a splat of a liquid below which it fades; above, its thickness says how opaque it is.
_FADED = 0.3


@dataclass(frozen=True)
class Room:
    """The occupancy grid of a film, and the matter it was made for.

    Attributes:
        grid: Its size.
        radius: Largest radius of the matter [m] it has room for.
        count: Splats at that time.
    """

    grid: Grid
    radius: float
    count: int

    def fits(self, count: int, matter: Bulk) -> bool:
        """Whether it will do for this matter too."""
        alike = self.count < _ROOM * count and count < _ROOM * self.count
        return alike and 0.5 * self.radius < matter.radius <= self.radius


RoomTurn = Callable[[Callable[[Room | None], Room]], Room]
"""Gives what makes a room of the one before the one before, and returns what it makes."""


@dataclass(frozen=True)
class Picture:
    """What :class:`Render` returns.

    Attributes:
        image: Finished picture, display values in [0, 1], shape [H, W, 3].
        alpha: Opacity of the splats, shape [H, W].
        depth: Expected depth of the splats [m], 0 where there is none, shape [H, W].
        blended: Blended normals of the splats and what stands beside them, [H, W, K]; None when
            nothing was lit.
        room: What the next picture of a film takes on; None when nothing was lit.
        report: ``gaussians``, ``lamps``, ``shadow_maps`` and ``grid_cell`` [m].
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    blended: Tensor | None
    room: Room | None
    report: dict[str, Any]


class Render(Stage):
    """Gaussians to a picture.

    Args:
        camera: Default camera; a call may bring its own.
        light: The light; None leaves the captured colours as they are.
        studio: Floor and backdrop; None composites over ``background``.
        background: Display colour behind the splats when there is no studio.
        antialiased: Antialiased splatting (opacity compensation for the pixel filter).
        normal_cell: Spacing [m] of the grid behind normals and occlusion; found for every picture
            when None (a video fixes it with
            :func:`gsfluent.pipeline.light.normals.occupancy_cell` of its first frame).
    """

    name = "render"

    def __init__(
        self,
        camera: Camera | None = None,
        light: Lighting | None = None,
        *,
        studio: Studio | None = None,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        antialiased: bool = False,
        normal_cell: float | None = None,
    ) -> None:
        super().__init__()
        self.camera = camera
        self.light = light
        self.studio = studio
        self.background = background
        self.antialiased = antialiased
        self.normal_cell = normal_cell

    @torch.no_grad()
    def forward(
        self,
        gaussians: Gaussians,
        camera: Camera | None = None,
        *,
        groups: Tensor | None = None,
        gloss: Tensor | None = None,
        plates: Tensor | None = None,
        rigid: Tensor | None = None,
        backdrop: Backdrop | None = None,
        time: float = 0.0,
        room: Room | RoomTurn | None = None,
        clear: Clear | None = None,
        wet: Tensor | None = None,
    ) -> Picture:
        """Render one picture.

        Args:
            gaussians: Scene frame.
            camera: Overrides the stage's camera.
            groups: int32 [N], siblings of which only the nearest shades a pixel; -1 for none.
            gloss: k_s and n_s of Blinn-Phong per splat, [N, 2]; the default plastic when None. Not
                read when the light says what everything is like.
            plates: Flat splats whose shortest axis is the normal, bool [N]: those that draw rigid
                things. All others take theirs from the density of the matter, too.
            rigid: Splats that are set into the picture of the others pixel by pixel, bool [N]:
                those of blades and such, which others touch and do not mix with.
            backdrop: Captured surroundings before the studio; None for none.
            time: Moment [s], for lamps that move.
            room: ``room`` of the picture before in a film, so that the grid behind normals and
                occlusion stays what it was while the matter fits; or who knows it, given what
                makes this picture's of it.
            clear: The splats that are a liquid: drawn as its body and its surface, the same
                in ``alpha`` as if they were opaque. None draws them as all others.
            wet: How much of a film of water each splat has, which mirrors, [N]; None for none.

        Raises:
            InputError: No camera, or a camera with lens distortion.
        """
        camera = self._camera(camera)
        means = gaussians.means
        view = (_moved(camera.viewmat, means), _moved(camera.K, means))
        eye = -(view[0][:3, 3] @ view[0][:3, :3])
        lighting = None if self.light is None else self.light.at(time)
        everything, dense = (gaussians, groups), gaussians
        liquid = None
        if clear is not None and bool(clear.rows.any()):
            everything = (_as_body(gaussians, clear, eye), groups)
            through = clear.rows.masked_scatter(clear.rows, clear.attenuation.isfinite())
            if not bool(through.all()):
                dense = gaussians.select((~through).nonzero()[:, 0])
            liquid = _liquid(everything, _there(gaussians, clear), clear, camera, view)
            rest = (~clear.rows).nonzero()[:, 0]
            gaussians = gaussians.select(rest)
            groups, gloss, plates, rigid, wet = (
                None if value is None else value[rest]
                for value in (groups, gloss, plates, rigid, wet)
            )
        lit, extras, made = None, None, None
        if lighting is not None:
            lit, made = self._light(dense, camera, lighting, everything, room)
            if (
                clear is not None
                and bool(clear.rows.all())
                and bool(clear.attenuation.isfinite().all())
            ):
                lit = _open(lit)  # water hides no surroundings
            extras = splat_normals(gaussians, lit.grid, eye)
            if plates is not None:
                flat = plates.nonzero()[:, 0]
                extras = extras.index_copy(0, flat, plate_normals(gaussians.select(flat), eye))
            if gloss is not None and (lighting.specular is None or lighting.shininess is None):
                extras = torch.cat([extras, gloss.to(extras)], 1)
            if wet is not None:
                extras = torch.cat([extras, wet[:, None].to(extras)], 1)
        layers: list[Tensor | None] = [None]
        if rigid is not None and bool(rigid.any()) and not bool(rigid.all()):
            layers = [(~rigid).nonzero()[:, 0], rigid.nonzero()[:, 0]]
        seen, *others = (
            draw_at(
                gaussians if which is None else gaussians.select(which),
                *view,
                (camera.width, camera.height),
                near=_NEAR,
                depth=True,
                antialiased=self.antialiased,
                normals=extras if which is None or extras is None else extras[which],
                groups=groups if which is None or groups is None else groups[which],
            )
            for which in layers
        )
        for other in others:
            seen = merged(seen, other, view[1][0, 0])
        assert seen.depth is not None  # asked for
        image, alpha, depth = seen.image, seen.alpha, seen.depth
        behind = _constant(self.background, means.dtype, means.device)
        whole = lit is not None and backdrop is None  # object, floor and backdrop at once
        if liquid is not None:
            liquid = liquid.before(alpha, depth)
        if lit is not None and lighting is not None and seen.normal is not None:
            given, film = seen.normal, None
            if wet is not None:
                given, film = given[..., :-1].contiguous(), given[..., -1]
            vectors, gloss = _gloss(lighting, given, alpha)
            planes = (image, alpha, depth, vectors)
            if liquid is not None and liquid.opaque and whole:
                liquid, planes, gloss = liquid.shaded_with(planes, gloss)
            ground = behind if whole else torch.zeros_like(behind)
            floor = self.studio if whole else None
            image = _shaded(planes, gloss, view, lit, ground, floor)
            if film is not None:
                # under water there is no surface on it
                bare = film if liquid is None else film * (1.0 - liquid.there)
                image = _glazed(image, bare, vectors, view, lit)
        if not whole:
            if self.studio is not None:
                light = _plain_light(image) if lit is None else lit
                none, dull = (
                    torch.zeros_like(alpha),
                    _constant((0.0, 1.0), image.dtype, image.device),
                )
                nothing = torch.zeros_like(image)
                empty = (nothing, none, none, nothing)
                behind = _shaded(empty, dull, view, light, behind, self.studio)
            cover = alpha[..., None]
            if backdrop is None:
                image = image + behind * (1.0 - cover)
            else:
                captured, opacity, away = backdrop.draw(camera, lit)
                opaque = opacity[..., None]
                behind = captured + behind * (1.0 - opaque)
                image = image + behind * (1.0 - cover)
                # what is nearer than the matter hides it
                before = (opaque > 0.5) & (away < depth)[..., None] & (cover > 0.0)
                image = torch.where(before, captured + image * (1.0 - opaque), image)
            image = image.clamp(0.0, 1.0)
        if liquid is not None:
            image, alpha, depth = _wetted((image, alpha, depth), liquid, view, lit)
        report = {
            "gaussians": everything[0].count,
            "lamps": 0 if lit is None else len(lit.lamps),
            "shadow_maps": 0 if lit is None or lit.maps is None else len(lit.maps.depth),
            "grid_cell": None if made is None else made.grid.cell,
        }
        return Picture(image, alpha, depth, seen.normal, made, report)

    def _camera(self, camera: Camera | None) -> Camera:
        camera = camera or self.camera
        if camera is None:
            raise InputError("render: no camera", "give Render(camera) or call it with camera=")
        if any(camera.distortion):
            raise InputError(
                f"render: camera {camera.name!r} has lens distortion",
                "render with the undistorted pinhole camera that Capture.image() returns",
            )
        return camera

    def _light(
        self,
        gaussians: Gaussians,
        camera: Camera,
        lighting: Lighting,
        casters: tuple[Gaussians, Tensor | None],
        room: Room | RoomTurn | None,
    ) -> tuple[Lit, Room]:
        """Occupancy of this state of the matter, and shadow maps of what casts shadows."""
        shading, groups = casters
        matter = bulk(shading)

        def fitting(before: Room | None) -> Room:
            if before is not None and before.fits(gaussians.count, matter):
                return before
            radius = _ROOM * matter.radius
            grid = grid_for(gaussians, cell=self.normal_cell, radius=radius)
            return Room(grid, radius, gaussians.count)

        room = room(fitting) if callable(room) else fitting(room)
        lamps = lighting.drawn()
        faces = faces_of(lamps, matter)
        large = max(camera.width, camera.height) > _LARGE
        texels = lighting.resolution or _RESOLUTIONS[large]
        lit = Lit(
            pack_lamps(lamps, faces, gaussians.means),
            lighting.around(gaussians.means),
            shadow_maps(shading, lamps, faces, texels, matter, groups=groups),
            room.grid.of(gaussians, matter.center),
            lighting.occlusion,
        )
        return lit, room


def _there(gaussians: Gaussians, clear: Clear) -> Tensor:
    """How far splats of liquids are drawn, [M]: what tension draws into another drop has faded."""
    return (gaussians.opacities[clear.rows.nonzero()[:, 0]] / _FADED).clamp(max=1.0)


def _as_body(gaussians: Gaussians, clear: Clear, eye: Tensor) -> Gaussians:
    """The splats, those of liquids as transparent as their bodies are."""
    rows = clear.rows.nonzero()[:, 0]
    body = body_opacities(gaussians.select(rows), clear, eye) * _there(gaussians, clear)
    return gaussians.replace(
        opacities=gaussians.opacities.index_copy(0, rows, body.to(gaussians.opacities))
    )


@dataclass(frozen=True)
class _Liquid:
    """The liquids of a picture.

    Attributes:
        surface: Smoothed, without gaps.
        body: Colour and opacity where the surface has all of its, [H, W, 4].
        there: Opacity of the surface less where other things hide it, [H, W].
        done: Pixels whose light is in the picture of the rest already, bool [H, W].
        gloss: k_s and n_s, [2].
        opaque: No light goes through any of them.
        shadowed: What is opaque among them hides the surroundings of the others.
        spacing: Of their points [m].
    """

    surface: Surface
    body: Tensor
    there: Tensor
    done: Tensor
    gloss: Tensor
    opaque: bool
    shadowed: bool
    spacing: float

    def before(self, alpha: Tensor, depth: Tensor) -> _Liquid:
        """With what other things, their opacity and depth [H, W], leave to be seen."""
        return replace(self, there=in_front(self.surface, alpha, depth, self.spacing))

    def shaded_with(
        self, planes: tuple[Tensor, Tensor, Tensor, Tensor], gloss: Tensor | None
    ) -> tuple[_Liquid, tuple[Tensor, Tensor, Tensor, Tensor], Tensor | None]:
        """The planes of all else, and its gloss, with the liquid where it hides all else.

        What is behind it needs no light, and the liquid none of its own.
        """
        done = self.there > 0.999
        mine, alpha = done[..., None], planes[1]
        vectors, ours = planes[3], self.gloss.expand(*done.shape, 2)
        if gloss is not None:
            vectors = torch.cat([vectors[..., :3], gloss * alpha[..., None]], dim=2)
        normal = torch.cat([self.surface.normal, ours.to(vectors)], dim=2)
        made = (
            torch.where(mine, self.body[..., :3], planes[0]),
            alpha.masked_fill(done, 1.0),
            torch.where(done, self.surface.depth, planes[2]),
            torch.where(mine, normal, vectors),
        )
        return replace(self, done=done), made, None


def _liquid(
    everything: tuple[Gaussians, Tensor | None],
    there: Tensor,
    clear: Clear,
    camera: Camera,
    view: tuple[Tensor, Tensor],
) -> _Liquid:
    """The liquids, drawn.

    Args:
        everything: All splats, the liquids' as transparent as their bodies, and their groups.
        there: How far each of the liquids is drawn, [M].
        clear: The liquids.
        camera: Where from.
        view: Its matrices.
    """
    gaussians, groups = everything
    size, eye = (camera.width, camera.height), -(view[0][:3, 3] @ view[0][:3, :3])
    rows = clear.rows.nonzero()[:, 0]
    mine = gaussians.select(rows)
    spacing = max(float(clear.volume.median()) ** (1.0 / 3.0), TENSION)
    infinite = clear.attenuation.isinf()
    opaque = bool(infinite.all())
    front = mine.replace(opacities=(OPACITY * there).to(mine.opacities))
    normals = surface_normals(front, plate_normals(front, eye), eye)
    seen = draw_at(front, *view, size, near=_NEAR, depth=True, normals=normals)
    assert seen.depth is not None and seen.normal is not None  # asked for
    if opaque:
        body = torch.cat([seen.image, seen.alpha[..., None]], dim=2)
    else:
        paint = gaussians.means.new_zeros(gaussians.count, 4)
        paint[rows] = torch.cat([mine.colors(), torch.ones_like(mine.means[:, :1])], 1).to(paint)
        body = draw_at(gaussians, *view, size, colors=paint, near=_NEAR, groups=groups).image
    raw = Surface(seen.alpha, seen.depth, seen.normal)
    surface, body = closed(raw, body, spacing, camera)
    surface = smoothed(surface, spacing, camera)
    return _Liquid(
        surface,
        body,
        there=surface.alpha,
        done=torch.zeros_like(surface.alpha, dtype=torch.bool),
        gloss=clear.gloss.to(body),
        opaque=opaque,
        shadowed=bool(infinite.any()),
        spacing=spacing,
    )


def _glazed(
    image: Tensor, film: Tensor, normal: Tensor, view: tuple[Tensor, Tensor], lit: Lit
) -> Tensor:
    """The picture with what a film of water mirrors, ``film`` [H, W] of it in every pixel."""
    pixels = (film > 1e-3).flatten().nonzero()[:, 0]
    toward = normalize(normal[..., :3].flatten(0, 1)[pixels], dim=1)
    rays = pixel_rays(pixels, image.shape[1], *view)
    share, toward = mirrored(toward, rays)
    share = (share * film.flatten()[pixels])[:, None]
    # what stands low mirrors what it stands on, mostly itself in the shade
    open_ = 0.5 * (1.0 + toward[:, 2:])
    mirror = ceiling(toward)[:, None] + open_ * irradiance(lit.environment, toward)
    shown = to_linear(image.flatten(0, 1)[pixels])
    shown = to_display(shown * (1.0 - share) + share * mirror).clamp(0.0, 1.0)
    return image.flatten(0, 1).index_copy(0, pixels, shown.to(image)).view_as(image)


def _wetted(
    behind: tuple[Tensor, Tensor, Tensor],
    liquid: _Liquid,
    view: tuple[Tensor, Tensor],
    lit: Lit | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Picture, opacity and depth with liquids before what is behind them.

    Args:
        behind: The picture of all else, its opacity and depth.
        liquid: The liquids.
        view: The matrices of the camera.
        lit: The light; None for none.
    """
    image, alpha, depth = behind
    surface, there = liquid.surface, liquid.there
    cover = surface.alpha
    # what hides an opaque body hides its surface, of a clear one its splats in their order
    scale = (
        there if liquid.opaque else torch.minimum(cover, 1.0 / liquid.body[..., 3].clamp(min=1e-6))
    )
    body = (liquid.body * scale[..., None]).masked_fill(liquid.done[..., None], 0.0)
    taken, color, shine = body[..., 3], body[..., :3], None
    if lit is not None:
        none = torch.zeros_like(image[0, 0])
        gloss = liquid.gloss if liquid.opaque else _constant((0.0, 1.0), image.dtype, image.device)
        planes = (color, taken, surface.depth, surface.normal)
        # nothing hides the surroundings of what lets light through: no matter stands on a liquid
        color = _shaded(planes, gloss, view, lit if liquid.shadowed else _open(lit), none, None)
        if not liquid.opaque:
            anywhere = (there > 0.0).to(alpha)
            planes = (torch.zeros_like(image), anywhere, surface.depth, surface.normal)
            shine = _shaded(planes, liquid.gloss, view, _open(lit), none, None)
    # most of a picture is dry
    pixels = ((there > 0.0) | (taken > 0.0)).flatten().nonzero()[:, 0]
    old, left, add = (plane.flatten(0, 1)[pixels] for plane in (image, 1.0 - taken, color))
    shown = to_linear(old * left[:, None] + add)
    if lit is not None:
        share, toward = mirrored(
            surface.normal.flatten(0, 1)[pixels], pixel_rays(pixels, image.shape[1], *view)
        )
        bare = there * single(surface, liquid.spacing)
        share = (share * bare.flatten()[pixels])[:, None]
        mirror = ceiling(toward)[:, None] + irradiance(lit.environment, toward)
        shown = shown * (1.0 - share) + share * mirror
        if shine is not None:
            shown = shown + (bare[..., None] * to_linear(shine)).flatten(0, 1)[pixels]
    shown = to_display(shown).clamp(0.0, 1.0).to(image)
    nearer = (cover > 0.5) & ((surface.depth < depth) | (alpha < 0.5))
    return (
        image.flatten(0, 1).index_copy(0, pixels, shown).view_as(image),
        1.0 - (1.0 - alpha) * (1.0 - cover),
        torch.where(nearer, surface.depth, depth),
    )


def _open(lit: Lit) -> Lit:
    """The light where nothing hides the surroundings."""
    return replace(lit, occlusion=0.0)


def _shaded(
    seen: tuple[Tensor, Tensor, Tensor, Tensor],
    gloss: Tensor | None,
    view: tuple[Tensor, Tensor],
    lit: Lit,
    background: Tensor,
    studio: Studio | None,
) -> Tensor:
    """The lit picture of image, alpha, depth and vectors, over the studio if there is one."""
    return ops.shade(
        *seen,
        *view,
        lit.lamps,
        lit.environment,
        background,
        gloss=gloss,
        maps=None if lit.maps is None else tuple(lit.maps),
        grid=tuple(lit.grid) if lit.occlusion > 0.0 else None,
        occlusion=lit.occlusion,
        studio=None if studio is None else studio.packed(seen[0]),
    )


def _gloss(lighting: Lighting, given: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor | None]:
    """Vectors and ``gloss`` for :func:`gsfluent.ops.shade`: k_s, n_s per pixel, or of all."""
    specular, shininess = lighting.specular, lighting.shininess
    if given.shape[-1] < 5 or (specular is not None and shininess is not None):
        specular = SPECULAR if specular is None else specular
        shininess = SHININESS if shininess is None else shininess
        return given, _constant((specular, shininess), given.dtype, given.device)
    for column, value in ((3, specular), (4, shininess)):
        if value is not None:
            given[..., column] = value * alpha
    return given, None


def _moved(values: Tensor, like: Tensor) -> Tensor:
    """Host values on the device of ``like``, without waiting for it."""
    return values.to(like.dtype).to(like.device, non_blocking=True)


@functools.lru_cache(maxsize=64)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=dtype).to(device)


def _plain_light(like: Tensor) -> Lit:
    """The light of a floor under captured colours: even."""
    plain = Lighting(lamps=())
    grid = Occupancy(like.new_zeros(0), like.new_zeros(4), 0)
    return Lit(pack_lamps((), (), like), plain.around(like), None, grid, 0.0)
