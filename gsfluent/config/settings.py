"""Sections of a shot that set how a stage works."""

# ruff: noqa: RUF009 - key() makes a dataclass field, not a shared default

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from gsfluent.config.read import (
    Place,
    choice,
    either,
    existing_path,
    flag,
    given,
    key,
    nested,
    number,
    section,
    several,
    text,
    vector,
    whole,
)
from gsfluent.config.settings_inpaint import InpaintSettings
from gsfluent.errors import InputError

Vector = tuple[float, float, float]


def _size(value: Any, place: Place) -> tuple[int, ...]:
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise place.error("be [width, height]", value)
    sides = tuple(
        whole(16, 16384)(side, place.inside(str(index))) for index, side in enumerate(value)
    )
    if any(side % 2 for side in sides):
        raise place.error("be even numbers (video)", value)
    return sides


EXPORTS = (
    "ply-seq", "spz", "splat", "glb", "delta", "usd", "vtk", "points", "vti", "meshes",
)  # fmt: skip
"""What a run can write beside the video; ``gsfluent export`` writes these and more."""


def _camera(value: Any, place: Place) -> str | int | Path:
    if value in ("orbit", "turntable", "dolly"):
        return str(value)
    if isinstance(value, str):
        return existing_path(value, place)
    index: int = whole(0, 10**9)(value, place)
    return index


_TEXTURE_METHODS = (
    "exemplar",
    "diffusion",
    "inpaint",
    "color_copy",
    "procedural",
    "profile",
    "telea",
)


@dataclasses.dataclass(frozen=True)
class ReconstructSettings:
    """``reconstruct:`` - photographs to splats. None leaves the choice to the stage."""

    iterations: int | None = key(
        whole(1, 1_000_000), default=None, doc="Optimisation steps.", example="7000"
    )
    max_gaussians: int | None = key(
        whole(10, 50_000_000),
        default=None,
        doc="Upper limit of the number of splats.",
        example="300000",
    )
    kernel: str | None = key(
        choice("isotropic", "anisotropic"),
        default=None,
        doc="Shape of the splats.",
        example="anisotropic",
    )
    scale_regularization: float | None = key(
        number(0.0, 1e6), default=None, doc="Weight of the penalty on large splats.", example="1.0"
    )
    image_size: int | None = key(
        whole(24, 8192),
        default=None,
        doc="Longest side of the photographs while fitting [pixels].",
        example="800",
    )
    sh_degree: int | None = key(
        whole(0, 3), default=None, doc="Degree of the view-dependent colours.", example="0"
    )
    recipe: str | None = key(
        choice("auto", "quick", "long", "classic"),
        default=None,
        doc="Schedule; auto follows the number of steps.",
        example="long",
    )
    densify: str | None = key(
        choice("adc", "mcmc"),
        default=None,
        doc="How splats are added: where photographs pull, or towards a budget.",
        example="mcmc",
    )
    target_psnr: float | None = key(
        number(1.0, 100.0),
        default=None,
        doc="PSNR on the photographs that is enough [dB]; splats are added only below it.",
        example="32",
    )
    exposure: bool | None = key(
        flag, default=None, doc="Learn an affine colour change per photograph.", example="true"
    )

    def given(self) -> dict[str, Any]:
        """Return the settings that are set, as keyword arguments of the stage."""
        return given(self)


@dataclasses.dataclass(frozen=True)
class FillSettings:
    """``fill:`` - a shell of splats to a solid."""

    method: str = key(
        choice("auto", "vote", "density", "hull", "tsdf"), default="auto",
        doc="How the inside is found: rays (vote), with masks (hull, density), depths (tsdf).",
        example="auto",
    )  # fmt: skip
    hollow: str | float = key(
        either(choice("auto", "none"), number(above=0.0)),
        default="auto",
        doc="auto: seen cavities stay empty; none: solid through; or a wall thickness [m].",
        example="auto",
    )
    resolution: int | None = key(
        whole(8, 512),
        default=None,
        doc="Voxels along the longest side; by default two per cell of the simulation, at least 96 "
        "for the largest object.",
        example="96",
    )

    def given(self, scale: float = 1.0) -> dict[str, Any]:
        """Return the settings that are set, as keyword arguments of the stage.

        Args:
            scale: Metres per world unit: the stage works in world units, the shot file in metres.
        """
        values = given(self)
        if not isinstance(self.hollow, str):
            values["hollow"] = self.hollow / scale
        return values


def _white(value: Any, place: Place) -> str | float | tuple[float, ...]:
    if isinstance(value, str):
        return str(choice("auto", "none", "skin")(value, place))
    if isinstance(value, list | tuple):
        return tuple(vector(3, 0.0, 255.0)(value, place))
    return float(number(1000.0, 25000.0)(value, place))


@dataclasses.dataclass(frozen=True)
class PhotoSettings:
    """``texture: photo:`` - what is done to exemplar photographs before their material is used."""

    cutout: str | None = key(
        choice("auto", "ground", "grabcut", "none"),
        default=None,
        doc="How the object is told from its ground; none takes the whole picture as material.",
        example="auto",
    )
    rim: bool | None = key(
        flag, default=None, doc="Take leftovers of the surroundings off the rim.", example="true"
    )
    holes: bool | None = key(
        flag, default=None, doc="Paint open cavities in the colour of their walls.", example="true"
    )
    glints: bool | None = key(flag, default=None, doc="Paint over specular spots.", example="true")
    shading: bool | None = key(
        flag, default=None, doc="Even out a gradient of the light.", example="true"
    )
    white: str | float | tuple[float, ...] | None = key(
        _white,
        default=None,
        doc="White balance: auto, none, skin (as the object's), kelvin, or [r, g, b] of a white.",
        example="auto",
    )
    stain: bool | None = key(
        flag,
        default=None,
        doc="Give stained (grey) parts the colour of the unstained ones.",
        example="true",
    )
    palette: str | None = key(
        text, default=None, doc="Take the colours of this preset instead.", example="apple"
    )


@dataclasses.dataclass(frozen=True)
class TextureSettings:
    """``texture:`` - colours for the inside."""

    method: str | None = key(
        choice("auto", *_TEXTURE_METHODS),
        default=None,
        doc="How the inside gets its colours; by default from the exemplar if there is one.",
        example="exemplar",
    )
    exemplar: Path | None = key(
        existing_path,
        default=None,
        doc="Photograph of a cut through such an object; other methods compare with it.",
        example="cut.jpg",
    )
    preset: str | None = key(
        text, default=None, doc="Procedural recipe (method procedural).", example="watermelon"
    )
    prompt: str | None = key(
        text,
        default=None,
        doc="What the inside looks like (method diffusion).",
        example="ripe watermelon flesh",
    )
    model: str | None = key(
        text,
        default=None,
        doc="Folder or hub id of a diffusers inpainting model (method diffusion).",
        example="models/sdxl-inpainting",
    )
    quality: str | None = key(
        choice("preview", "fast", "full"),
        default=None,
        doc="Effort (method exemplar).",
        example="fast",
    )
    scale: float | None = key(
        number(0.01, 100.0),
        default=None,
        doc="Size of the exemplar's structure relative to the automatic choice.",
        example="1.0",
    )
    guide: str | None = key(
        choice("auto", "depth", "axis", "none"),
        default=None,
        doc="What patches are matched by: depth, or a cut across the axis (method exemplar).",
        example="auto",
    )
    directional: bool | None = key(
        flag,
        default=None,
        doc="Grained: the exemplar is not turned (method exemplar).",
        example="true",
    )
    inclusions: bool | None = key(
        flag,
        default=None,
        doc="Find seeds and stones in the exemplar and place them (method exemplar).",
        example="true",
    )
    cut: str | None = key(
        choice("across", "along"),
        default=None,
        doc="The photograph was cut across or along the object's axis: sweep its structure.",
        example="across",
    )
    photo: PhotoSettings | None = key(
        nested(PhotoSettings),
        default=None,
        doc="Preparation of photographs (method exemplar).",
        example="{stain: true}",
    )
    inpaint: InpaintSettings | None = key(
        nested(InpaintSettings),
        default=None,
        doc="How slices are inpainted (methods diffusion and inpaint).",
        example="{tile: 2, memory: balanced}",
    )
    polish: bool | None = key(
        flag,
        default=None,
        doc="Fit interior splats coarser than the voxels to slices of the colours.",
        example="true",
    )

    def given(self) -> dict[str, Any]:
        """Return the settings that are set, as keyword arguments of the stage."""
        values = given(self)
        if self.photo is not None:
            values["photo"] = given(self.photo)
        if self.inpaint is not None:
            values["inpaint"] = self.inpaint.given()
        return values


_TEXTURE_READERS = {
    "preset": ("procedural",),
    **dict.fromkeys(("prompt", "model", "inpaint"), ("diffusion", "inpaint")),
    **dict.fromkeys(
        ("quality", "scale", "guide", "directional", "inclusions", "cut", "photo"), ("exemplar",)
    ),
}
"""Keys of ``texture:`` that only these methods read."""


def read_texture(value: Any, place: Place) -> TextureSettings:
    """Read ``texture:`` and refuse keys that the method does not read."""
    settings = section(TextureSettings, value, place)
    method = settings.method
    if method in (None, "auto"):
        method = "exemplar" if settings.exemplar else "procedural" if settings.preset else "profile"
    for name, readers in _TEXTURE_READERS.items():
        if getattr(settings, name) is not None and method not in readers:
            raise InputError(
                f"{place.inside(name).path} does nothing with method {method}",
                f"remove it, or set method: {readers[0]}",
            )
    inpaint = settings.inpaint
    if (
        method in ("diffusion", "inpaint")
        and inpaint
        and inpaint.backend not in (None, "diffusers")
    ):
        return settings
    needed = {
        "exemplar": "exemplar",
        "procedural": "preset",
        "diffusion": "model",
        "inpaint": "model",
    }.get(method or "")
    if needed is not None and getattr(settings, needed) is None:
        raise InputError(
            f"{place.inside(needed).path} is missing",
            f"method {method} needs it; or choose another",
        )
    return settings


@dataclasses.dataclass(frozen=True)
class OutputSettings:
    """``output:`` - what is made of the simulation."""

    fps: float = key(
        number(1.0, 10000.0), default=30.0, doc="Frames per simulated second.", example="30"
    )
    seconds: float = key(
        number(0.0, 3600.0, above=0.0), default=2.0, doc="Simulated time [s].", example="2"
    )
    slow: float = key(
        number(0.01, 1000.0),
        default=1.0,
        doc="How many times slower than it happened the video plays: 10 shows 0.2 s in 2 s.",
        example="10",
    )
    size: tuple[int, int] = key(
        _size, default=(1280, 720), doc="Width and height of the video [pixels].",
        example="[1280, 720]",
    )  # fmt: skip
    camera: str | int | Path = key(
        _camera, default="orbit",
        doc="orbit, turntable, dolly, the number of a photograph (0 is the first), or a path: "
        "a JSON file, a transforms.json or a COLMAP folder.",
        example="orbit",
    )  # fmt: skip
    backdrop: str = key(
        choice("studio", "captured"), default="studio",
        doc="What stands behind: the studio, or the surroundings that the capture shows.",
        example="captured",
    )  # fmt: skip
    cracks: str = key(
        choice("gap", "mvee", "none"), default="gap",
        doc="How crack faces are drawn: splats born on the faces that open, transition splats from "
        "overlapping ellipsoids (for comparison), or nothing added.",
        example="none",
    )  # fmt: skip
    what: tuple[str, ...] = key(
        several(choice("mp4", *EXPORTS)),
        default=("mp4",),
        doc="What to write.", example="[mp4, ply-seq]",
    )  # fmt: skip

    @property
    def video_fps(self) -> float:
        """Frames per second at which the video plays."""
        return self.fps / self.slow
