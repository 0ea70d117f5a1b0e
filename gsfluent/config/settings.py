"""Sections of a shot that set how a stage works."""

# ruff: noqa: RUF009 - key() makes a dataclass field, not a shared default

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from gsfluent.config.read import (
    Place,
    Section,
    choice,
    either,
    existing_path,
    flag,
    key,
    nested,
    number,
    optional,
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
    "ply-seq", "spz", "splat", "ksplat", "sog", "glb", "delta", "usd", "vtk", "points", "vti",
    "meshes",
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
class ReconstructSettings(Section):
    """``reconstruct:`` - photographs to splats. None leaves the choice to the stage."""

    iterations: int | None = optional(whole(1, 1_000_000), "Optimisation steps.", "7000")
    max_gaussians: int | None = optional(
        whole(10, 50_000_000), "Upper limit of the number of splats.", "300000"
    )
    kernel: str | None = optional(
        choice("isotropic", "anisotropic"), "Shape of the splats.", "anisotropic"
    )
    scale_regularization: float | None = optional(
        number(0.0, 1e6), "Weight of the penalty on large splats.", "1.0"
    )
    image_size: int | None = optional(
        whole(24, 8192), "Longest side of the photographs while fitting [pixels].", "800"
    )
    sh_degree: int | None = optional(whole(0, 3), "Degree of the view-dependent colours.", "0")
    recipe: str | None = optional(
        choice("auto", "quick", "long", "classic"),
        "Schedule; auto follows the number of steps.",
        "long",
    )
    densify: str | None = optional(
        choice("adc", "mcmc"),
        "How splats are added: where photographs pull, or towards a budget.",
        "mcmc",
    )
    target_psnr: float | None = optional(
        number(1.0, 100.0),
        "PSNR on the photographs that is enough [dB]; splats are added only below it.",
        "32",
    )
    exposure: bool | None = optional(flag, "Learn an affine colour change per photograph.", "true")
    deterministic: bool | None = optional(
        flag,
        "The same bits from the same photographs on the same GPU, for some time; a CPU gives them "
        "anyway.",
        "true",
    )


@dataclasses.dataclass(frozen=True)
class HeatSettings(Section):
    """``heat:`` - what is around objects that have a temperature."""

    air: float = key(number(-273.15), "Temperature of the air [degrees C].", "-10", default=20.0)
    transfer: float = key(
        number(0.0),
        "Heat that the air gives or takes [W/(m^2 K)]; 5 to 10 when it is still, 0 for none.",
        "50",
        default=10.0,
    )
    floor: float | None = optional(
        number(-273.15),
        "Temperature of the floor [degrees C]; it lets no heat through when absent.",
        "60",
    )
    speed: float = key(
        number(0.0),
        "How many times faster heat flows than things move: ice melts in an hour, a film has "
        "seconds.",
        "100",
        default=1.0,
    )


@dataclasses.dataclass(frozen=True)
class FillSettings(Section):
    """``fill:`` - a shell of splats to a solid."""

    method: str = key(
        choice("auto", "vote", "density", "hull", "tsdf"),
        "How the inside is found: rays (vote), with masks (hull, density), depths (tsdf).",
        "auto",
        default="auto",
    )
    hollow: str | float = key(
        either(choice("auto", "none"), number(above=0.0)),
        "auto: seen cavities stay empty; none: solid through; or a wall thickness [m].",
        "auto",
        default="auto",
    )
    resolution: int | None = optional(
        whole(8, 512),
        "Voxels along the longest side; by default two per cell of the simulation, at least 96 "
        "for the largest object.",
        "96",
    )

    def given(self, scale: float = 1.0) -> dict[str, Any]:
        """Return the settings that are set, as keyword arguments of the stage.

        Args:
            scale: Metres per world unit: the stage works in world units, the shot file in metres.
        """
        values = super().given()
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
class PhotoSettings(Section):
    """``texture: photo:`` - what is done to exemplar photographs before their material is used."""

    cutout: str | None = optional(
        choice("auto", "ground", "grabcut", "none"),
        "How the object is told from its ground; none takes the whole picture as material.",
        "auto",
    )
    rim: bool | None = optional(flag, "Take leftovers of the surroundings off the rim.", "true")
    holes: bool | None = optional(flag, "Paint open cavities in the colour of their walls.", "true")
    glints: bool | None = optional(flag, "Paint over specular spots.", "true")
    shading: bool | None = optional(flag, "Even out a gradient of the light.", "true")
    white: str | float | tuple[float, ...] | None = optional(
        _white,
        "White balance: auto, none, skin (as the object's), kelvin, or [r, g, b] of a white.",
        "auto",
    )
    stain: bool | None = optional(
        flag, "Give stained (grey) parts the colour of the unstained ones.", "true"
    )
    palette: str | None = optional(text, "Take the colours of this preset instead.", "apple")


@dataclasses.dataclass(frozen=True)
class TextureSettings(Section):
    """``texture:`` - colours for the inside."""

    method: str | None = optional(
        choice("auto", *_TEXTURE_METHODS),
        "How the inside gets its colours; by default from the exemplar if there is one, "
        "else by the preset, or the one of the material.",
        "exemplar",
    )
    exemplar: Path | None = optional(
        existing_path,
        "Photograph of a cut through such an object; other methods compare with it.",
        "cut.jpg",
    )
    preset: str | None = optional(
        text, "Procedural recipe (method procedural); the material's when absent.", "watermelon"
    )
    prompt: str | None = optional(
        text, "What the inside looks like (method diffusion).", "ripe watermelon flesh"
    )
    model: str | None = optional(
        text,
        "Folder or hub id of a diffusers inpainting model (method diffusion).",
        "models/sdxl-inpainting",
    )
    quality: str | None = optional(
        choice("preview", "fast", "full"), "Effort (method exemplar).", "fast"
    )
    scale: float | None = optional(
        number(0.01, 100.0),
        "Size of the exemplar's structure relative to the automatic choice.",
        "1.0",
    )
    guide: str | None = optional(
        choice("auto", "depth", "axis", "none"),
        "What patches are matched by: depth, or a cut across the axis (method exemplar).",
        "auto",
    )
    directional: bool | None = optional(
        flag, "Grained: the exemplar is not turned (method exemplar).", "true"
    )
    inclusions: bool | None = optional(
        flag, "Find seeds and stones in the exemplar and place them (method exemplar).", "true"
    )
    cut: str | None = optional(
        choice("across", "along"),
        "The photograph was cut across or along the object's axis: sweep its structure.",
        "across",
    )
    photo: PhotoSettings | None = optional(
        nested(PhotoSettings), "Preparation of photographs (method exemplar).", "{stain: true}"
    )
    inpaint: InpaintSettings | None = optional(
        nested(InpaintSettings),
        "How slices are inpainted (methods diffusion and inpaint).",
        "{tile: 2, memory: balanced}",
    )
    polish: bool | None = optional(
        flag, "Fit interior splats coarser than the voxels to slices of the colours.", "true"
    )

    @property
    def chosen(self) -> str:
        """The method that the stage will take."""
        if self.method not in (None, "auto"):
            return str(self.method)
        return "exemplar" if self.exemplar else "procedural"

    def given(self) -> dict[str, Any]:
        """Return the settings that are set, as keyword arguments of the stage."""
        values = super().given()
        if self.photo is not None:
            values["photo"] = self.photo.given()
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
    method = settings.chosen
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
    }.get(method)
    if needed == "preset" and settings.method in (None, "auto"):
        return settings  # the material's
    if needed is not None and getattr(settings, needed) is None:
        raise InputError(
            f"{place.inside(needed).path} is missing",
            f"method {method} needs it; or choose another",
        )
    return settings


@dataclasses.dataclass(frozen=True)
class OutputSettings:
    """``output:`` - what is made of the simulation."""

    fps: float = key(number(1.0, 10000.0), "Frames per simulated second.", "30", default=30.0)
    seconds: float = key(number(0.0, 3600.0, above=0.0), "Simulated time [s].", "2", default=2.0)
    slow: float = key(
        number(0.01, 1000.0),
        "How many times slower than it happened the video plays: 10 shows 0.2 s in 2 s.",
        "10",
        default=1.0,
    )
    size: tuple[int, int] = key(
        _size, "Width and height of the video [pixels].", "[1280, 720]", default=(1280, 720)
    )
    camera: str | int | Path = key(
        _camera,
        "orbit, turntable, dolly, the number of a photograph (0 is the first), or a path: "
        "a JSON file, a transforms.json or a COLMAP folder.",
        "orbit",
        default="orbit",
    )
    backdrop: str = key(
        choice("studio", "light", "dark", "captured"),
        "What stands behind: the studio, light or dark, whichever the object is not, or one of "
        "them; or the surroundings that the capture shows.",
        "captured",
        default="studio",
    )
    cracks: str = key(
        choice("chunks", "gap", "mvee", "none"),
        "How pieces are drawn: cut from the solid by a smooth partition, splats born between "
        "points that part, transition splats from overlapping ellipsoids (both for comparison), "
        "or nothing added.",
        "none",
        default="chunks",
    )
    what: tuple[str, ...] = key(
        several(choice("mp4", *EXPORTS)), "What to write.", "[mp4, ply-seq]", default=("mp4",)
    )

    @property
    def video_fps(self) -> float:
        """Frames per second at which the video plays."""
        return self.fps / self.slow
