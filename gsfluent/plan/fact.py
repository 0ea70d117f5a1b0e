"""A plan beside what came of it: ``plan`` in ``run.json``, and what the cost model learns from it.

Two things can be wrong with a plan: how much work it foresaw, and what it thinks that work costs.
So each stage is also predicted anew from the work that was really done; only what is off then is
the model's, and only that corrects it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from gsfluent.config.settings import EXPORTS
from gsfluent.errors import GsfluentError
from gsfluent.plan.cost import LAW_SETS, Cost, CostModel, framing, stepping
from gsfluent.plan.fit import Sample, fit
from gsfluent.plan.work import mean_splats

_log = logging.getLogger(__name__)

STAGES = ("reconstruct", "isolate", "fill", "texture", "simulate", "render", "export")
"""Stages that have a cost, in their order."""

_GROWS: dict[str, tuple[str, ...]] = {
    "reconstruct": ("start", "step_splats", "step_pixels"),
    "isolate": ("start", "splats"),
    "fill": ("start", "voxels", "inner"),
    "texture": ("start",),
    "simulate": ("start", "composed_point_steps", "frame_gaussians"),
    "render": ("start", "frame_pixels", "frame_gaussians"),
    "export": (),
}
"""What a stage's time is taken to grow with where one run is all that is known of it."""
_ALIKE = {
    "simulate": tuple(f"point_steps_{laws}" for laws in LAW_SETS),
    "texture": ("exemplar_voxels", "procedural_voxels"),
    "export": tuple(f"{kind}_gaussians" for kind in EXPORTS),
}
"""The same, of kinds of work of which one run shows one or a few."""

Work = dict[str, dict[str, float]]


_SLOWEST = 4.0
"""Times as slow, or as fast, as planned that a run is taken to be, at most."""
_TRUST = 0.1
"""Share of a whole plan that is taken to have been kept before a run has begun."""


def seconds_left(
    planned: Mapping[str, float | None],
    finished: Mapping[str, float],
    current: str,
    elapsed: float,
    share: float,
) -> float | None:
    """What a run will still take [s]: the plan, at the pace that the run has shown.

    What is left of the stage at work is told by its plan at first, and the more by its own pace the
    more of it is done.

    Args:
        planned: Seconds of every stage by the plan.
        finished: Seconds that finished stages took; what was found done is left out.
        current: Stage at work.
        elapsed: Since it began [s].
        share: How much of it is done, 0..1.

    Returns:
        None where the plan has no time for a stage that is still to be done.
    """
    told = {name: took for name, took in finished.items() if planned.get(name)}
    took, guess = sum(told.values()), sum(float(planned[name] or 0.0) for name in told)
    order = list(planned)
    later = order[order.index(current) + 1 :] if current in order else order
    if any(planned[name] is None for name in [current, *later] if name in planned):
        return None

    # a short stage that was slow says little of a long one
    sure = _TRUST * sum(seconds or 0.0 for seconds in planned.values())

    def pace() -> float:
        ratio = (took + sure) / (guess + sure) if guess + sure > 0.0 else 1.0
        return min(max(ratio, 1.0 / _SLOWEST), _SLOWEST)

    whole = float(planned.get(current) or 0.0)
    wanted = pace() * whole
    rest = max(wanted - elapsed, 0.1 * elapsed)
    if share > 0.0:
        rest = (1.0 - share) * (elapsed + (1.0 - share) * max(wanted, elapsed))
        took, guess = took + elapsed + rest, guess + whole
    return rest + pace() * sum(float(planned[name] or 0.0) for name in later)


def actual_work(planned: Mapping[str, Mapping[str, float]], values: Mapping[str, Any]) -> Work:
    """The features of the work that a run has done.

    Args:
        planned: Features by stage, as planned; what a run does not record stays as it is.
        values: ``run.json``.
    """
    work: Work = {name: dict(features) for name, features in planned.items()}
    _reconstructed(work, values.get("reconstruction") or {})
    splats = _isolated(work, values.get("isolation") or {})
    inside = _filled(work, values.get("fill") or {}, splats)
    _textured(work)
    rendered = values.get("render") or {}
    born = rendered.get("transition_gaussians") or []
    _simulated(work, values.get("simulation") or {}, inside, born)
    drawn = work.get("render")
    if drawn is not None and rendered.get("frames"):
        frames = int(rendered["frames"])
        pixels = drawn["pixels"]
        mean = inside + sum(born) / max(1, len(born)) if inside else drawn["gaussians"]
        drawn |= {
            "frames": float(frames),
            "frame_pixels": frames * pixels,
            "frame_gaussians": frames * mean,
            "gaussians": mean,
        }
    return work


def _reconstructed(work: Work, report: Mapping[str, Any]) -> None:
    features = work.get("reconstruct")
    if features is None or "gaussians" not in report:
        return
    steps = float(report["iterations"])
    mean = mean_splats(report.get("history") or [], int(steps)) or float(report["gaussians"])
    features["step_splats"] = steps * mean


def _isolated(work: Work, report: Mapping[str, Any]) -> float:
    """Splats of the object."""
    features = work.get("isolate")
    if features is None or "gaussians_kept" not in report:
        return 0.0
    features["splats"] = float(report["gaussians_kept"] + report.get("gaussians_removed", 0))
    return float(report["gaussians_kept"])


def _filled(work: Work, report: Mapping[str, Any], splats: float) -> float:
    """Splats of the solids."""
    features = work.get("fill")
    if features is None or "interior_gaussians" not in report:
        return 0.0
    objects = report.get("objects") or [report]
    if any("grid" not in one for one in objects):  # a solid that came filled
        return features["splats"] + float(report["interior_gaussians"])
    boxes = [float(math.prod(one["grid"])) for one in objects]
    placed = [float(one["interior_gaussians"] + one.get("pruned", 0)) for one in objects]
    features |= {
        "voxels": sum(boxes),
        "voxels_most": max(boxes),
        "matter_voxels": sum(one["volume"] / one["voxel"] ** 3 for one in objects),
        "inner": sum(placed),
        "inner_most": max(placed),
    }
    features["splats"] = splats or features["splats"]
    return features["splats"] + float(report["interior_gaussians"])


def _textured(work: Work) -> None:
    features, fill = work.get("texture"), work.get("fill")
    if features is None or fill is None:
        return
    for name in features:
        if name.endswith("_voxels"):
            features[name] = fill["voxels"]
    features |= {"volume_most": fill["voxels_most"], "splats": fill["splats"] + fill["inner"]}


def _simulated(work: Work, report: Mapping[str, Any], gaussians: float, born: list[float]) -> None:
    features = work.get("simulate")
    if features is None or not report.get("frames"):
        return
    gaussians = gaussians or features["gaussians"]
    broken = report["per_frame"]["damaged_fraction"]
    share = sum(value > 0.0 for value in broken) / max(1, len(broken))
    laws = next(n for n in features if n.startswith("point_steps_")).removeprefix("point_steps_")
    brittle = features["cracked_gaussians"] > 0.0 or bool(born and max(born) > 0)
    features |= stepping(
        report["grid_points_mean"],
        report["active_blocks_mean"],
        report["substeps"],
        fields=int(report["fields_max"]),
        laws=laws,
        composed_steps=report["composed_steps"],
        shared=1.0 - report["skipped"]["contact_block_fraction"],
    )
    features |= framing(
        report["frames"], gaussians, report["particles"], brittle=brittle, broken=share
    )
    features |= {
        "blocks_most": float(report["active_blocks_max"]),
        "points": float(report["particles"]),
        "gaussians": gaussians,
        "born": float(max(born, default=0.0)),
    }


def compare(plan: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """The section ``plan`` of ``run.json``.

    Args:
        plan: What :func:`gsfluent.plan.plan.plan_shot` said before the run.
        values: ``run.json``, with ``stages`` filled in.

    Returns:
        ``predicted``, ``actual`` and ``ratio`` (actual over predicted) with the same keys;
        stages that were found finished are left out of all three.
    """
    kind = str(values.get("device", "cpu")).split(":")[0]
    memory = "peak_memory_bytes" if kind == "cpu" else "peak_device_memory_bytes"
    done = {
        stage["name"]: stage
        for stage in values["stages"]
        if stage["name"] in STAGES and not stage["resumed"]
    }
    simulation = values.get("simulation") or {}
    names = [name for name in done if name in plan["stages"]]
    predicted: dict[str, Any] = {"stages": {n: dict(plan["stages"][n]) for n in names}}
    actual: dict[str, Any] = {
        "stages": {
            n: {"seconds": done[n]["seconds"], "memory_bytes": done[n][memory]} for n in names
        }
    }
    for side in (predicted, actual):
        for key, total in (("seconds", sum), ("memory_bytes", max)):
            parts = [row[key] for row in side["stages"].values()]
            known = bool(parts) and all(part is not None for part in parts)
            side[key] = total(parts) if known else None
    if "simulate" in done and simulation:
        for key in ("dx", "particles", "substeps", "active_blocks"):
            predicted[key] = plan[key]
            actual[key] = simulation["active_blocks_mean" if key == "active_blocks" else key]
    return {
        "calibrated": plan["calibrated"],
        "predicted": predicted,
        "actual": actual,
        "ratio": _ratio(predicted, actual),
    }


def _ratio(predicted: Mapping[str, Any], actual: Mapping[str, Any]) -> dict[str, Any]:
    """Actual over predicted; None where there is nothing to divide."""
    found: dict[str, Any] = {}
    for key, took in actual.items():
        said = predicted.get(key)
        if isinstance(took, Mapping):
            found[key] = _ratio(said or {}, took)
        else:
            found[key] = took / said if said and took is not None else None
    return found


def learn(
    model: CostModel | None,
    plan: Mapping[str, Any],
    values: Mapping[str, Any],
    device: torch.device | str,
    folder: Path | None = None,
    *,
    crowded: bool = False,
) -> CostModel:
    """Correct the stored model of a device by a finished run; without one, the run makes the first.

    Args:
        model: With which it was planned; the stored one goes first.
        plan: What was planned.
        values: ``run.json``.
        device: Where it ran.
        folder: Of the stored model, the cache otherwise.
        crowded: Whether others took the processors meanwhile.

    Returns:
        The corrected model, which has been stored.
    """
    # another run may have taught the stored model since
    model = CostModel.load(device, folder) or model or CostModel.unmeasured(device)
    section = compare(plan, values)
    work = actual_work(plan["work"], values)
    for name, took in section["actual"]["stages"].items():
        if name not in model.seconds and not model.measured:
            model.seconds[name] = _costs(name, work[name], took["seconds"])
        elif name in model.seconds and plan["stages"][name]["seconds"] is not None:
            said = model.stage(name, work[name], corrected=False)
            cost = Cost(took["seconds"], took["memory_bytes"])
            model.learn(name, said, cost, crowded=crowded)
    try:
        if "simulate" in model.seconds:  # it is asked for the cells of a time budget
            model.save(device, folder)
    except (GsfluentError, OSError) as error:
        _log.warning("the cost model could not be stored: %s", error)
    return model


def _costs(name: str, work: Mapping[str, float], seconds: float) -> dict[str, float]:
    """Costs of a stage by one run of it, in equal parts on what it grows with.

    What was not in that run, as other kernels or other kinds of files, costs what was.
    """
    kinds = _ALIKE.get(name, ())
    features = [key for key in _GROWS[name] + kinds if work.get(key, 0.0) > 0.0]
    if not features or not seconds > 0.0:
        return {}
    costs, _ = fit([Sample(name, work, seconds)], features)
    known = [costs[key] for key in kinds if key in costs]
    return dict.fromkeys(kinds, sum(known) / max(len(known), 1)) | costs
