"""Gaussian splats with activated values: what every stage takes and returns."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data._fields import TensorContainer, shape
from gsfluent.data.frame import Frame
from gsfluent.errors import InputError

SURFACE, INTERIOR, TRANSITION, BACKGROUND, SPRAY = 0, 1, 2, 3, 4
"""Values of ``Gaussians.labels``: where a splat came from. ``SPRAY`` is what flies as single grains
and drops, which is no body."""


@dataclasses.dataclass(frozen=True, eq=False)
class Gaussians(TensorContainer):
    """3D Gaussians in one coordinate frame. Row i is the same splat in every field.

    Args:
        means: Centres [N, 3], length units of the frame.
        quats: Orientations [N, 4], ``wxyz``; need not be normalised.
        scales: Standard deviations along the local axes [N, 3], length units, positive (not
            logarithms).
        opacities: Peak opacities [N] in 0..1 (not logits).
        sh: Spherical-harmonic colours [N, K, 3], K = (degree + 1)^2.
        labels: ``SURFACE``, ``INTERIOR``, ``TRANSITION``, ``BACKGROUND`` or ``SPRAY`` per splat,
            int32 [N], or None.
        normals: Unit surface normals [N, 3], or None.
        report: What the stage that made them measured, JSON values; files do not hold it.

    Raises:
        TypeError: A field is not a tensor or has the wrong dtype.
        ValueError: A shape or device does not match the others, or K is not a square.
    """

    means: Annotated[Tensor, shape("N", 3, unit="length")]
    quats: Annotated[Tensor, shape("N", 4)]
    scales: Annotated[Tensor, shape("N", 3, unit="length")]
    opacities: Annotated[Tensor, shape("N")]
    sh: Annotated[Tensor, shape("N", "K", 3)]
    labels: Annotated[Tensor, shape("N", kind="int")] | None = None
    normals: Annotated[Tensor, shape("N", 3)] | None = None
    report: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check shapes and the number of SH coefficients."""
        super().__post_init__()
        geometry.sh_degree(self.sh.shape[1])

    def __len__(self) -> int:
        """Return the number of splats."""
        return self.count

    @property
    def count(self) -> int:
        """Number of splats N."""
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return geometry.sh_degree(self.sh.shape[1])

    @property
    def device(self) -> torch.device:
        """Device of all fields."""
        return self.means.device

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the float fields."""
        return self.means.dtype

    def colors(self) -> Tensor:
        """Return the direction-independent colours [N, 3] (SH degree 0), cut at zero."""
        return geometry.sh0_to_rgb(self.sh[:, 0])

    def covariances(self) -> Tensor:
        """Return packed covariances [N, 6], ``xx, yy, zz, xy, xz, yz``."""
        return geometry.covariance(self.quats, self.scales)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Return the smallest and largest centre coordinates, each [3]."""
        if self.count == 0:
            raise InputError(
                "bounds: there must be at least one Gaussian, got 0", "check what was selected"
            )
        return self.means.amin(dim=0), self.means.amax(dim=0)

    @staticmethod
    def from_colors(
        means: Tensor,
        scales: Tensor,
        colors: Tensor,
        *,
        opacities: Tensor | float = 1.0,
        quats: Tensor | None = None,
        label: int | None = None,
    ) -> Gaussians:
        """Make direction-independent splats from colours.

        Args:
            means: Centres [N, 3].
            scales: Standard deviations [N, 3], or [N] for spheres.
            colors: RGB in 0..1, [N, 3].
            opacities: Peak opacities, [N] or one number.
            quats: Orientations [N, 4]; none means axis-aligned.
            label: One label for all rows.
        """
        count = means.shape[0]
        if scales.dim() == 1:
            scales = scales[:, None].expand(count, 3).contiguous()
        if quats is None:
            quats = means.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).contiguous()
        if not isinstance(opacities, Tensor):
            opacities = torch.full(
                (count,), float(opacities), dtype=means.dtype, device=means.device
            )
        labels = None if label is None else _filled(None, means, label)
        return Gaussians(
            means, quats, scales, opacities, geometry.rgb_to_sh0(colors)[:, None], labels
        )

    def with_colors(self, colors: Tensor) -> Gaussians:
        """Return a copy coloured ``colors`` [N, 3] from every direction; the SH degree is kept."""
        sh = torch.zeros_like(self.sh)
        sh[:, 0] = geometry.rgb_to_sh0(colors)
        return self.replace(sh=sh)

    def labelled(self, label: int) -> Gaussians:
        """Return a copy with one label for all rows."""
        return self.replace(labels=_filled(None, self.means, label))

    def with_sh_degree(self, degree: int) -> Gaussians:
        """Return a copy padded with zero coefficients, or cut, to SH ``degree``."""
        wanted, have = (degree + 1) ** 2, self.sh.shape[1]
        if wanted <= have:
            return self.replace(sh=self.sh[:, :wanted].contiguous())
        padding = self.sh.new_zeros(self.count, wanted - have, 3)
        return self.replace(sh=torch.cat([self.sh, padding], dim=1))

    def select(self, index: Tensor) -> Gaussians:
        """Return the rows picked by a bool mask [N] or an integer index [M]."""
        if index.dtype == torch.bool and tuple(index.shape) != (self.count,):
            raise ValueError(
                f"Gaussians.select: mask must have shape [{self.count}], got {list(index.shape)}"
            )
        return self.map(lambda value: value[index])

    @staticmethod
    def cat(parts: Sequence[Gaussians]) -> Gaussians:
        """Join rows. SH is padded to the highest degree; missing labels are ``SURFACE``.

        Raises:
            ValueError: ``parts`` is empty.
        """
        if not parts:
            raise ValueError("Gaussians.cat: parts must hold at least one Gaussians, got none")
        degree = max(part.sh_degree for part in parts)
        parts = [part.with_sh_degree(degree) for part in parts]
        labels = normals = None
        if any(part.labels is not None for part in parts):
            labels = torch.cat([_filled(part.labels, part.means, SURFACE) for part in parts])
        if any(part.normals is not None for part in parts):
            rows = [
                torch.zeros_like(part.means) if part.normals is None else part.normals
                for part in parts
            ]
            normals = torch.cat(rows)
        return Gaussians(
            torch.cat([part.means for part in parts]),
            torch.cat([part.quats for part in parts]),
            torch.cat([part.scales for part in parts]),
            torch.cat([part.opacities for part in parts]),
            torch.cat([part.sh for part in parts]),
            labels,
            normals,
        )

    def transformed(self, frame: Frame) -> Gaussians:
        """Return the splats in another frame: means, axes, sizes, normals and SH together."""
        turn = geometry.matrix_to_quaternion(frame.rotation).to(self.means)
        normals = None if self.normals is None else frame.apply_vector(self.normals)
        return self.replace(
            means=frame.apply(self.means),
            quats=geometry.quaternion_multiply(turn.expand_as(self.quats), self.quats),
            scales=self.scales * frame.scale,
            sh=geometry.rotate_sh(self.sh, frame.rotation),
            normals=normals,
        )

    def validated(self, source: str = "Gaussians") -> Gaussians:
        """Return self after checking values that no stage can work with.

        Args:
            source: What to call the input in the message, usually its file name.

        Raises:
            InputError: No rows; NaN or infinite values; a scale that is not positive; an opacity
                outside 0..1.
        """
        if self.count == 0:
            raise InputError(
                f"{source}: there must be at least one Gaussian, got 0",
                "check the file or selection",
            )
        hint = "remove these rows or export the splat again"
        for name in ("means", "quats", "scales", "opacities", "sh"):
            value = getattr(self, name)
            bad = ~torch.isfinite(value).reshape(self.count, -1).all(dim=1)
            _refuse(source, f"{name} must be finite", "NaN or infinite", bad, hint)
        _refuse(
            source,
            "scales must be positive",
            "zero or negative",
            (self.scales <= 0).any(dim=1),
            hint,
        )
        outside = (self.opacities < 0) | (self.opacities > 1)
        _refuse(
            source,
            "opacities must lie in 0..1",
            "outside",
            outside,
            "pass activated values, not logits",
        )
        return self


def _filled(labels: Tensor | None, means: Tensor, value: int) -> Tensor:
    """Return the labels, or a constant column where there are none."""
    if labels is not None:
        return labels
    return torch.full((means.shape[0],), value, dtype=torch.int32, device=means.device)


def _refuse(source: str, wanted: str, got: str, bad: Tensor, hint: str) -> None:
    """Raise for the rows where ``bad`` holds, naming their number and the first."""
    total = int(bad.sum())
    if total:
        first = int(bad.nonzero()[0])
        where = f"{total} of {bad.numel()} rows, first row {first}"
        raise InputError(f"{source}: {wanted}, got {got} in {where}", hint)
