"""Verbs of many runs: sweep, dataset, fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from gsfluent.cli.common import On, Out, Verb, existing
from gsfluent.errors import InputError


@dataclass(kw_only=True)
class Sweep(Verb):
    """Run many shots that differ in a few keys: every one once, stopped and resumed at will.

    Examples:
      gsfluent sweep sweep.yaml -o drops               # what the file says; again: goes on
      gsfluent sweep sweep.yaml -o drops --plan        # how many shots, how long
      gsfluent sweep shot.yaml -o drops --vary events.drop.height=0.5,1,2 --seeds 10
      gsfluent sweep shot.yaml -o drops --vary solve.cells=40,60 gravity.2=-9.81,-1.62
      gsfluent sweep sweep.yaml -o drops --retry       # what has failed, once more

    Solids are made once and shared. A shot that fails stops no other. Several machines may work in
    the same folder. Leaves table.csv, sheet.html, failures.jsonl and shots/ID, each a folder as
    `gsfluent run` makes it; --seed is that of the solids. docs/guide/sweep.md has the file's keys.
    """

    sweep: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SWEEP.yaml")]
    """The sweep file; or a shot file, with --vary or --seeds."""
    out: Out
    """Folder for the results, made when missing; or s3://BUCKET/PLACE (extra `s3`)."""
    vary: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=A,B,C")] = ()
    """Of a shot: keys by their path and the values they take; all combinations are run."""
    seeds: int | None = None
    """Of a shot: how many seeds, from 0 on."""
    jobs: int | None = None
    """Shots at a time; as many as there are cores for when absent."""
    on: On = "local"
    """Where shots run: processes of this machine, jobs of a SLURM cluster (extra `slurm`), or a Ray
    cluster that runs already (extra `ray`)."""
    pack: int | None = None
    """Shots that share a GPU; by the memory that one takes when absent."""
    keep: Literal["all", "film"] | None = None
    """What stays of a shot: all, or film and figures without the frames."""
    minutes: float | None = None
    """Longest time of a shot."""
    retry: bool = False
    """Try again what has failed."""
    plan: bool = False
    """Only say how many shots, how long, how much memory."""

    def execute(self) -> dict[str, Any]:
        """Run what is left of the sweep."""
        from gsfluent.sweep.shots import plan_sweep, run_sweep
        from gsfluent.sweep.tasks import read_sweep

        if self.seeds is not None and self.seeds < 1:
            raise InputError(f"--seeds {self.seeds}", "give at least 1")
        path = existing(self.sweep, "SWEEP.yaml", folder=False)
        sweep = read_sweep(path, _axes(self.vary), self.seeds)
        if self.keep is not None:
            sweep = replace(sweep, keep=self.keep)
        if self.minutes is not None:
            sweep = replace(sweep, each=replace(sweep.each, minutes=self.minutes))
        if self.pack is not None:
            if self.pack < 1:
                raise InputError(f"--pack {self.pack}", "give at least 1")
            sweep = replace(sweep, each=replace(sweep.each, gpu=1.0 / self.pack))
        device = self.torch_device()
        if self.plan:
            return plan_sweep(sweep, self.out, device=device, seed=self.seed, jobs=self.jobs)
        with self.reporter() as report:
            return run_sweep(
                sweep, self.out, device=device, seed=self.seed, jobs=self.jobs, retry=self.retry,
                on=self.on, reporter=report,
            )  # fmt: skip


@dataclass(kw_only=True)
class Dataset(Verb):
    """Turn a sweep into training data: films, depth, flow, labels, events and figures.

    Examples:
      gsfluent dataset drops -o data                              # WebDataset, tars of 1 GB
      gsfluent dataset drops -o data --format webdataset huggingface
      gsfluent dataset drops -o data --shares 0.6 0.2 0.2         # of the objects

    No object is in two splits. The same command goes on where it was stopped, and adds shots that
    have come since. docs/guide/sweep.md reads the result with PyTorch alone.
    """

    sweep: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SWEEP")]
    """Folder that `gsfluent sweep` wrote; from s3://BUCKET/PLACE shots are brought to OUT/sweep."""
    out: Out
    """Folder of the data set; made when missing."""
    format: tuple[Literal["webdataset", "huggingface"], ...] = ("webdataset",)
    """What is written, each into a folder of its name."""
    shares: tuple[float, float, float] = (0.8, 0.1, 0.1)
    """Shares of the objects that train, validation and test get."""
    jobs: int | None = None
    """Samples at a time; as many as there are cores when absent."""

    def execute(self) -> dict[str, Any]:
        """Make the samples and pack them."""
        from gsfluent.dataset.write import write_dataset
        from gsfluent.sweep.bucket import fetch, is_store

        sweep = self.sweep
        if is_store(sweep):
            with self.progress("brought here") as progress:
                sweep = fetch(sweep, self.out / "sweep", progress=progress).root
        existing(sweep, "SWEEP", folder=True)
        with self.progress("samples") as progress:
            return write_dataset(
                sweep, self.out, self.format, device=self.torch_device(), shares=self.shares,
                jobs=self.jobs, progress=progress,
            )  # fmt: skip


@dataclass(kw_only=True)
class Fit(Verb):
    """Learn from motion what a thing is made of: stiffness, yield stress, viscosity, velocity.

    Examples:
      gsfluent fit shot.yaml --points track.npz --learn melon.young_modulus melon.velocity -o out
      gsfluent fit shot.yaml --clouds frames/ --learn melon.young_modulus melon.poisson_ratio -o out
      gsfluent fit shot.yaml --force press.csv --learn block.young_modulus -o out
      gsfluent fit shot.yaml --masks films/ --cameras capture/ --learn melon.young_modulus -o out
      gsfluent fit shot.yaml --points track.npz --laws elastic,von_mises,fluid -o out
      gsfluent fit shot.yaml --pieces pieces.csv --learn cup.tensile_strength --cells 32 -o out
      gsfluent fit shot.yaml --guidance sds --model video/ --prompt jelly --learn a.viscosity -o out

    The shot says where the search starts, and what is believed: geometry, density, gravity, floor.
    What the motion does not show is called unidentified and given as a bound. A fit that was
    stopped goes on. Leaves fit.json, fitted.yaml and fit.html. docs/guide/fit.md.
    """

    shot: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SHOT.yaml")]
    """The shot file."""
    out: Out
    """Folder for the results; made when missing."""
    learn: tuple[str, ...] = ()
    """What: OBJECT.NUMBER or OBJECT/PART.NUMBER; velocity and angular_velocity are three."""
    laws: str | None = None
    """Laws to try for every object and part, with their numbers: elastic,von_mises,fluid."""
    points: Path | None = None
    """Tracked points [T, K, 3] in the scene's metres: a file or folder as of `gsfluent carry`."""
    clouds: Path | None = None
    """Clouds or splats without names: a folder with a file per frame."""
    force: Path | None = None
    """A table with columns displacement [m] and force [N] of the one collider that moves."""
    masks: Path | None = None
    """Films of masks: a folder for each camera, named as its image, with a picture per frame."""
    cameras: Path | None = None
    """Of --masks: COLMAP model or transforms.json in the frame of the splats; they stand still."""
    colors: bool = False
    """Of --masks: pictures are opaque where the object is, and its colours count at the end."""
    pieces: Path | None = None
    """The pieces of what broke: a table with a column mass [kg], and perhaps x, y, z [m]."""
    dust: float | None = None
    """Of --pieces: the share of the mass that belongs to none."""
    seeds: int = 8
    """Of --pieces: simulations of each candidate, whose mean is compared."""
    guidance: Literal["sds"] | None = None
    """Instead of what was seen: a text and a video model's score distillation. No measurement."""
    model: Path | None = None
    """Of --guidance: folder of a text-to-video pipeline of diffusers."""
    prompt: str | None = None
    """Of --guidance: what the film shows."""
    rounds: int | None = None
    """Of --guidance: steps, 60; each takes a run for every number, and one. Of --pieces: 12."""
    sigma: float | None = None
    """Standard deviation of what was seen [m, N; of a pixel none]."""
    fps: float | None = None
    """Frames per second of files without times; 24 when absent."""
    starts: int = 4
    """Starts of the search."""
    cells: int = 8
    """Cells along the longest side of the largest object; give thin things more. Of --pieces they
    are those of the shots that follow."""
    grids: Literal[1, 2] = 2
    """2: a grid twice as fine sets the motion of the coarser one right."""
    jobs: int | None = None
    """Searches at a time; as many as there are cores when absent."""
    on: On = "local"
    """Where searches run, as of `gsfluent sweep`."""

    def execute(self) -> dict[str, Any]:
        """Learn."""
        from gsfluent.config import load_shot
        from gsfluent.fit.job import fit_to

        for name in ("points", "clouds", "force", "masks", "cameras"):
            if getattr(self, name) is not None:
                existing(getattr(self, name), f"--{name}")
        shot = load_shot(existing(self.shot, "SHOT.yaml", folder=False))
        if self.guidance is None and (self.model is not None or self.prompt is not None):
            raise InputError("fit: --model and --prompt belong to --guidance sds", "add it")
        with self.reporter() as report:
            if self.guidance is not None:
                from gsfluent.fit.guided import guide_to

                return guide_to(
                    shot, self.out, self.learn, device=self.torch_device(), reporter=report,
                    model=self.model, prompt=self.prompt,
                    **self.given("rounds", "cells", "seed"),
                )  # fmt: skip
            if self.pieces is not None:
                from gsfluent.fit.broken import pieces_to

                return pieces_to(
                    shot, self.out, self.learn, existing(self.pieces, "--pieces", folder=False),
                    device=self.torch_device(), reporter=report,
                    **self.given("dust", "seeds", "rounds", "cells", "jobs", "on", "seed"),
                )  # fmt: skip
            return fit_to(
                shot, self.out, self.learn, device=self.torch_device(), reporter=report,
                laws=[law.strip() for law in (self.laws or "").split(",") if law.strip()],
                **self.given("points", "clouds", "force", "masks", "cameras", "colors", "sigma"),
                **self.given("fps", "starts", "cells", "grids", "jobs", "on", "seed"),
            )  # fmt: skip

    def text(self, result: dict[str, Any]) -> str | None:
        """Every number with its band, or why there is none."""
        lines = []
        for place, facts in result.get("laws", {}).items():
            also = f", and as well by {', '.join(facts['alike'])}" if facts["alike"] else ""
            error = facts["tried"][facts["taken"]]["held_out"]
            lines.append(f"{place}: {facts['taken']} (foretells to {error:.2g} sd{also})")
        for key, number in result["parameters"].items():
            bound = result["unidentified"].get(key)
            how = f"sd {number['sd']}" if "sd" in number else f"began at {number['start']}"
            said = f"unidentified: {bound}" if bound else f"{number['value']} ({how})"
            lines.append(f"{key}: {said}")
        lines += [f"  ! {warning}" for warning in result["warnings"]]
        return "\n".join([*lines, f"{self.out / result['outputs']['shot']}"])


def _axes(words: tuple[str, ...]) -> dict[str, list[Any]]:
    """Values by key of ``KEY=A,B,C``; each is read as in a shot file.

    Raises:
        InputError: Not of that form, or a key twice.
    """
    import yaml

    axes: dict[str, list[Any]] = {}
    for word in words:
        name, equals, values = word.partition("=")
        try:
            items = yaml.safe_load(f"[{values}]")
        except yaml.YAMLError:
            items = None
        if not equals or not name or not items or name in axes:
            raise InputError(f"--vary {word}", "give KEY=A,B,C, each key once")
        axes[name] = items
    return axes
