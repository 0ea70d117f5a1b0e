"""How long commands say nothing: the longest silence of each, and what was said before it.

    python scripts/stages/silence.py --data "$GSFLUENT_DATA" -o out/silence [--write]
    python scripts/stages/silence.py -- gsfluent run melon.ply -o out/melon

Every command runs in a process of its own, once into a pipe, where progress is lines, and once on a
pseudo-terminal of 100 columns, where it is bars. Whatever comes on stderr or stdout counts as said.
The time until the first word, while Python loads, and after the last one count as silences.
``--write`` keeps the rows of commands that were not run.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time
from dataclasses import dataclass
from pathlib import Path

from gsfluent.figure.markdown import enter
from gsfluent.io.atomic import atomic_path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "silence.md"
COLUMNS = 100
CASES = {
    "run, photographs": "run {data}/captures/skull -o {out}/skull",
    "run, splats": "run {data}/splats/plush_dog/point_cloud_29999_clean.ply -o {out}/dog",
    "run, mesh": "run {data}/meshes/armadillo/armadillo.obj -o {out}/armadillo",
    "run again": "run {data}/meshes/armadillo/armadillo.obj -o {out}/armadillo",
    "plan": "plan {data}/splats/plush_dog/point_cloud_29999_clean.ply",
    "inspect": "inspect {data}/splats/plush_dog/point_cloud_29999_clean.ply -o {out}/dog.png",
    "poses": "poses {data}/captures/skull/images -o {out}/poses",
    "fill": "fill {data}/splats/plush_dog/point_cloud_29999_clean.ply -o {out}/dog_solid.ply "
    "--resolution 256",
    "texture": "texture {out}/dog_solid.ply -o {out}/dog_inside.ply",
    "render": "render {out}/dog --size 1280x720 -o {out}/dog.mp4",
    "export": "export {out}/dog --to ply-seq,spz -o {out}/dog_export",
}
"""Commands by name, in the order in which one needs what another leaves."""
_WORDS = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|[\r\n]+")


@dataclass(frozen=True)
class Heard:
    """What was heard of a command.

    Attributes:
        seconds: From start to end.
        longest: Longest silence [s].
        before: The last words before it.
        code: Exit code.
    """

    seconds: float
    longest: float
    before: str
    code: int


def listen(command: list[str], terminal: bool) -> Heard:
    """Run a command and time its silences.

    Args:
        command: Program and arguments.
        terminal: Whether it sees a terminal.
    """
    mine, its = pty.openpty() if terminal else os.pipe()
    if terminal:
        fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 40, COLUMNS, 0, 0))
    env = os.environ | {"TERM": "xterm", "PYTHONUNBUFFERED": "1"}
    begun = last = time.monotonic()
    worker = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=its, stderr=its, env=env)
    os.close(its)
    longest, before, words = 0.0, "", "(start)"
    while True:
        try:
            said = os.read(mine, 65536)
        except OSError:  # a terminal that nobody holds any more
            said = b""
        now = time.monotonic()
        if now - last > longest:
            longest, before = now - last, words
        last = now
        if not said:
            break
        lines = [line.strip() for line in _WORDS.split(said.decode(errors="replace"))]
        words = next((line for line in reversed(lines) if line), words)
    os.close(mine)
    return Heard(time.monotonic() - begun, longest, before, worker.wait())


def table(rows: dict[str, tuple[Heard, Heard]], page: str = "") -> str:
    """Longest silences of all commands as a Markdown table, and the rows of others on a page."""
    lines = {}
    for name in CASES:
        if found := re.search(rf"^\| {re.escape(name)} \|.*$", page, re.MULTILINE):
            lines[name] = found.group()
    for name, (piped, drawn) in rows.items():
        worst = max(piped, drawn, key=lambda heard: heard.longest)
        words = re.sub(r"[|`]", " ", worst.before)[:60]
        lines[name] = (
            f"| {name} | {piped.seconds:.0f} | {piped.longest:.1f} | {drawn.longest:.1f} | "
            f"{words} |"
        )
    order = sorted(lines, key=lambda name: [*CASES, name].index(name))
    head = ["| command | s | longest silence, lines s | bars s | after |",
            "| --- | --- | --- | --- | --- |"]  # fmt: skip
    return "\n".join([*head, *(lines[name] for name in order)])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="the captures, splats and meshes")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/silence"))
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--write", action="store_true", help="enter the table into the page")
    parser.add_argument("command", nargs="*", help="one command instead, after --")
    args = parser.parse_args()
    if args.command:
        asked = {" ".join(args.command): None}
    elif args.data is None:
        parser.error("name --data, or a command after --")
    else:
        asked = {name: CASES[name] for name in args.cases}
    rows = {}
    for name, text in asked.items():
        heard = []
        for terminal in (False, True):
            command = args.command
            if text is not None:
                place = args.out / ("terminal" if terminal else "pipe")
                place.mkdir(parents=True, exist_ok=True)
                words = text.format(data=args.data, out=place).split()
                command = [sys.executable, "-m", "gsfluent", *words]
            heard.append(listen(command, terminal))
            print(f"{name}: {heard[-1]}", flush=True)
        rows[name] = (heard[0], heard[1])
    print(table(rows))
    if args.write:
        text = PAGE.read_text(encoding="utf-8")
        text = enter(text, "silence", table(rows, text))
        with atomic_path(PAGE) as path:
            path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
