"""Which passes a shot needs, and why: the planner's half of "model no more than a scene needs".

``run.json`` has the other half, the counters of what was left out;
tests/pipeline/test_plan_left_out.py holds the two together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gsfluent.config import Shot
from gsfluent.pipeline.light_shot import light_of
from gsfluent.pipeline.plan_motion import Outlook
from gsfluent.pipeline.plan_work import texture_method
from gsfluent.scene import Scene

__all__ = ["laws_of", "passes_of"]


def laws_of(scene: Scene) -> set[str]:
    """Laws of all materials of a scene."""
    return {
        material.law
        for body in scene.bodies
        for material in [body.material, *(part.material(body.material) for part in body.parts)]
    }


def passes_of(shot: Shot, scene: Scene, outlook: Outlook) -> list[dict[str, Any]]:
    """The passes: ``pass``, ``needed`` and ``why``.

    Args:
        shot: The shot.
        scene: Its scene.
        outlook: What will happen.
    """
    laws = laws_of(scene)
    breaks = "nacc" in laws
    several = len(scene.bodies) > 1
    flies = outlook.grid_from > 0.0
    gridded = outlook.grid_seconds > 0.0
    exports = [kind for kind in shot.output.what if kind != "mp4"]
    things = _names(scene.colliders)
    rests = scene.floor is not None and any(scene.gravity)
    fields = (
        f"{len(scene.bodies)} bodies" if several else "one body that can break: pieces get fields"
    )
    method = texture_method(shot)
    lamps = light_of(shot).lamps
    casting = [lamp for lamp in lamps if lamp.shadow]
    rows = [
        ("reconstruct", shot.capture is not None, "photographs", "splats are given"),
        ("fill", True, "splats are a shell", ""),
        ("texture", True, f"the inside has no colours yet ({method})", ""),
        ("grid", gridded, f"from t = {outlook.grid_from:.3g} s on",
         "nothing touches anything: free flight in closed form"),
        ("free flight", flies, f"closed form until t = {outlook.grid_from:.3g} s",
         "something touches something from the start"),
        ("contact fields", gridded and (several or (breaks and outlook.shatters)), fields,
         "one body that stays in one piece: one velocity field"),
        ("damage variable", gridded and breaks, "brittle matter (nacc)", "no brittle matter"),
        ("return map", gridded and bool(laws - {"elastic"}),
         f"matter that yields ({', '.join(sorted(laws - {'elastic'}))})", "no matter yields"),
        ("rigid things", bool(scene.colliders), things, "only the floor" if rests else "none"),
        ("blades", bool(scene.blades), _names(scene.blades), "nothing is cut"),
        ("composed steps", outlook.composed_seconds > 0.0,
         f"a blade is at work for {outlook.composed_seconds:.3g} s", "no blade is at work"),
        ("sleep", rests, "what comes to rest leaves the grid", "nothing to rest on"),
        ("repair", breaks and shot.output.cracks != "none", f"cracks open ({shot.output.cracks})",
         "cracks are not drawn" if breaks else "nothing can crack"),
        ("light", True, _counted(len(lamps), "lamp"), ""),
        ("shadows", bool(casting), f"of {_counted(len(casting), 'lamp')}", "no lamp casts any"),
        ("export", bool(exports), ", ".join(exports), "only the video is asked for"),
    ]  # fmt: skip
    return [{"pass": n, "needed": need, "why": yes if need else no} for n, need, yes, no in rows]


def _names(things: Sequence[Any]) -> str:
    return ", ".join(thing.name for thing in things)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
