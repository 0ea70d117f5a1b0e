"""Tables that scripts enter into pages of docs/, between markers."""

from __future__ import annotations

import re


def enter(text: str, name: str, part: str, heading: str = "") -> str:
    """Replace the part of a page between ``<!-- name: begin -->`` and its end, or append it.

    Args:
        text: The page.
        name: Of the markers.
        part: What stands between them from now on.
        heading: Line above the markers when they are new.
    """
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    whole = f"{begin}\n{part}\n{end}"
    found = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
    if found.search(text):
        return found.sub(lambda _: whole, text, count=1)
    return "\n\n".join(s for s in (text.rstrip(), heading, whole) if s) + "\n"
