"""The similarity transform between the coordinates of a capture and the metres of a scene."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True, eq=False)
class Frame:
    """``x_scene = scale * rotation @ x_world + translation``.

    Args:
        rotation: Proper rotation [3, 3], float64, CPU.
        translation: Translation [3] in target units, float64, CPU.
        scale: Target units per source unit, positive.

    Raises:
        ValueError: The rotation is not orthogonal with determinant one, or the scale is not
            positive and finite.
    """

    rotation: Tensor
    translation: Tensor
    scale: float

    def __post_init__(self) -> None:
        """Bring the parts to float64 on the CPU and check them."""
        rotation = torch.as_tensor(self.rotation).detach().to("cpu", torch.float64)
        translation = torch.as_tensor(self.translation).detach().to("cpu", torch.float64)
        scale = float(self.scale)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            got = f"{list(rotation.shape)} and {list(translation.shape)}"
            raise ValueError(f"Frame: rotation must be [3, 3] and translation [3], got {got}")
        error = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max())
        if not error < 1e-5 or not float(torch.linalg.det(rotation)) > 0:
            raise ValueError(
                f"Frame: rotation must be orthogonal with determinant 1, got error {error:.3g}"
            )
        if not (math.isfinite(scale) and scale > 0) or not bool(torch.isfinite(translation).all()):
            raise ValueError(
                f"Frame: scale must be positive and finite, got {scale}, {translation.tolist()}"
            )
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)
        object.__setattr__(self, "scale", scale)

    @staticmethod
    def identity() -> Frame:
        """Return the frame that changes nothing."""
        return Frame(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), 1.0)

    def apply(self, points: Tensor) -> Tensor:
        """Transform points [..., 3]; dtype and device are kept."""
        return self.scale * self.apply_vector(points) + self.translation.to(points)

    def apply_vector(self, vectors: Tensor) -> Tensor:
        """Rotate directions [..., 3] without scaling or moving them."""
        return vectors @ self.rotation.T.to(vectors)

    def inverse(self) -> Frame:
        """Return the frame that undoes this one."""
        rotation = self.rotation.T
        return Frame(rotation, -(rotation @ self.translation) / self.scale, 1.0 / self.scale)

    def compose(self, first: Frame) -> Frame:
        """Return the frame that applies ``first`` and then this one."""
        return Frame(
            self.rotation @ first.rotation, self.apply(first.translation), self.scale * first.scale
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
            "scale": self.scale,
        }

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Frame:
        """Inverse of :meth:`to_dict`."""
        rotation = torch.tensor(values["rotation"], dtype=torch.float64)
        return Frame(
            rotation,
            torch.tensor(values["translation"], dtype=torch.float64),
            float(values["scale"]),
        )
