"""Feed changed files to every reader for as long as you like, and keep what breaks one.

    python scripts/safety/fuzz.py --files 10000            # a table of what became of them
    python scripts/safety/fuzz.py --hours 8 --seed 5 -o out/fuzz

Every file is read in a forked child with limits of time and memory (tests/fuzz/fuzz_server.py). A
finding is written to OUT as JSON; move it to tests/fuzz/seeds once it is mended, and it stays a
test. Exit code 1 when there is one.
"""

from __future__ import annotations

import argparse
import collections
import json
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
BATCH = 25  # files of a reader in a row
PAGE = ROOT / "docs" / "measured" / "fuzz.md"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=2000, help="files in all")
    parser.add_argument("--hours", type=float, help="instead of --files")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--readers", nargs="*", help="only these")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/fuzz"))
    parser.add_argument("--enter", action="store_true", help="write the table into docs/measured")
    options = parser.parse_args()
    sys.path.insert(0, str(ROOT / "tests" / "fuzz"))
    from fuzz_server import Reading
    from fuzz_session import Tally, sweep

    tally, start, seed = Tally(), time.monotonic(), options.seed
    reading = Reading()
    names = options.readers or list(reading.parts)
    done, told = 0, 0
    while (
        done < options.files
        if options.hours is None
        else time.monotonic() - start < 3600.0 * options.hours
    ):
        name = names[(seed - options.seed) % len(names)]
        sweep(reading, name, BATCH, seed, tally)
        seed += 1
        done = sum(tally.verdicts.values())
        for found in list(tally.findings.values())[told:]:
            told += 1
            print(*found.same, sep=": ", flush=True)
            keep(options.out, found)
    reading.close()
    rows = table(tally, names)
    print(rows)
    if options.enter:
        enter(rows, options.seed, time.monotonic() - start)
    return 1 if tally.findings else 0


def keep(out: Path, found: Any) -> None:
    """Write a finding: the reader, what it did, and the file's parts."""
    out.mkdir(parents=True, exist_ok=True)
    count = len(list(out.glob(f"{found.reader}_*.json")))
    values = {
        "reader": found.reader,
        "kind": found.verdict.kind,
        "text": found.verdict.text,
        "parts": [part.hex() for part in found.parts],
    }
    (out / f"{found.reader}_{count}.json").write_text(json.dumps(values, indent=1) + "\n")


def table(tally: Any, names: list[str]) -> str:
    """One row per reader: files, read, refused, findings."""
    lines = ["| reader | files | read | refused | findings |", "| --- | --- | --- | --- | --- |"]
    total = collections.Counter[str]()
    for name in [*names, "all"]:
        row = total if name == "all" else collections.Counter(
            {kind: n for (reader, kind), n in tally.verdicts.items() if reader == name}
        )  # fmt: skip
        files, good, refused = sum(row.values()), row["read"], row["refused"]
        lines.append(f"| {name} | {files} | {good} | {refused} | {files - good - refused} |")
        total += row if name != "all" else collections.Counter()
    return "\n".join(lines)


def enter(rows: str, seed: int, seconds: float) -> None:
    """Put the table between the markers of its page."""
    begin, end = "<!-- fuzz: begin -->\n", "\n<!-- fuzz: end -->"
    text = PAGE.read_text(encoding="utf-8")
    head, tail = text.split(begin)[0], text.split(end)[1]
    note = f"Seed {seed}, {seconds / 60:.0f} minutes.\n\n"
    PAGE.write_text(f"{head}{begin}{note}{rows}{end}{tail}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
