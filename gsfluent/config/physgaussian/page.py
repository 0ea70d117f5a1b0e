"""The tables of docs/guide/physgaussian.md, made from the keys that the program knows."""

from __future__ import annotations

from gsfluent.config.physgaussian.keys import BOUNDARIES, FILLING, INERT, KEYS, UNSUPPORTED

_HEAD = "| key | here | what it becomes, or why it becomes nothing |\n| --- | --- | --- |"


def keys() -> str:
    """Markdown: every top-level key."""
    rows = [f"| `{key}` | {_shown(status)} | {text} |" for key, (status, text) in KEYS.items()]
    return "\n".join([_HEAD, *rows]) + "\n"


def boundaries() -> str:
    """Markdown: every type of boundary condition, with its keys."""
    head = "| type | keys | here | what it becomes |\n| --- | --- | --- | --- |"
    rows = [
        f"| `{kind}` | {', '.join((*needed, *more)) or '-'} | {_shown(status)} | {text} |"
        for kind, (status, text, needed, more) in BOUNDARIES.items()
    ]
    return "\n".join([head, *rows]) + "\n"


def filling() -> str:
    """Markdown: the keys of particle_filling."""
    return ", ".join(f"`{key}`" for key in FILLING) + "\n"


def _shown(status: str) -> str:
    return f"**{status}**" if status in (UNSUPPORTED, INERT) else status
