"""The verbs that open a page: view, studio."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from gsfluent.cli.common import Verb, existing
from gsfluent.errors import InputError


@dataclass(kw_only=True)
class View(Verb):
    """Look at a run in the browser: time, orbit, light, colours that tell, cuts, curves.

    Examples:
      gsfluent view out                        # prints an address; Ctrl-C ends
      gsfluent view out --port 9000 --no-open  # elsewhere, and no browser window is opened
      gsfluent view out --host 0.0.0.0         # for other machines, too
      gsfluent view out --splats               # the browser draws the splats (up to 200 000)
      gsfluent view out --check                # draws one picture, out/view.png, and exits
      gsfluent view out --live                 # throw, shoot and cut its objects
      gsfluent view melon.ply --live --material fruit.watermelon   # a filled solid
      gsfluent view shot.yaml --live --run out # a shot, whose objects are prepared in out

    OUT may be a run that is still at work: frames appear as they are written.
    """

    serves: ClassVar[bool] = True

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder that `gsfluent run` wrote, or is writing; with --live also a shot or a solid."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other machines in."""
    port: int = 8080
    """Port; the next free one is taken when it is in use."""
    splats: bool = False
    """Let the browser draw the splats: smooth turning, but no light."""
    check: bool = False
    """Draw one picture and exit."""
    to: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Where the picture of --check goes; OUT/view.png by default."""
    open: bool = True
    """Open the page in the browser."""
    live: bool = False
    """Simulate now, and poke."""
    material: str | None = None
    """With --live, of a solid: its material."""
    run: Path | None = None
    """With --live, of a shot: the folder in which its objects are prepared."""
    quality: Literal["live", "preview", "shot", "hero"] = "live"
    """With --live: cells; live is what the device can do while one looks."""
    slow: float | None = None
    """With --live: slow motion at first; by default as much as this machine needs."""
    cracks: Literal["mvee", "gap", "none"] = "mvee"
    """With --live: splats along cracks; gap has finer faces and is slower."""

    def execute(self) -> dict[str, Any]:
        """Serve."""
        from gsfluent.viewer.serve import view_run

        if self.live:
            return self._live()
        for name in ("material", "run"):
            if getattr(self, name) is not None:
                raise InputError(f"--{name} belongs to --live", "add --live, or leave it out")
        existing(self.out, "OUT", folder=True)
        return view_run(
            self.out,
            device=self.torch_device(),
            browser=self.open,
            **self.given("host", "port", "splats", "check", "to"),
        )

    def _live(self) -> dict[str, Any]:
        """Serve a session one can poke."""
        from gsfluent.viewer.serve_live import view_live

        for name, given in (("check", self.check), ("splats", self.splats), ("to", self.to)):
            if given:
                raise InputError(f"--{name} does nothing with --live", "leave one of them out")
        return view_live(
            existing(self.out, "OUT"),
            device=self.torch_device(),
            browser=self.open,
            **self.given("material", "run", "quality", "slow", "cracks", "seed", "host", "port"),
        )


@dataclass(kw_only=True)
class Studio(Verb):
    """From a file to a film on a page in the browser: choose, plan, run, watch, export.

    Examples:
      gsfluent studio                         # of this folder; prints an address, Ctrl-C ends
      gsfluent studio objects --port 9000     # of another folder
      gsfluent studio --no-open               # no browser window is opened

    The page lists the meshes, splats and captures of FOLDER and takes uploads into it. Results of
    melon.ply go to melon_out, as those of `gsfluent run`. It answers this machine only.
    """

    serves: ClassVar[bool] = True
    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")] = Path(".")
    """Where objects lie and results go."""
    port: int = 8080
    """Port; the next free one is taken when it is in use."""
    open: bool = True
    """Open the page in the browser."""

    def execute(self) -> dict[str, Any]:
        """Serve."""
        from gsfluent.studio.serve import serve_studio

        return serve_studio(
            existing(self.folder, "FOLDER", folder=True),
            device=self.torch_device(),
            browser=self.open,
            **self.given("seed", "port"),
        )
