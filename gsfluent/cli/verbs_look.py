"""Verbs that look and change nothing: doctor, inspect, plan, metrics."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from gsfluent.cli.common import Out, Verb, existing
from gsfluent.errors import InputError

if TYPE_CHECKING:
    from gsfluent.config import Shot


@dataclass(kw_only=True)
class Doctor(Verb):
    """Say what is installed, which ops are compiled for what, and test each op for a second.

    Examples:
      gsfluent doctor                   # a table; exit 1 when an op gives a wrong answer
      gsfluent doctor --json            # the same for a program
      gsfluent doctor --device cpu      # leave the GPU alone
    """

    def execute(self) -> dict[str, Any]:
        """Examine the machine."""
        from gsfluent.inspection.doctor import examine

        return examine(self.torch_device(), every_device=self.device == "auto")


@dataclass(kw_only=True)
class Inspect(Verb):
    """Say what is in a capture, a splat, a solid or a shot, and draw one PNG.

    Examples:
      gsfluent inspect captures/apple                    # a folder of posed photographs
      gsfluent inspect melon.ply -o melon.png            # a trained splat
      gsfluent inspect melon.ply --size 0.25             # its largest extent is 25 cm
      gsfluent inspect textured.ply -o regions.png       # a solid with regions: which, how large
      gsfluent inspect shot.yaml --run out -o parts.png  # the parts of a shot, before it is run

    A capture or splat: size, up axis, floor, floaters, thin parts. A solid or shot: its parts with
    material, volume, particles, depth and what share of the photographs agrees. For a shot the
    stages up to the parts are done in the folder of the run, where `gsfluent run` goes on from.
    """

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """Capture folder, splat or solid .ply, or shot .yaml."""
    out: Out = Path("inspect.png")
    """Where the picture goes."""
    size: float | None = None
    """Largest extent of the object in metres, if known."""
    run: Path | None = None
    """Result folder of the shot."""

    def execute(self) -> dict[str, Any]:
        """Inspect the input and draw the picture."""
        from gsfluent.inspection.capture import inspect
        from gsfluent.io import kind_of

        existing(self.input, "INPUT")
        suffix = self.input.suffix.lower()
        if suffix in (".yaml", ".yml"):
            return self._shot()
        if self.run is not None:
            raise InputError("--run belongs to a shot", "name the shot's .yaml, or leave it out")
        if kind_of(self.input) == "mesh":
            raise InputError(
                f"{self.input}: a mesh, which is not inspected",
                f"gsfluent plan {self.input} says what a run makes of it",
            )
        if suffix == ".ply" and (shown := _regions(self.input, self.out)) is not None:
            return shown
        return inspect(self.input, out=self.out, size=self.size, device=self.torch_device())

    def _shot(self) -> dict[str, Any]:
        """Show the parts of a shot."""
        from gsfluent.config import load_shot
        from gsfluent.inspection.shot import inspect_shot

        if self.run is None:
            raise InputError(
                f"{self.input}: a shot is inspected in its result folder", "add --run FOLDER"
            )
        if self.size is not None:
            raise InputError("--size does nothing with a shot", "set size in the shot")
        shot = load_shot(self.input)
        with self.reporter() as progress:
            return inspect_shot(
                shot,
                self.run,
                self.out,
                device=self.torch_device(),
                seed=self.seed,
                reporter=progress,
            )


def _regions(path: Path, out: Path) -> dict[str, Any] | None:
    """The regions of a solid; None for a splat, or a solid without any."""
    from gsfluent.inspection.shot import inspect_solid
    from gsfluent.io.solid import load_solid, volume_path

    if not volume_path(path).is_file() or load_solid(path).regions is None:
        return None
    return inspect_solid(path, out)


@dataclass(kw_only=True)
class Plan(Verb):
    """Say what a shot will cost without simulating: passes, grid, steps, particles, memory, time.

    Examples:
      gsfluent plan shot.yaml               # before an hour is spent
      gsfluent plan vase.glb                # of what gsfluent run would make of it
      gsfluent plan shot.yaml --json
      gsfluent plan shot.yaml --recalibrate # measure this machine anew (ten seconds)
      gsfluent plan shot.yaml --no-probe    # do not measure; no times where nothing was measured

    The first plan on a machine measures for about ten seconds what work costs there and keeps it
    in the user's cache; every run then corrects it. See docs/theory/plan.md.
    """

    shot: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """The shot file; or a mesh, a splat or a folder, as for `gsfluent run`."""
    material: str | None = None
    """Without a shot: what the object is made of, a preset; guessed and said when absent."""
    recalibrate: bool = False
    """Measure this machine anew, and forget what runs have taught."""
    probe: bool = True
    """Measure this machine where it has not been measured yet."""

    def execute(self) -> dict[str, Any]:
        """Plan the shot."""
        from gsfluent.plan.cost import CostModel
        from gsfluent.plan.plan import cost_model, plan_shot

        if self.recalibrate and not self.probe:
            raise InputError("--recalibrate measures, --no-probe forbids it", "drop one of them")
        shot = self._read()
        device = self.torch_device()
        # what is wrong with the shot is said before anything is measured
        plan = plan_shot(shot, device=device, seed=self.seed, model=CostModel.load(device))
        if self.recalibrate or (self.probe and not plan["calibrated"]):
            with self.progress("measure") as progress:
                model = cost_model(device, recalibrate=self.recalibrate, progress=progress)
            plan = plan_shot(shot, device=device, seed=self.seed, model=model)
        return plan

    def _read(self) -> Shot:
        """The shot, or that which a run would make; only a run keeps it."""
        from gsfluent.config import load_shot

        path = existing(self.shot, "INPUT")
        if path.suffix.lower() in (".yaml", ".yml"):
            if self.material is not None:
                raise InputError(
                    "--material does nothing with a shot", "write it there: objects: NAME: material"
                )
            return load_shot(path)
        from gsfluent.run.from_input import made_shot

        with tempfile.TemporaryDirectory(prefix="gsfluent-plan-") as folder:
            return load_shot(made_shot(path, Path(folder), self.material))

    def text(self, result: dict[str, Any]) -> str:
        """The plan as tables."""
        from gsfluent.cli.plan_table import plan_text

        return plan_text(result)


@dataclass(kw_only=True)
class Metrics(Verb):
    """Say how like a reference the inside of a solid, a picture or a folder of pictures is.

    Examples:
      gsfluent metrics melon.ply cut.jpg                # a textured solid against a photograph
      gsfluent metrics renders/ photographs/ --json     # two folders of pictures
      gsfluent metrics melon.ply cut.jpg --clip clip-vit-large-patch14 --prompt "a cut watermelon"

    Always: distances of patches and colours, sharpness; 0 (sharpness 1) is likeness. CLIP score,
    LPIPS, FID and KID need weights that you give: nothing is downloaded, and what is not given is
    skipped with one line.
    """

    judged: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="A")]
    """What is judged: picture, folder of pictures, or the .ply of a textured solid."""
    reference: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="B")]
    """What it should be like, the same kinds."""
    size: int = 256
    """Longest side in pixels to which the objects are reduced before they are compared."""
    clip: Path | None = None
    """Folder of a CLIP model (or the hub id of one in the local cache)."""
    prompt: str | None = None
    """Text of the CLIP score."""
    lpips: Path | None = None
    """Folder with alexnet-owt-*.pth of torchvision and alex.pth of the lpips package."""
    fid: Path | None = None
    """TorchScript Inception network, inception-2015-12-05.pt, for FID and KID."""

    def execute(self) -> dict[str, Any]:
        """Compare the two sides."""
        from gsfluent.inspection.compare import compare

        existing(self.judged, "A")
        existing(self.reference, "B")
        result = compare(
            self.judged,
            self.reference,
            device=self.torch_device(),
            **self.given("size", "clip", "prompt", "lpips", "fid", "seed"),
        )
        if self.json:
            return result
        # for a person the reason stands where the number would
        skipped = result.pop("skipped")
        why = {name: f"skipped ({reason})" for name, reason in skipped.items()}
        shown = {name: why.get(name, value) for name, value in result.items()}
        if "clip_score" in skipped:
            del shown["clip_score_reference"]
        return shown
