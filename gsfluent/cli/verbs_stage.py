"""Verbs of one stage: poses, reconstruct, fill, texture, mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from gsfluent.cli.common import Out, Verb, existing
from gsfluent.errors import InputError


def _ply(path: Path) -> Path:
    if path.suffix.lower() != ".ply":
        raise InputError(f"-o {path}", "name a .ply file")
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


@dataclass(kw_only=True)
class Reconstruct(Verb):
    """Fit Gaussians to posed photographs.

    Examples:
      gsfluent reconstruct captures/apple -o apple.ply
      gsfluent reconstruct captures/apple -o apple.ply --iterations 7000 --max-gaussians 300000
      gsfluent reconstruct captures/apple -o apple.ply --image-size 400        # quick look
      gsfluent reconstruct captures/apple -o room.ply --keep-background

    CAPTURE is a COLMAP model (text or binary) with its images, or a folder with transforms.json;
    masks are used when there are any. Every eighth photograph is held out; its PSNR stands in
    reconstruct.json beside the .ply, with a page (.md) and a sheet of those photographs (.png).
    """

    capture: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURE")]
    """Folder with posed photographs."""
    out: Out
    """The .ply to write, standard 3DGS layout."""
    iterations: int | None = None
    """Optimisation steps."""
    max_gaussians: int | None = None
    """Upper limit of the number of Gaussians."""
    kernel: Literal["anisotropic", "isotropic"] | None = None
    """Shape of the Gaussians."""
    scale_regularization: float | None = None
    """Weight of the penalty on large Gaussians."""
    image_size: int | None = None
    """Longest side of the photographs in pixels while fitting."""
    sh_degree: int | None = None
    """Bands of view-dependent colour, 0 to 3."""
    recipe: Literal["auto", "quick", "long", "classic"] | None = None
    """Schedule; auto follows the number of steps."""
    densify: Literal["adc", "mcmc"] | None = None
    """How Gaussians are added: where photographs pull, or towards a budget."""
    target_psnr: float | None = None
    """PSNR in dB on the photographs that is enough; Gaussians are added only below it."""
    exposure: bool | None = None
    """Learn an affine colour change per photograph."""
    deterministic: bool | None = None
    """The same bits from the same photographs on the same GPU, for some time."""
    keep_background: bool = False
    """Keep what does not belong to the object."""

    def execute(self) -> dict[str, Any]:
        """Reconstruct and write."""
        from gsfluent.run.single import reconstruct_to

        existing(self.capture, "CAPTURE")
        with self.progress("reconstruct") as progress:
            return reconstruct_to(
                self.capture,
                _ply(self.out),
                device=self.torch_device(),
                seed=self.seed,
                keep_background=self.keep_background,
                progress=progress,
                **self.given("iterations", "max_gaussians", "kernel", "scale_regularization"),
                **self.given("image_size", "sh_degree", "recipe", "densify", "target_psnr"),
                **self.given("exposure", "deterministic"),
            )


@dataclass(kw_only=True)
class Fill(Verb):
    """Turn a shell of surface Gaussians into a solid with interior Gaussians.

    Examples:
      gsfluent fill melon.ply -o solid.ply
      gsfluent fill melon.ply -o solid.ply --capture captures/melon    # masks, depths, refinement
      gsfluent fill pepper.ply -o solid.ply --hollow 0.004             # a wall of 4 mm in metres
      gsfluent fill melon.ply -o solid.ply --solid scan.obj            # a scan says what is matter
      gsfluent fill scan.obj -o solid.ply                              # a mesh alone
      gsfluent fill captures/melon -o solid.ply                        # masks alone: visual hull

    Writes solid.ply (opens in any splat viewer) and solid.volume.npz (the voxels) beside it.
    """

    model: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """Splat .ply, mesh file, or capture folder with masks."""
    out: Out
    """The .ply to write."""
    capture: Path | None = None
    """Photographs that the splat was made from."""
    solid: Path | None = None
    """Mesh file that says what is matter, in the frame of the splat."""
    resolution: int | None = None
    """Voxels along the longest side; thin walls take more."""
    method: Literal["auto", "vote", "density", "hull", "tsdf"] | None = None
    """How the inside is found; auto decides."""
    hollow: str | None = None
    """auto (what cameras look into stays empty), none (solid through), or a wall thickness."""

    def execute(self) -> dict[str, Any]:
        """Fill and write."""
        from gsfluent.run.single import fill_to

        existing(self.model, "INPUT")
        with self.progress("fill") as progress:
            return fill_to(
                self.model,
                _ply(self.out),
                capture=self.capture,
                solid=self.solid,
                device=self.torch_device(),
                seed=self.seed,
                progress=progress,
                **self.given("resolution", "method", "hollow"),
            )


@dataclass(kw_only=True)
class Texture(Verb):
    """Give the inside of a solid its colours.

    Examples:
      gsfluent texture solid.ply -o textured.ply --material rock       # as rock is, in its colour
      gsfluent texture solid.ply -o textured.ply --exemplar cut.jpg    # from a photo of a cut
      gsfluent texture solid.ply -o textured.ply --exemplar apple.jpg --cut across
      gsfluent texture solid.ply -o textured.ply --method diffusion --model PATH --prompt "flesh"
      gsfluent texture solid.ply -o textured.ply --method inpaint --inpaint backend=telea tile=2

    Writes textured.ply with its volume, and textured.cuts.png with three cut views.
    """

    solid: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="solid.ply")]
    """Solid written by `gsfluent fill`."""
    out: Out
    """The .ply to write."""
    method: str | None = None
    """exemplar, diffusion, inpaint, color_copy or procedural."""
    exemplar: Path | None = None
    """Photograph of a cut through such an object."""
    preset: str | None = None
    """Procedural recipe: watermelon, apple, orange, bread, wood, marble, bone, ..."""
    material: str | None = None
    """Material that chooses the recipe when nothing else is given: bone, glass, chocolate, ..."""
    quality: str | None = None
    """Effort of the exemplar method: preview, fast or full."""
    guide: str | None = None
    """What patches are matched by: auto, depth, axis (a cut across the axis) or none."""
    cut: str | None = None
    """The photograph was cut across or along the axis: its star or segments are swept about it."""
    stain: bool = False
    """The photographed face is stained grey (iodine): take the colour of its unstained part."""
    prompt: str | None = None
    """What the inside looks like, for diffusion."""
    model: str | None = None
    """Path or hub id of a diffusers SD-XL inpainting model."""
    inpaint: tuple[str, ...] = ()
    """Settings of the slice methods, name=value (texture.inpaint in docs/guide/shot-keys.md)."""
    resume: Path | None = None
    """Folder for finished slices, found again after a kill."""
    polish: bool = False
    """Fit interior splats coarser than the voxels to slices of the colours."""
    capture: Path | None = None
    """Photographs that the splat was made from."""

    def execute(self) -> dict[str, Any]:
        """Texture and write."""
        from gsfluent.config.settings_inpaint import read_inpaint
        from gsfluent.run.single import texture_to

        existing(self.solid, "solid.ply", folder=False)
        options = self.given(
            "method",
            "exemplar",
            "preset",
            "material",
            "quality",
            "guide",
            "cut",
            "prompt",
            "model",
            "resume",
        )
        if self.exemplar:
            options.setdefault("method", "exemplar")
        if self.stain:
            options["photo"] = {"stain": True}
        if self.polish:
            options["polish"] = True
        if self.inpaint:
            options["inpaint"] = read_inpaint(self.inpaint)
        with self.progress("texture") as progress:
            return texture_to(
                self.solid,
                _ply(self.out),
                capture=self.capture,
                device=self.torch_device(),
                seed=self.seed,
                progress=progress,
                **options,
            )


@dataclass(kw_only=True)
class Mesh(Verb):
    """Write the closed surface of an object as a triangle mesh.

    Examples:
      gsfluent mesh melon.ply -o melon.glb                       # a splat: its inside is found
      gsfluent mesh melon.ply -o melon.obj --capture captures/melon
      gsfluent mesh solid.ply -o solid.stl                       # a solid made by `gsfluent fill`
      gsfluent mesh captures/melon -o hull.ply --method hull     # masks alone: the visual hull
      gsfluent mesh scan.obj -o closed.obj                       # an open mesh, closed

    The mesh is watertight and wound outward; vertices wear the colours of the splats next to them.
    """

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """Splat or solid .ply, capture folder with masks, or mesh file."""
    out: Out
    """What to write: .obj, .ply, .glb or .stl."""
    capture: Path | None = None
    """Photographs that the splat was made from."""
    method: Literal["auto", "hull", "density", "tsdf", "mesh"] = "auto"
    """Where the solid is taken from."""
    resolution: int = 96
    """Voxels along the longest side."""
    scale: float = 1.0
    """Units of the file per world unit."""

    def execute(self) -> dict[str, Any]:
        """Find the solid and write its surface."""
        from gsfluent.pipeline.solid.mesh import mesh_to

        existing(self.input, "INPUT")
        return mesh_to(
            self.input, self.out, **self.given("capture", "method", "resolution", "scale")
        )


@dataclass(kw_only=True)
class Poses(Verb):
    """Find where photographs were taken from, so that a run can start from them.

    Examples:
      gsfluent poses photos -o captures/apple              # a folder of photographs
      gsfluent poses clip.mp4 -o captures/apple            # frames of a video
      gsfluent poses clip.mp4 -o captures/apple --frames 80

    Needs the extra `poses` (pycolmap). Says how many photographs found their place, and what to do
    about the others. Then: gsfluent run captures/apple -o out
    """

    photographs: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")]
    """Folder of photographs, or a video."""
    out: Out
    """Folder of the capture: images/, sparse/0 and poses.json."""
    frames: int = 120
    """Of a video: how many frames are taken, the sharpest of each stretch."""

    def execute(self) -> dict[str, Any]:
        """Pose and write."""
        from gsfluent.posing import find_poses

        existing(self.photographs, "PHOTOS")
        with self.progress("poses") as progress:
            return find_poses(
                self.photographs, self.out, frames=self.frames, seed=self.seed, progress=progress
            )

    def text(self, result: dict[str, Any]) -> str | None:
        """What a person reads."""
        from gsfluent.posing import poses_text

        lines = [poses_text(result)]
        if result["missing"]:
            lines.append(f"without: {', '.join(result['missing'][:10])}")
        lines += result["advice"]
        return "\n".join([*lines, f"next: gsfluent run {result['output']} -o out"])
