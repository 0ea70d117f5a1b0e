"""Verbs between other programs and us: export hands on, carry takes motion from them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from gsfluent.cli.common import Out, Verb, existing, parse_size
from gsfluent.errors import InputError


@dataclass(kw_only=True)
class Export(Verb):
    """Write a finished simulation in other programs' formats.

    Examples:
      gsfluent export out --to ply-seq                       # out/frames/frame_0001.ply ...
      gsfluent export out --to ply-seq --compressed --up=-y  # for SuperSplat: drop the folder on it
      gsfluent export out --to spz,glb --frames 40           # one moment, for a web page
      gsfluent export out --to ply-seq --relit --light=1,-1,2   # with light and shadow baked in
      gsfluent export out --to delta                         # one small file: out/splats.gsd
      gsfluent export splats.gsd --to ply-seq                # and back, for any viewer
      gsfluent export out --to usd -o cut_07                 # Houdini, usdview: one scene.usdc
      gsfluent export out --to vtk,vti                       # ParaView: open particles.vtk.series
      gsfluent export out --to meshes --mesh-ending obj      # Blender, Houdini: closed fragments
      gsfluent export out --to pieces-glb                    # Blender, games: out/pieces.glb
      gsfluent export out --to mp4 --camera freeze           # time stands still, once around
      gsfluent export out --to webp --alpha --size 480x270   # to lay over a web page

    Formats (docs/guide/export.md says who reads what, and how large it gets):
      ply-seq  3DGS .ply per frame     spz, splat, glb  the same as smaller or newer files
      ksplat, sog  the same for web viewers (extra formats)
      delta    all frames in one small file, read by gsfluent.io.DeltaReader
      usd      all frames in one file: splats, particles with velocity and damage
      vtk, points, vti                 the material points: .vtk, .ply, density volume
      meshes                           a closed, coloured surface per fragment
      pieces-glb, pieces-usd           closed meshes cut from the solid, moving rigidly, animated
      mp4, gif, webp, png              pictures, along any camera path

    An interrupted sequence goes on where it stopped when the command is given again.
    """

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder that `gsfluent run` wrote, or a .gsd file."""
    to: str
    """Formats, comma-separated."""
    folder: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Where the files go; OUT by default."""
    frames: str | None = None
    """Which frames, as in Python: 12, 10:40, ::2 (0 is the first)."""
    sh: Literal[0, 1, 2, 3] = 0
    """Highest degree of spherical harmonics kept; 3 makes a .ply 3.5 times as large."""
    up: Literal["z", "y", "-y"] = "z"
    """Axis that points up: -y for splat viewers, y for Houdini and Unity (ply-seq, splat, usd)."""
    compressed: bool = False
    """ply-seq: SuperSplat's 16 bytes a splat instead of 68."""
    constant: bool = False
    """The same splats in the same order in every frame; absent ones have opacity 0."""
    attributes: bool = False
    """ply-seq: properties fragment and material."""
    key_every: int = 30
    """delta: frames from one that stands alone to the next; fewer: faster jumps, larger file."""
    spz_version: Literal[2, 3] = 3
    """spz: 2 for old readers, with coarser rotations."""
    usd_ending: Literal["usdc", "usda", "usdz"] = "usdc"
    """usd, pieces-usd: binary, text or zipped."""
    usd_parts: str = "splats,particles"
    """usd: what goes in, of splats, particles, meshes."""
    mesh_ending: Literal["ply", "obj", "glb"] = "ply"
    """meshes: one mesh with a property fragment (ply), or an object per fragment (obj, glb)."""
    mesh_blur: float = 1.0
    """meshes: smoothing in point spacings; less shows the points, more rounds the edges."""
    camera: str | None = None
    """Pictures: orbit, turntable, dolly, freeze[:FRAME], a photograph's index, or a path's file."""
    size: str | None = None
    """Pictures: such as 1280x720."""
    fps: float | None = None
    """Pictures and usd: frames shown per second; the simulation's own by default."""
    alpha: bool = False
    """png, webp: nothing behind the object."""
    relit: bool = False
    """Bake the light into the colours of splats and meshes, for viewers that have none."""
    light: str | None = None
    """Toward the key light, such as 1,-1,2, or a YAML file with a light: section."""
    lamp: Annotated[tuple[str, ...], tyro.conf.arg(metavar="LAMP")] = ()
    """More lamps, such as 'point=0.3,0,0.5;intensity=2'."""
    environment: str | None = None
    """Light from everywhere: an equirectangular picture, sky, or none."""

    def execute(self) -> dict[str, Any]:
        """Export."""
        from gsfluent.export.write import ExportOptions, export

        existing(self.out, "OUT")
        if self.fps is not None and not 0.1 <= self.fps <= 1000.0:
            raise InputError(f"--fps {self.fps:g}", "give a number from 0.1 to 1000")
        same = {f.name for f in fields(ExportOptions)} - {"size", "lamps", "usd_parts"}
        options = ExportOptions(
            size=parse_size(self.size) if self.size else None,
            lamps=self.lamp,
            usd_parts=tuple(part.strip() for part in self.usd_parts.split(",")),
            **{name: getattr(self, name) for name in same},
        )
        with self.progress("export") as progress:
            return export(
                self.out,
                self.to.split(","),
                to=self.folder,
                options=options,
                device=self.torch_device(),
                progress=progress,
            )


@dataclass(kw_only=True)
class Carry(Verb):
    """Let the moving points or meshes of another program carry a splat model.

    Examples:
      gsfluent carry melon.ply --by cloth.npz -o out          # positions [T, N, 3], faces, times
      gsfluent carry melon.ply --by blender.glb --up y -o out # an animated mesh
      gsfluent carry melon.ply --by frames/ --fps 30 -o out   # a .ply, .obj or .npy per frame
      gsfluent carry melon.ply --by cache.usdc -o out         # USD; also .vtk.series and .pvd

    Splats are moved, stretched and turned, their colours too. At frame --rest the carriers must be
    where the splats lie. The folder is like that of `gsfluent run`:
    render, export and view go on from it. docs/guide/carry.md.
    """

    splats: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SPLATS")]
    """Splat model in any format."""
    by: Path
    """What moves: a file, or a folder with a file per frame."""
    out: Out
    """Folder for the results; made when missing."""
    rest: int = 0
    """Frame in which the carriers are where the splats lie (0 is the first)."""
    fps: float | None = None
    """Frames per second of a sequence without times; 24 when absent."""
    up: Literal["z", "y", "-y"] = "z"
    """Axis of the sequence that is +z of the splats."""
    scale: float = 1.0
    """Units of the splats in a unit of the sequence."""
    floor: bool = False
    """Draw a studio with its floor at z = 0."""
    film: bool = True
    """Make video.mp4, which also measures holes."""
    size: str = "640x480"
    """Of the film."""
    camera: str = "orbit"
    """orbit, turntable, dolly or a path (docs/guide/export.md)."""
    force: bool = False
    """Do all anew."""

    def execute(self) -> dict[str, Any]:
        """Carry."""
        from gsfluent.run.carried import carry_to

        existing(self.splats, "SPLATS")
        existing(self.by, "--by")
        with self.reporter() as report:
            return carry_to(
                self.splats, self.by, self.out, device=self.torch_device(), reporter=report,
                size=parse_size(self.size),
                **self.given("rest", "fps", "up", "scale", "floor", "film", "camera", "force"),
            )  # fmt: skip

    def text(self, result: dict[str, Any]) -> str | None:
        """What became of the splats."""
        report = result["simulation"]
        lines = [
            f"{report['splats']} splats, {report['carriers']} carriers, {report['frames']} frames"
        ]
        lines += [f"  ! {note}" for note in report["notes"]]
        return "\n".join([*lines, f"{self.out / 'report.html'}"])
