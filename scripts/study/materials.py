"""Write the tables of presets into docs/materials.md, from the code.

python scripts/study/materials.py
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from gsfluent.materials import table

PAGE = Path(__file__).resolve().parents[2] / "docs" / "materials.md"


def filled(text: str) -> str:
    """Return the page with its generated blocks renewed."""
    for block, made in (("numbers", table.numbers()), ("sources", table.sources())):
        pattern = rf"(<!-- {block}: [^\n]*-->\n).*?(<!-- end -->)"
        text, found = re.subn(pattern, lambda m, made=made: m[1] + made + m[2], text, flags=re.S)
        if found != 1:
            raise SystemExit(f"{PAGE.name} has {found} blocks called {block}, expected one")
    return text


def main() -> int:
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
