"""The frozen scenes: what the YAML of each says, and whether the builders still give them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import yaml

from gsfluent.fracturebench.registry import Case
from gsfluent.fracturebench.scene import Scene, SceneError

SCENES = Path(__file__).resolve().parent / "scenes"
PER_CELL = 8
LONG = 12
ARRAYS = {
    "x": "positions [m]",
    "v": "velocities at the start [m/s]",
    "volume": "volume of each point at rest [m^3]",
    "material": "row of materials",
    "body": "body; points of different bodies are not glued together",
    "affine": "velocity gradients at the start [1/s]",
    "times": "when positions and velocities are asked for [s]",
    "strain": "elastic strain b - I at the start",
}
UNITS = (
    "metre, second, kilogram; gravity m/s^2, young_modulus and other stresses Pa, density kg/m^3"
)


def build(case: Case) -> Scene:
    """The scene of a case at its frozen resolution."""
    return case.build(case.dx, PER_CELL)


def describe(case: Case, scene: Scene) -> dict[str, Any]:
    """What the YAML file says of a scene, as plain values in the order of reading."""
    header = scene.header()

    def short(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: short(v) for k, v in value.items()}
        if isinstance(value, list | tuple):
            if len(value) > LONG:
                return f"{len(value)} entries, see the header in {scene.name}.npz"
            return [short(v) for v in value]
        return value.item() if hasattr(value, "item") else value

    # the header goes through JSON on its way into the .npz: nothing but plain values is in it
    return {
        "fracturebench": header["format"], "name": scene.name, "kind": case.kind,
        "summary": case.summary, "units": UNITS, "dx": scene.dx, "points": scene.count,
        "bodies": int(scene.body.max()) + 1, "times": [float(t) for t in scene.times],
        "materials": [dict(m) for m in scene.materials],
        "gravity": [float(g) for g in scene.gravity], "colliders": short(scene.colliders),
        "drives": short(scene.drives), "friction": scene.friction, "asks": list(scene.asks),
        "facts": short(dict(scene.facts)),
        "arrays": {
            name: f"{getattr(scene, name).dtype} {list(getattr(scene, name).shape)}: {what}"
            for name, what in ARRAYS.items()
            if name in scene.arrays
        },
        "sha256": scene.digest(),
    }  # fmt: skip


def text(case: Case, scene: Scene) -> str:
    """The YAML file of a scene."""
    said = describe(case, scene)
    tail = {key: said.pop(key) for key in ("arrays", "sha256")}
    head = yaml.safe_dump(said, sort_keys=False, width=100, default_flow_style=None)
    tables = yaml.safe_dump(tail, sort_keys=False, width=1000, default_flow_style=False)
    return f"# Arrays: {scene.name}.npz (scripts/fracturebench/make.py writes it).\n{head}{tables}"


def differences(said: Any, now: Any, where: str = "") -> list[str]:
    """Where two descriptions differ by more than rounding."""
    if isinstance(said, dict) and isinstance(now, dict):
        keys = [*said, *(k for k in now if k not in said)]
        return [d for k in keys for d in differences(said.get(k), now.get(k), f"{where}.{k}")]
    if isinstance(said, list) and isinstance(now, list) and len(said) == len(now):
        pairs = enumerate(zip(said, now, strict=True))
        return [d for i, (a, b) in pairs for d in differences(a, b, f"{where}[{i}]")]
    if isinstance(said, float) and isinstance(now, int | float):
        same = math.isclose(said, now, rel_tol=1e-6, abs_tol=1e-12)
        return [] if same else [f"{where.lstrip('.')}: {said!r} frozen, {now!r} built"]
    return [] if said == now else [f"{where.lstrip('.')}: {said!r} frozen, {now!r} built"]


def drift(case: Case, scene: Scene) -> list[str]:
    """How a built scene differs from its frozen YAML.

    Raises:
        SceneError: It was never frozen.
    """
    path = SCENES / f"{case.name}.yaml"
    if not path.is_file():
        raise SceneError(
            f"{case.name} is not frozen: python scripts/fracturebench/make.py --freeze {case.name}"
        )
    frozen = yaml.safe_load(path.read_text(encoding="utf-8"))
    # a summary is for reading, and may be said better
    now = yaml.safe_load(text(case, scene)) | {"summary": frozen.get("summary")}
    return differences(frozen, now)
