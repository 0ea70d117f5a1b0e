"""The scorer: runs in files against scenes in files, as a table and as plain values."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from .registry import judge
from .run import Measure, Run
from .scene import Scene, SceneError


@dataclasses.dataclass(frozen=True)
class Score:
    """What a method reached on a case."""

    case: str  # name of the case
    method: str  # who computed it
    # all measures, the first of which is the error of the charts; none if invalid
    measures: tuple[Measure, ...] = ()
    wall_seconds: float = math.nan  # of the steps [s]
    simulated_seconds: float = math.nan  # [s]
    points: int = 0  # material points
    steps: int = 0  # steps taken
    device: str = ""  # on what
    failed: str = ""  # why the run broke off, or empty
    invalid: str = ""  # why the file could not be judged, or empty
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)  # what the method chose

    @property
    def passed(self) -> bool:
        """Whether every measure is within its tolerance."""
        return bool(self.measures) and all(m.passed for m in self.measures)


def read_scenes(folder: Path) -> dict[str, Scene]:
    """Read all scenes of a folder, and check them against the YAML beside each where there is one.

    Raises:
        SceneError: No scenes, a file that is none, or arrays other than those that were frozen.
    """
    found: dict[str, Scene] = {}
    for path in sorted(folder.glob("*.npz")):
        scene = Scene.load(path)
        said = path.with_suffix(".yaml")
        if said.is_file():
            frozen = re.search(r"^sha256:\s*(\w+)", said.read_text(encoding="utf-8"), re.MULTILINE)
            if frozen and frozen[1] != scene.digest():
                raise SceneError(f"{path}: not the arrays that {said.name} was frozen with")
        if scene.name in found:
            raise SceneError(f"{path}: a second scene named {scene.name!r}")
        found[scene.name] = scene
    if not found:
        raise SceneError(
            f"{folder}: no scenes (*.npz) here; python scripts/fracturebench/make.py writes them"
        )
    return found


def score(scenes: dict[str, Scene], paths: Iterable[Path]) -> list[Score]:
    """Judge runs in files; one that cannot be judged is a score that says why.

    Args:
        scenes: By name.
        paths: Files of :meth:`~gsfluent.fracturebench.run.Run.save`.
    """
    found: dict[tuple[str, str], Score] = {}
    broken = []
    for path in paths:
        try:
            run = Run.load(path)
            if run.scene not in scenes:
                known = ", ".join(scenes)
                raise SceneError(f"{path}: answers {run.scene!r}; the scenes are {known}")
            scene = scenes[run.scene]
            try:
                measures = tuple(judge(scene, run))
            except SceneError as error:
                raise SceneError(f"{path}: {error}") from error
            key = run.scene, run.method
            if key in found:
                raise SceneError(f"{path}: a second run of {run.scene!r} by {run.method!r}")
            found[key] = Score(
                run.scene, run.method, measures, run.wall_seconds, scene.seconds, scene.count,
                run.steps, run.device, run.failed, "", dict(run.settings),
            )  # fmt: skip
        except SceneError as error:
            broken.append(Score(path.stem, path.parent.name, invalid=str(error)))
    return [found[key] for key in sorted(found)] + broken


def _number(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "-"


def markdown(scores: Sequence[Score], measures: bool = True) -> str:
    """Return the scores as a table.

    Args:
        scores: Of :func:`score`.
        measures: A row for every measure; else one per run, with the first.
    """
    lines = [
        "| case | method | device | quantity | value | reference | error | tolerance | passed | "
        "steps | wall s |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for s in scores:
        for i, m in enumerate(s.measures if measures else s.measures[:1]):
            error = _number(m.error) if not s.failed else "broke off"
            tail = (str(s.steps), _number(s.wall_seconds)) if i == 0 else ("", "")
            unit = f" {m.unit}" if m.unit else ""
            cells = (
                s.case, s.method, s.device, m.quantity, _number(m.value) + unit,
                _number(m.reference) + unit, error, _number(m.tolerance),
                "yes" if m.passed else "no", *tail,
            )  # fmt: skip
            lines.append("| " + " | ".join(c.replace("|", "/") for c in cells) + " |")
    return "\n".join(lines)


def plain(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Return the scores as values that JSON can hold; a number that is not finite becomes None."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {str(k): clean(v) for k, v in value.items()}
        if isinstance(value, list | tuple):
            return [clean(v) for v in value]
        if isinstance(value, float) and not math.isfinite(value):
            return None
        return value

    rows = []
    for s in scores:
        row = dataclasses.asdict(s) | {"passed": s.passed}
        for out, m in zip(row["measures"], s.measures, strict=True):
            out["passed"] = m.passed
        rows.append(clean(row))
    return rows
