"""Write the tables of presets into docs/measured/materials.md, from the code.

python scripts/study/materials.py
"""

from __future__ import annotations

import sys
from pathlib import Path

from gsfluent.figure.markdown import enter
from gsfluent.materials import table

PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "materials.md"


def filled(text: str) -> str:
    """Return the page with its tables renewed."""
    for name, made in (("numbers", table.numbers()), ("sources", table.sources())):
        text = enter(text, name, made.rstrip(), f"## {name.capitalize()}")
    return text


def main() -> int:
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
