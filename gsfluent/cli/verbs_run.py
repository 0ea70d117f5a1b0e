"""Verbs around a whole shot: run, demo, render, export."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from gsfluent.cli.common import Out, Verb, existing, parse_size
from gsfluent.errors import InputError


@dataclass(kw_only=True)
class Run(Verb):
    """Do all a shot asks for, in order: reconstruct, fill, texture, simulate, render, export.

    Examples:
      gsfluent run shot.yaml -o out            # leaves out/video.mp4, out/run.json and more
      gsfluent run shot.yaml -o out            # again: only what changed or was cut short
      gsfluent run shot.yaml -o out --force    # redo everything
      gsfluent run shot.yaml -o out --json     # run.json on stdout
      gsfluent run vase.glb -o out             # a mesh, dropped; also a splat.ply or a capture
      gsfluent run vase.glb -o out --material glass
      gsfluent run PHOTOS -o out               # photographs or a video without poses (extra poses)
      gsfluent run MODEL --config c.json -o out     # a PhysGaussian model folder and its config

    Without a shot one is made, which breaks the object on the floor, and is written to
    out/shot.yaml to be edited.

    The smallest useful shot.yaml:
      capture: captures/apple
      events:
        - {type: drop, height: 1.0}
    """

    shot: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """The shot file; or a mesh, a splat, a video or a folder; with --config a model of INRIA's."""
    out: Out
    """Folder for the results; made when missing."""
    material: str | None = None
    """Without a shot: what the object is made of, a preset; guessed and said when absent."""
    config: Path | None = None
    """PhysGaussian's JSON config of the model; see docs/guide/physgaussian.md."""
    write_shot: bool = False
    """With --config: only write OUT/physgaussian/shot.yaml and say what became of every key."""
    force: bool = False
    """Redo every stage."""
    unlock: bool = False
    """Go on in a folder that a run on another machine has locked and left."""
    untrusted: bool = False
    """Refuse a shot that starts a program or loads a model: for shots of strangers."""

    def execute(self) -> dict[str, Any]:
        """Run the shot."""
        from gsfluent.config import load_shot, refuse_programs
        from gsfluent.run.shot import run_shot

        if self.out.exists() and not self.out.is_dir():
            raise InputError(f"-o: {self.out} is a file", "give a folder; it is made when missing")
        if self.config is None:
            if self.write_shot:
                raise InputError("--write-shot does nothing without --config", "drop it")
            path, facts = existing(self.shot, "INPUT"), None
            if path.suffix.lower() not in (".yaml", ".yml"):
                from gsfluent.run.from_input import made_shot

                path = made_shot(path, self.out, self.material, self._posed)
            elif self.material is not None:
                raise InputError(
                    "--material does nothing with a shot", "write it there: objects: NAME: material"
                )
        else:
            from gsfluent.config.physgaussian.read import convert
            from gsfluent.results.lock import locked

            folder = self.out / "physgaussian"
            model = existing(self.shot, "MODEL", folder=True)
            with locked(self.out, unlock=self.unlock):
                made = convert(model, self.config, folder)
            path, facts = folder / "shot.yaml", {"physgaussian": made.report()}
            if self.write_shot:
                return {"shot": str(path), **facts["physgaussian"]}
        shot = load_shot(path)
        if self.untrusted:
            refuse_programs(shot, path)
        device = self.torch_device()
        with self.reporter() as report:
            return run_shot(
                shot, self.out, device=device, seed=self.seed, force=self.force, reporter=report,
                facts=facts, unlock=self.unlock,
            )  # fmt: skip

    def _posed(self, photographs: Path) -> Path:
        """The capture of photographs without poses."""
        from gsfluent.results.lock import locked
        from gsfluent.run.photographs import posed

        with locked(self.out, unlock=self.unlock), self.progress("poses") as progress:
            return posed(photographs, self.out, self.seed, progress)

    def text(self, result: dict[str, Any]) -> str | None:
        """How it ended; of a shot that was only written, all of it."""
        from gsfluent.cli.run_table import run_text

        return run_text(result, self.out) if "verdict" in result else None


@dataclass(kw_only=True)
class Demo(Verb):
    """Run the built-in scene: a melon is photographed, rebuilt, filled, dropped and broken.

    Examples:
      gsfluent demo                            # into demo_out/, a few minutes on two cores
      gsfluent demo watermelon -o out          # the same by name
      gsfluent demo --size preview             # small and quick, for a check
      gsfluent demo cake --photographs examples/data/cake   # only its photographs and a cut

    Nothing is downloaded: gsfluent draws the photographs itself from an object whose inside it
    knows, so run.json can say how far the reconstructed inside is from the truth.
    """

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")] = "watermelon"
    """Which scene."""
    out: Out = Path("demo_out")
    """Folder for the results."""
    size: Literal["full", "preview"] = "full"
    """full, or a small quick one."""
    photographs: Path | None = None
    """Only photograph the object into this folder: photographs/, cut.png, truth.npz."""
    force: bool = False
    """Redo every stage."""
    unlock: bool = False
    """Go on in a folder that a run on another machine has locked and left."""

    def execute(self) -> dict[str, Any]:
        """Run the demo."""
        from gsfluent.run.demo import SIZES, photograph_demo, run_demo

        if self.photographs is not None:
            scale, seed, device = SIZES[self.size], self.seed, self.torch_device()
            with self.progress("photograph") as progress:
                return photograph_demo(self.name, self.photographs, scale, seed, progress, device)

        device = self.torch_device()
        with self.reporter() as report:
            return run_demo(
                self.name,
                self.out,
                device=device,
                reporter=report,
                **self.given("size", "seed", "force", "unlock"),
            )

    def text(self, result: dict[str, Any]) -> str | None:
        """How it ended; of photographs alone, where they are."""
        from gsfluent.cli.run_table import run_text

        return run_text(result, self.out) if "verdict" in result else None


@dataclass(kw_only=True)
class Render(Verb):
    """Render a finished simulation again: another camera, light or size.

    Examples:
      gsfluent render out                                   # as the shot says: out/render.mp4
      gsfluent render out --size 1920x1080 -o big.mp4
      gsfluent render out --camera 3                        # from the pose of photograph 3
      gsfluent render out --camera path.json                # eyes and targets
      gsfluent render out --light=-1,-1,3 --ambient 0.3     # harder light from the left
      gsfluent render out --light studio.yaml               # a light: section
      gsfluent render out --lamp 'point=0.3,-0.3,0.5;intensity=0.4;color=1,0.8,0.6'
      gsfluent render out --environment sky --spin 90       # the key light goes round
      gsfluent render out --frame 20 -o still.png           # one picture
    """

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder that `gsfluent run` wrote."""
    to: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Where the video (.mp4) or picture (.png) goes."""
    camera: str | None = None
    """orbit, turntable, dolly, the index of a photograph, or a path (docs/guide/export.md)."""
    size: str | None = None
    """Such as 1280x720."""
    light: str | None = None
    """Direction toward the key light, such as 1,-1,2, or a YAML file with a light: section."""
    lamp: Annotated[tuple[str, ...], tyro.conf.arg(metavar="LAMP")] = ()
    """More lamps, such as 'point=0.3,0,0.5;intensity=2' or 'sun=-1,1,1;size=10'."""
    intensity: float | None = None
    """Strength of the key light."""
    lamp_size: float | None = None
    """Width of the key light [degrees]: how soft its shadows are."""
    spin: float | None = None
    """Turn of the key light about the vertical [degrees per second]."""
    environment: str | None = None
    """Light from everywhere by direction: an equirectangular picture, sky, or none."""
    ambient: float | None = None
    """Ambient light."""
    specular: float | None = None
    """Strength of highlights on everything."""
    shininess: float | None = None
    """Narrowness of highlights on everything."""
    occlusion: float | None = None
    """How much of the light from everywhere matter hides, 0 to 1."""
    delight: float | None = None
    """Share of the captured shading that is divided out, 0 to 1."""
    frame: int | None = None
    """Render this frame only (0 is the first)."""

    def execute(self) -> dict[str, Any]:
        """Render."""
        from gsfluent.stages.show import render_again

        existing(self.out, "OUT", folder=True)
        with self.progress("render") as progress:
            return render_again(
                self.out,
                size=parse_size(self.size) if self.size else None,
                lamps=self.lamp,
                surroundings=self.environment,
                device=self.torch_device(),
                progress=progress,
                **self.given("to", "camera", "frame", "light", "intensity", "lamp_size", "spin"),
                **self.given("ambient", "specular", "shininess", "occlusion", "delight"),
            )


@dataclass(kw_only=True)
class Report(Verb):
    """Make report.html of a finished run anew: verdict, plan against fact, curves, timings.

    Examples:
      gsfluent report out               # out/report.html, which `gsfluent run` writes as well
      gsfluent report out --json        # where it lies, for a program

    One file without scripts that shows the video beside it; nothing is computed again.
    """

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder that `gsfluent run` wrote."""

    def execute(self) -> dict[str, Any]:
        """Write the page."""
        from gsfluent.run.report import read_run, write_report

        existing(self.out, "OUT", folder=True)
        values = read_run(self.out)
        return {"report": str(write_report(self.out, values)), "verdict": values["verdict"]}
