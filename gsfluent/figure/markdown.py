"""Tables that scripts enter into pages of docs/, between markers."""

from __future__ import annotations

import re


def enter(text: str, name: str, part: str, heading: str = "", key: int = 0) -> str:
    """Replace the part of a page between ``<!-- name: begin -->`` and its end, or append it.

    Args:
        text: The page.
        name: Of the markers.
        part: What stands between them from now on.
        heading: Line above the markers when they are new.
        key: Cells at the head of a row that say what it is of, of a part that is a table. Rows that
            the page has and the part does not stay; 0: none does.
    """
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    found = re.compile(re.escape(begin) + "\n(.*?)\n" + re.escape(end), re.DOTALL)
    there = found.search(text)
    if there and key:
        part = merged(there[1], part, key)
    whole = f"{begin}\n{part}\n{end}"
    if there:
        return found.sub(lambda _: whole, text, count=1)
    return "\n\n".join(s for s in (text.rstrip(), heading, whole) if s) + "\n"


def merged(old: str, new: str, key: int) -> str:
    """Rows of two tables under the head of the new one; of rows with one key the new one.

    Args:
        old: The one table.
        new: The other. A row that the old one has not follows the one before it.
        key: Cells at the head of a row that say what it is of.
    """

    def rows(table: str) -> dict[tuple[str, ...], str]:
        return {tuple(line.split(" | ")[:key]): line for line in table.splitlines()[2:]}

    fresh, kept = rows(new), rows(old)
    order = list(kept)
    at = len(order)
    for row in fresh:
        if row in kept:
            at = order.index(row)
        else:
            order.insert(at, row)
        at += 1
    return "\n".join([*new.splitlines()[:2], *((kept | fresh)[row] for row in order)])
