"""From words to one verb's dataclass."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro

from gsfluent import __version__
from gsfluent.cli.common import Verb
from gsfluent.cli.verbs_export import Carry, Export
from gsfluent.cli.verbs_lab import Chart, Stability
from gsfluent.cli.verbs_look import Doctor, Inspect, Metrics, Plan
from gsfluent.cli.verbs_run import Demo, Render, Report, Run
from gsfluent.cli.verbs_stage import Fill, Mesh, Poses, Reconstruct, Texture
from gsfluent.cli.verbs_sweep import Dataset, Sweep
from gsfluent.cli.verbs_view import Studio, View

VERBS: dict[str, type[Verb]] = {
    "doctor": Doctor,
    "demo": Demo,
    "poses": Poses,
    "inspect": Inspect,
    "reconstruct": Reconstruct,
    "fill": Fill,
    "texture": Texture,
    "mesh": Mesh,
    "plan": Plan,
    "run": Run,
    "sweep": Sweep,
    "dataset": Dataset,
    "carry": Carry,
    "render": Render,
    "report": Report,
    "view": View,
    "studio": Studio,
    "export": Export,
    "metrics": Metrics,
    "chart": Chart,
    "stability": Stability,
}

_ABOUT = """\
Photographs of an object in, a video of it breaking out, with an inside.

examples:
  gsfluent doctor                     # what works on this machine
  gsfluent demo -o demo_out           # a melon falls and breaks; no download
  gsfluent run shot.yaml -o out       # your own shot
  gsfluent run --help                 # every verb teaches itself by example
"""

_CONFIG = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)


def parse(arguments: Sequence[str]) -> Verb:
    """Return the verb's filled dataclass.

    Raises:
        SystemExit: 0 after printing help or the version, 2 after printing what is wrong.
    """
    words = list(arguments)
    if words and words[0] in VERBS:
        kind = VERBS[words[0]]
        text = inspect.cleandoc(kind.__doc__ or "")
        return tyro.cli(
            kind, prog=f"gsfluent {words[0]}", description=text, args=words[1:], config=_CONFIG
        )
    if words in (["--version"], ["-V"]):
        import sys

        sys.stdout.write(f"gsfluent {__version__}\n")
        raise SystemExit(0)
    # only help, a missing verb and a misspelt one come here; one line per verb is enough
    choices: Any = Union[  # noqa: UP007 - there is no other spelling for a computed union
        tuple(
            Annotated[
                kind,
                tyro.conf.subcommand(
                    name, prefix_name=False, description=(kind.__doc__ or "").split("\n")[0]
                ),
            ]
            for name, kind in VERBS.items()
        )
    ]
    verb: Verb = tyro.cli(
        choices, prog="gsfluent", description=_ABOUT, args=words or ["--help"], config=_CONFIG
    )
    return verb
