"""Count the calls of torch that a thread of `simulate` makes in a shot, by function.

A call of torch takes as long on a GPU whatever it works on, as long as that is little. So what a
frame costs there is what it asks for, and that is the same on every machine:

    gsfluent demo -o out
    python scripts/stages/calls.py out/shot.yaml -o out

Those of the repair of cracks are counted, or with `--thread solver` those of the thread that moves
the matter. The stages before `simulate` are taken from the folder where they are done.
"""

from __future__ import annotations

import argparse
import collections
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

import gsfluent
from gsfluent.cli import main as gsfluent_main
from gsfluent.pipeline.cracks.chunks import Chunks
from gsfluent.pipeline.simulate.stage import Simulation

HOME = str(Path(gsfluent.__file__).parent)
THREADS = {"repair": (Chunks, "step"), "solver": (Simulation, "advance")}


class Counted(TorchDispatchMode):
    """Counts calls for every function of gsfluent that is under way, or for the innermost."""

    def __init__(self, into: collections.Counter[str], own: bool) -> None:
        super().__init__()
        self.into, self.own = into, own

    def __torch_dispatch__(
        self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        frame, names = sys._getframe(1), set()
        while frame is not None:
            code = frame.f_code
            if code.co_filename.startswith(HOME):
                names.add(f"{Path(code.co_filename).stem}.{code.co_qualname}")
                if self.own:
                    break
            frame = frame.f_back  # type: ignore[assignment]
        self.into.update(names)
        return func(*args, **(kwargs or {}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("shot", help="a shot")
    parser.add_argument("-o", "--output", required=True, help="its folder")
    parser.add_argument("--thread", choices=sorted(THREADS), default="repair", help="whose calls")
    parser.add_argument("--own", action="store_true", help="count for the innermost function only")
    parser.add_argument("--rows", type=int, default=20, help="functions shown (default 20)")
    options = parser.parse_args()
    for stage in ("simulate", "render"):
        shutil.rmtree(Path(options.output) / "stages" / stage, ignore_errors=True)
    counts: collections.Counter[str] = collections.Counter()
    frames = 0
    owner, method = THREADS[options.thread]
    step = getattr(owner, method)

    def counted(self: Any, *args: Any, **kwargs: Any) -> Any:
        nonlocal frames
        frames += 1
        with Counted(counts, options.own):
            return step(self, *args, **kwargs)

    setattr(owner, method, counted)
    torch.set_num_threads(1)
    sys.argv = ["gsfluent", "run", options.shot, "-o", options.output]
    status = gsfluent_main()
    if status:
        sys.exit(status)
    print(f"\n{frames} frames\n\n| function | calls of torch | a frame |\n| --- | --- | --- |")
    for name, count in counts.most_common(options.rows):
        print(f"| `{name}` | {count:,} | {count / max(frames, 1):,.0f} |")


if __name__ == "__main__":
    main()
