"""Time of the pictures of finished runs with a liquid, beside those with the liquid as splats.

    python scripts/pictures/liquid_time.py RUN [RUN ...] [--json FILE] [--page PAGE]

CPU time on one thread, every eighth frame, the best of three pictures of each.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch

from gsfluent.figure.markdown import enter
from gsfluent.pipeline.light.from_shot import gloss_of, light_of, plates_of
from gsfluent.pipeline.render.film import Film
from gsfluent.results.frames import SavedFrame
from gsfluent.results.record import shot_of

EVERY = 8


def best(picture: Any) -> float:
    """CPU time [ms], the least of three."""
    found = []
    for _ in range(3):
        start = time.process_time()
        picture()
        found.append(time.process_time() - start)
    return 1e3 * min(found)


def measured(run: Path) -> dict[str, Any]:
    """The line of one run."""
    shot = shot_of(run)
    film = Film(run, shot, light_of(shot), torch.device("cpu"))

    def splats(frame: SavedFrame) -> None:
        film.render(
            frame.gaussians,
            film.cameras[frame.index],
            groups=frame.groups,
            gloss=gloss_of(shot, frame),
            plates=plates_of(frame),
            rigid=frame.anchor < 0,
            time=frame.time,
        )

    drawn, plain, first = [], [], []
    for index in range(0, len(film), EVERY):
        for before in range(max(0, index - EVERY + 1), index):
            film.picture(film.frame(before))  # wetness is asked frame by frame
        frame = film.frame(index)
        start = time.process_time()
        film.picture(frame)
        first.append(1e3 * (time.process_time() - start))
        drawn.append(best(lambda frame=frame: film.picture(frame)))
        plain.append(best(lambda frame=frame: splats(frame)))

    def mean(values: list[float]) -> float:
        return sum(values) / len(values)

    return {"run": run.name, "plain": mean(plain), "drawn": mean(drawn), "first": mean(first)}


def table(lines: list[dict[str, Any]]) -> str:
    """The table of the page."""
    head = (
        "| run | as splats | with its surface | times | and with what it wets anew |\n"
        "| --- | --- | --- | --- | --- |\n"
    )
    return head + "".join(
        f"| {line['run']} | {line['plain']:.0f} ms | {line['drawn']:.0f} ms "
        f"| {line['drawn'] / line['plain']:.2f} | {line['first']:.0f} ms |\n"
        for line in lines
    )


def main(argv: list[str] | None = None) -> None:
    """Measure runs, keep their lines, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--json", type=Path, help="lines of the runs")
    parser.add_argument("--page", type=Path, help="page that gets the table")
    given = parser.parse_args(argv)
    torch.set_num_threads(1)
    lines = [measured(run) for run in given.runs]
    print(table(lines))
    if given.json is not None:
        text = "".join(json.dumps(line) + "\n" for line in lines)
        given.json.write_text(text, encoding="utf-8")
    if given.page is not None:
        page = given.page.read_text(encoding="utf-8")
        given.page.write_text(enter(page, "liquid time", table(lines)), encoding="utf-8")


if __name__ == "__main__":
    main()
