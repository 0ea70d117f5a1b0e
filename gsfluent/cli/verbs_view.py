"""The verb that opens a window: view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from gsfluent.cli.common import Verb, existing


@dataclass(kw_only=True)
class View(Verb):
    """Look at a run in the browser: time, orbit, light, colours that tell, cuts, curves.

    Examples:
      gsfluent view out                        # prints an address; Ctrl-C ends
      gsfluent view out --port 9000 --no-open  # elsewhere, and no browser window is opened
      gsfluent view out --host 0.0.0.0         # for other machines, too
      gsfluent view out --splats               # the browser draws the splats (up to 200 000)
      gsfluent view out --check                # draws one picture, out/view.png, and exits

    OUT may be a run that is still at work: frames appear as they are written.
    """

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder that `gsfluent run` wrote, or is writing."""
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

    def execute(self) -> dict[str, Any]:
        """Serve."""
        from gsfluent.viewer.serve import view_run

        existing(self.out, "OUT", folder=True)
        return view_run(
            self.out,
            device=self.torch_device(),
            host=self.host,
            port=self.port,
            splats=self.splats,
            check=self.check,
            to=self.to,
            browser=self.open,
        )
