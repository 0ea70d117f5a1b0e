"""Enter recorded lines into docs/measured/chart_quality.md and draw its pictures.

    python scripts/pictures/chart_quality.py docs/measured/data/chart_rendering_cpu.jsonl ...

Each file holds lines of `gsfluent chart --of rendering|reconstruction|texturing`, of any device.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from gsfluent.figure.markdown import enter
from gsfluent.lab.charts.quality import KINDS, gathered, markdown
from gsfluent.lab.charts.record import read

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "measured" / "chart_quality.md"
IMAGES = ROOT / "docs" / "images"


def main(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        sys.stdout.write(__doc__ or "")
        return 0
    files = [Path(argument) for argument in arguments]
    records = [record for path in files for record in read(path)]
    text = PAGE.read_text(encoding="utf-8")
    for kind in KINDS:
        mine = {r.key: r for r in records if r.kind == kind}
        if not mine:
            continue
        parts = []
        with tempfile.TemporaryDirectory() as scratch:
            drawn = gathered(kind, files, Path(scratch))
            for device, result in drawn.items():
                picture = f"chart_{kind}_{device}.png"
                (IMAGES / picture).write_bytes(Path(result["figure"]).read_bytes())
                rows = [r for r in mine.values() if r.device.split(":")[0] == device]
                parts.append(
                    f"![{kind} on {rows[0].machine}](../images/{picture})\n\n"
                    f"**{rows[0].machine}**\n\n{markdown(rows)}"
                )
        text = enter(text, f"chart {kind}", "\n".join(parts))
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
