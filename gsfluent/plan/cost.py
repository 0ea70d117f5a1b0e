"""What the stages of a run cost on this machine: a small linear model, measured and stored.

The time of a stage is a sum of features of the work (steps, points, pixels, ...) times what one of
each costs. The costs come from a probe of the real code (:mod:`gsfluent.plan.probe`),
once per machine, and are kept under the user's cache folder. Finished runs correct them: the model
keeps the ratios of the last runs, actual over predicted, per stage, and multiplies by their
geometric mean.

How much memory a stage takes hangs on the data, not on how fast the machine is; its coefficients
are those of :mod:`gsfluent.plan.cost`, and finished runs correct them in the same way.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

import gsfluent
from gsfluent.hardware import processor
from gsfluent.io import write_json

_log = logging.getLogger(__name__)

FORMAT = 2
"""Of the stored file; another number is another model."""
LAW_SETS = ("elastic", "nacc", "general")
"""Sets of laws for which the solver has kernels of their own."""
REMEMBERED = 8
"""Ratios of finished runs that a correction is made of, per stage."""
FORGET = 0.8
"""Weight of a run beside that of the run after it: what a machine was once does not stay."""
PRIOR = 0.5
"""Weight of the probe among them, in runs: one run alone is believed by two thirds."""
CORRECTION = (0.25, 4.0)
"""Corrections stay in this range, so that a run on a machine that was busy cannot spoil a model."""

SHARED = 0.2
"""Share of the blocks in which fields meet, where there are several (median of the gallery)."""

Features = Mapping[str, float]


class Cost(NamedTuple):
    """What work costs."""

    seconds: float  # Wall time [s]
    # Most memory at once: resident memory of the process on the CPU, allocated memory of the device
    # on a GPU.
    bytes: int


def law_set(laws: Iterable[str]) -> str:
    """The set of kernels that laws need: ``elastic``, ``nacc`` (both) or ``general``."""
    found = set(laws)
    if found <= {"elastic"}:
        return "elastic"
    return "nacc" if found <= {"elastic", "nacc"} else "general"


def machine_key(device: torch.device | str) -> dict[str, Any]:
    """What a calibration holds for: processor and threads or GPU, and the build of gsfluent."""
    device = torch.device(device)
    key: dict[str, Any] = {
        "device": device.type,
        "version": gsfluent.__version__,
        "build": _build(device.type),
        "torch": str(torch.__version__),
        "processor": processor(),
        "threads": torch.get_num_threads(),
    }
    if device.type == "cuda":
        key["gpu"] = torch.cuda.get_device_name(device)
    return key


def _build(kind: str) -> str:
    """Size of the compiled kernels: another build is another machine."""
    folder = Path(gsfluent.__file__).parent
    pattern = "_C_cuda*" if kind == "cuda" else "_C.*"
    found = sorted(folder.glob(pattern))
    return ",".join(str(path.stat().st_size) for path in found) or "none"


def cache_folder() -> Path:
    """Where calibrations are stored: ``gsfluent`` in XDG_CACHE_HOME or ``~/.cache``."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "gsfluent"


@dataclasses.dataclass
class CostModel:
    """Costs per unit of work, by stage."""

    machine: dict[str, Any]  # See :func:`machine_key`
    seconds: dict[str, dict[str, float]]  # Stage, feature: seconds per unit of the feature
    made: str = ""  # When the probe was made, ISO 8601
    probe_seconds: float = 0.0  # How long it took
    # Stage: largest relative error of the fit at the sizes that were measured.
    errors: dict[str, float] = dataclasses.field(default_factory=dict)
    # Stage: actual over predicted seconds of the last runs, without correction.
    ratios: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    # The same for memory.
    memory_ratios: dict[str, list[float]] = dataclasses.field(default_factory=dict)

    @classmethod
    def unmeasured(cls, device: torch.device | str) -> CostModel:
        """A model of this machine that knows nothing yet, for runs to teach."""
        return cls(machine=machine_key(device), seconds={})

    # --- asking ---

    @property
    def measured(self) -> bool:
        """Whether the probe made it, and not finished runs."""
        return bool(self.made)

    @property
    def device(self) -> str:
        """``cpu`` or ``cuda``."""
        return str(self.machine.get("device", "cpu"))

    def stage(self, name: str, features: Features, *, corrected: bool = True) -> Cost:
        """What a stage costs.

        Raises:
            ValueError: The model does not know the stage.
        """
        known = self.seconds.get(name)
        if known is None:
            raise ValueError(f"CostModel: no stage {name!r}; known: {', '.join(self.seconds)}")
        seconds = sum(value * features.get(feature, 0.0) for feature, value in known.items())
        size = memory_of(name, features, self.device)
        if corrected:
            seconds *= self.correction(name)
            size = int(size * _mean_ratio(self.memory_ratios.get(name, [])))
        return Cost(seconds, size)

    def predict(
        self,
        particles: float,
        blocks: float,
        substeps: float,
        *,
        fields: int = 1,
        laws: Iterable[str] | str = "nacc",
        frames: int = 0,
        gaussians: float = 0.0,
        brittle: bool = False,
        composed_steps: float = 0.0,
        corrected: bool = True,
    ) -> Cost:
        """What a simulation costs.

        Args:
            particles: Material points on the grid, mean over the steps.
            blocks: Active blocks of 4^3 cells, mean over the steps.
            substeps: Steps of the grid.
            fields: Velocity fields; with more than one there is contact.
            laws: Laws of the materials, or the name of one of :data:`LAW_SETS`.
            frames: Frames that are saved; 0 for stepping alone.
            gaussians: Splats that are carried and saved.
            brittle: Whether cracks open and are repaired.
            composed_steps: Steps of the composable operators, among ``substeps``.
            corrected: Whether finished runs are heeded.
        """
        chosen = laws if isinstance(laws, str) and laws in LAW_SETS else law_set(_several(laws))
        features = stepping(
            particles, blocks, substeps, fields=fields, laws=chosen, composed_steps=composed_steps
        )
        features |= framing(frames, gaussians, particles, brittle=brittle)
        features |= {
            "start": 0.0,
            "points": particles,
            "gaussians": gaussians,
            "blocks_most": blocks,
        }
        return self.stage("simulate", features, corrected=corrected)

    def correction(self, name: str) -> float:
        """Factor that finished runs put on the seconds of a stage; 1 without any."""
        return _mean_ratio(self.ratios.get(name, []))

    # --- learning ---

    def learn(self, name: str, predicted: Cost, actual: Cost, *, crowded: bool = False) -> None:
        """Take over what a stage has cost, beside the prediction for that work, uncorrected.

        Args:
            name: The stage.
            predicted: By this model, uncorrected.
            actual: What it took.
            crowded: Whether others took the processors meanwhile: that it was slower than known
                says nothing then.
        """
        slow = crowded and actual.seconds > predicted.seconds * self.correction(name)
        for store, said, took in (
            (self.ratios, predicted.seconds, 0.0 if slow else actual.seconds),
            (self.memory_ratios, float(predicted.bytes), float(actual.bytes)),
        ):
            if said > 0.0 and took > 0.0 and math.isfinite(took / said):
                store.setdefault(name, []).append(took / said)
                del store[name][:-REMEMBERED]

    # --- keeping ---

    @classmethod
    def load(cls, device: torch.device | str, folder: Path | None = None) -> CostModel | None:
        """The stored model of this machine; None when there is none or it cannot be read."""
        path = model_path(device, folder)
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            model = cls._read(values)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            _log.warning("%s: not a calibration (%s); it is measured anew", path, error)
            return None
        return model if model.machine == machine_key(device) else None

    @classmethod
    def _read(cls, values: Any) -> CostModel:
        if values["format"] != FORMAT:
            raise ValueError(f"format {values['format']}, not {FORMAT}")
        model = cls(
            machine=dict(values["machine"]),
            seconds={name: _numbers(row) for name, row in values["seconds"].items()},
            made=str(values["made"]),
            probe_seconds=float(values["probe_seconds"]),
            errors=_numbers(values["errors"]),
            ratios={name: _ratios(row) for name, row in values["ratios"].items()},
            memory_ratios={name: _ratios(row) for name, row in values["memory_ratios"].items()},
        )
        if not model.seconds:
            raise ValueError("no stage in it")
        return model

    def save(self, device: torch.device | str, folder: Path | None = None) -> Path:
        """Store the model, atomically; a later one replaces it.

        Raises:
            RunError: The disk is full.
        """
        path = model_path(device, folder)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {"format": FORMAT} | dataclasses.asdict(self))
        return path


def stepping(
    particles: float,
    blocks: float,
    substeps: float,
    *,
    fields: int,
    laws: str,
    composed_steps: float = 0.0,
    shared: float = SHARED,
) -> dict[str, float]:
    """Features of moving matter over the grid; ``shared``: share of the blocks with contact."""
    resident = max(0.0, substeps - composed_steps)
    contact = resident * shared if fields > 1 else 0.0
    return {
        "steps": resident,
        f"point_steps_{laws}": resident * particles,
        "block_steps": resident * blocks,
        "contact_block_steps": contact * blocks,
        "composed_steps": composed_steps,
        "composed_point_steps": composed_steps * particles,
    }


def framing(
    frames: int, gaussians: float, particles: float, *, brittle: bool, broken: float = 1.0
) -> dict[str, float]:
    """Features of what each frame costs beside the steps: pieces, carrying, repair, saving.

    Args:
        frames: Frames.
        gaussians: Splats.
        particles: Material points.
        brittle: Whether cracks can open; each splat is cut once, so that this costs once.
        broken: Share of the frames in which something is broken.
    """
    cracked = 1.0 if brittle and frames and broken > 0.0 else 0.0
    return {
        "frames": float(frames),
        "frame_gaussians": frames * gaussians,
        "frame_points": frames * particles,
        "start_gaussians": gaussians if frames else 0.0,
        "cracked_gaussians": cracked * gaussians,
        "broken_frames": frames * broken if brittle else 0.0,
    }


def model_path(device: torch.device | str, folder: Path | None = None) -> Path:
    """File of the model of a device."""
    key = machine_key(device)
    name = key.get("gpu") or f"{key['processor']}_{key['threads']}"
    plain = re.sub(r"[^A-Za-z0-9]+", "_", str(name)).strip("_").lower()
    return (folder or cache_folder()) / f"cost_{key['device']}_{plain}.json"


def _several(laws: Iterable[str] | str) -> Iterable[str]:
    return [laws] if isinstance(laws, str) else laws


def _mean_ratio(ratios: list[float]) -> float:
    """Geometric mean with a weight for 1, bounded."""
    if not ratios:
        return 1.0
    weights = [FORGET**age for age in reversed(range(len(ratios)))]
    logs = sum(weight * math.log(r) for weight, r in zip(weights, ratios, strict=True))
    mean = logs / sum(weights) * len(ratios) / (len(ratios) + PRIOR)
    return min(max(math.exp(mean), CORRECTION[0]), CORRECTION[1])


def _numbers(values: Any) -> dict[str, float]:
    found = {str(name): float(value) for name, value in values.items()}
    if not all(math.isfinite(value) and value >= 0.0 for value in found.values()):
        raise ValueError("a cost is negative or not finite")
    return found


def _ratios(values: Any) -> list[float]:
    found = [float(value) for value in values]
    if not all(math.isfinite(value) and value > 0.0 for value in found):
        raise ValueError("a ratio is not positive")
    return found[-REMEMBERED:]


BYTES: dict[str, dict[str, dict[str, float]]] = {
    "cpu": {
        "reconstruct": {"start": 412e6, "source_pixels": 4.3, "splats_most": 1000.0},
        "isolate": {"start": 407e6, "splats": 264.0},
        "fill": {"start": 410e6, "voxels_most": 283.0, "inner_most": 2820.0},
        "texture": {"start": 567e6, "volume_most": 496.0},
        "simulate": {"start": 535e6, "gaussians": 1050.0, "points": 5300.0, "blocks_most": 6000.0},
        "render": {"start": 450e6, "gaussians": 688.0, "pixels": 674.0},
        "export": {"start": 450e6, "gaussians": 688.0},
    },
    "cuda": {
        "reconstruct": {"start": 150e6, "source_pixels": 16.0, "splats_most": 3000.0},
        "isolate": {"start": 256e6},
        "fill": {"start": 335e6, "inner_most": 1930.0},
        "texture": {"start": 570e6, "volume_most": 490.0},
        "simulate": {"start": 400e6, "points": 3270.0, "born": 2020.0},
        "render": {"start": 220e6, "gaussians": 1310.0, "pixels": 715.0},
        "export": {"start": 220e6, "gaussians": 1310.0},
    },
}
"""Fitted to shots of the gallery: what they take hangs on the work, not on the machine. ``cpu``: to
six at ``preview``, each in a process of its own (scripts/study/shots/plan.py --fit-memory);
residuals are 5 % in the median, 20 % at most. What those are too small to show is counted from the
tensors: training state of a splat (``splats_most``), the solver's buffers of a block
(``blocks_most``, gsfluent/ops/solver_buffers.py). ``cuda``: to ten at ``hero`` and the demo, 22 k
to 1.8 M points on an H200; the simulation is 23 % off at most when its shot is left out."""


def memory_of(stage: str, features: Mapping[str, float], device: str) -> int:
    """Most memory of a stage [bytes]."""
    rows = BYTES[device].get(stage, {})
    return int(sum(value * features.get(name, 0.0) for name, value in rows.items()))
