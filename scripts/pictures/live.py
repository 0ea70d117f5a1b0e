"""A screenshot of poking for the documentation, taken in a headless chromium.

gsfluent demo -o out && python scripts/pictures/live.py out
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import torch
from viewer import Page

from gsfluent.live.player import LivePlayer
from gsfluent.live.scene import open_stage
from gsfluent.live.session import LiveSession
from gsfluent.viewer.app import App
from gsfluent.viewer.model.live_source import LiveSource
from gsfluent.viewer.panels.poke import PokePanel

ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="a finished run, or a filled solid")
    parser.add_argument("--to", type=Path, default=ROOT / "docs" / "images" / "live.jpg")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--slow", type=float, default=10.0)
    parser.add_argument("--after", type=float, default=0.04, help="simulated seconds to wait")
    parser.add_argument("--size", type=int, nargs=2, default=[1360, 800])
    parser.add_argument("--press", default="Shoot", help="which button")
    args = parser.parse_args()
    device = torch.device(args.device)
    stage = open_stage(args.run, device=device)
    session = LiveSession(stage.scene, device=device, slow=args.slow)
    player = LivePlayer(session, stage.shot)
    with tempfile.TemporaryDirectory() as folder:
        panel = PokePanel(player, Path(folder))
        source = LiveSource(player, stage.title, stage.shot)
        app = App(source, device, port=0, panels=[panel])
        player.start()
        panel.start()
        page = Page(app, (args.size[0], args.size[1]), folder)
        try:
            page.click(args.press)
            until = time.monotonic() + 600.0
            while player.status.time < args.after:
                if time.monotonic() > until or player.status.message:
                    sys.exit(f"it did not get there: {player.status}")
                time.sleep(0.05)
            player.pause(True).result(60)
            page.settle()
            save(page.chrome.get_screenshot_as_png(), args.to)
        finally:
            page.chrome.quit()
            panel.close()
            player.close()
            app.close()


def save(png: bytes, to: Path) -> None:
    """Write the screenshot as JPEG."""
    import io

    from PIL import Image

    Image.open(io.BytesIO(png)).convert("RGB").save(to, quality=82, optimize=True)


if __name__ == "__main__":
    main()
