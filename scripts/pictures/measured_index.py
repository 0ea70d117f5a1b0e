"""The index of docs/measured, made from its pages: title, and what writes each.

python scripts/pictures/measured_index.py
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from gsfluent.figure.markdown import enter

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "measured"
COMMANDS = re.compile(r"^(?:python (scripts/[\w/]+\.py)|(gsfluent \w+))", re.MULTILINE)


def row(page: Path) -> str:
    """A page's line of the index."""
    text = page.read_text(encoding="utf-8")
    title = text.splitlines()[0].removeprefix("# ")
    blocks = "\n".join(re.findall(r"```bash\n(.*?)```", text, re.DOTALL))
    writers = dict.fromkeys(a or b for a, b in COMMANDS.findall(blocks))
    return f"| [{title}]({page.name}) | {', '.join(f'`{name}`' for name in writers)} |"


def index(folder: Path) -> str:
    """The table of all pages."""
    pages = sorted(page for page in folder.glob("*.md") if page.name != "README.md")
    return "\n".join(["| page | written by |", "| --- | --- |", *map(row, pages)])


def main() -> int:
    page = FOLDER / "README.md"
    page.write_text(
        enter(page.read_text(encoding="utf-8"), "index", index(FOLDER)), encoding="utf-8"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
