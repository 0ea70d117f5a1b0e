"""Material points: the state that the simulation advances."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any

import torch
from torch import Tensor

from gsfluent.data._fields import TensorContainer, shape
from gsfluent.errors import InputError


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Particles(TensorContainer):
    """Material points in the scene frame, SI units. Row i is the same point in every field.

    Args:
        position: Positions x [m], [N, 3].
        velocity: Velocities v [m/s], [N, 3].
        affine: APIC matrices C [1/s], [N, 3, 3].
        strain: Elastic strain e = b - I, [N, 6] in the order ``xx, yy, zz, xy, xz, yz``.
        alpha: Log plastic volume ratio [N]; negative is intact, growing towards 0 and above is
            softened.
        mass: Masses [kg], [N].
        volume: Initial volumes [m^3], [N].
        body: Velocity field (contact body) of each point, int32 [N].
        material: Row of the material table of each point, int32 [N].
        deformation: Total deformation gradient F since the start, [N, 3, 3]; None when nobody draws
            it.
        viscous: Viscosity of each solid point, [N, 9] (:func:`gsfluent.ops.viscous_step`); None
            where nothing is viscous.
    """

    position: Annotated[Tensor, shape("N", 3, unit="m")]
    velocity: Annotated[Tensor, shape("N", 3, unit="m/s")]
    affine: Annotated[Tensor, shape("N", 3, 3, unit="1/s")]
    strain: Annotated[Tensor, shape("N", 6)]
    alpha: Annotated[Tensor, shape("N")]
    mass: Annotated[Tensor, shape("N", unit="kg")]
    volume: Annotated[Tensor, shape("N", unit="m^3")]
    body: Annotated[Tensor, shape("N", kind="int")]
    material: Annotated[Tensor, shape("N", kind="int")]
    deformation: Annotated[Tensor, shape("N", 3, 3)] | None = None
    viscous: Annotated[Tensor, shape("N", 9)] | None = None

    @staticmethod
    def at_rest(
        position: Tensor,
        *,
        mass: Tensor,
        volume: Tensor,
        velocity: Tensor | Sequence[float] = (0.0, 0.0, 0.0),
        alpha: Tensor | float = 0.0,
        body: Tensor | int = 0,
        material: Tensor | int = 0,
        deformation: bool = True,
    ) -> Particles:
        """Make undeformed points.

        Args:
            position: Positions [m], [N, 3]; its dtype and device are those of the result.
            mass: Masses [kg], [N].
            volume: Volumes [m^3], [N].
            velocity: Velocity [m/s], [3] or [N, 3].
            alpha: Initial log plastic volume ratio, one number or [N].
            body: Contact body, one number or int32 [N].
            material: Material row, one number or int32 [N].
            deformation: Whether to carry the total deformation gradient.
        """
        count = position.shape[0]
        like: dict[str, Any] = {"dtype": position.dtype, "device": position.device}

        def column(value: Tensor | int) -> Tensor:
            whole = torch.as_tensor(value, dtype=torch.int32, device=position.device)
            return whole.expand(count).contiguous()

        identity = torch.eye(3, **like).expand(count, 3, 3).contiguous() if deformation else None
        return Particles(
            position=position,
            velocity=torch.as_tensor(velocity, **like).expand(count, 3).contiguous(),
            affine=position.new_zeros(count, 3, 3),
            strain=position.new_zeros(count, 6),
            alpha=torch.as_tensor(alpha, **like).expand(count).contiguous(),
            mass=mass,
            volume=volume,
            body=column(body),
            material=column(material),
            deformation=identity,
        )

    def __len__(self) -> int:
        """Return the number of points."""
        return self.count

    @property
    def count(self) -> int:
        """Number of points N."""
        return int(self.position.shape[0])

    @property
    def device(self) -> torch.device:
        """Device of all fields."""
        return self.position.device

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the float fields."""
        return self.position.dtype

    def select(self, index: Tensor) -> Particles:
        """Return the rows picked by a bool mask [N] or an integer index [M]."""
        return self.map(lambda value: value[index])

    def unstrained(self, rows: Tensor) -> Particles:
        """The points, of which those of ``rows`` (bool [N] or int [M]) have no elastic strain."""
        index = rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows
        viscous = self.viscous
        if viscous is not None:
            springs = viscous[:, :6].index_fill(0, index, 0.0)
            viscous = torch.cat([springs, viscous[:, 6:]], dim=1)
        return self.replace(strain=self.strain.index_fill(0, index, 0.0), viscous=viscous)

    @staticmethod
    def cat(parts: Sequence[Particles]) -> Particles:
        """Join rows; ``deformation`` must be present in all parts or in none.

        Where one part has a ``viscous``, the points of the others get one of zeros.

        Raises:
            ValueError: ``parts`` is empty or only some carry a deformation.
        """
        if not parts:
            raise ValueError("Particles.cat: parts must hold at least one Particles, got none")
        carried = [part.deformation for part in parts if part.deformation is not None]
        if carried and len(carried) != len(parts):
            raise ValueError("Particles.cat: deformation must be present in all parts or none")
        optional = ("deformation", "viscous")
        names = [f.name for f in dataclasses.fields(Particles) if f.name not in optional]
        joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
        viscous = None
        if any(part.viscous is not None for part in parts):
            viscous = torch.cat([
                part.strain.new_zeros(part.count, 9) if part.viscous is None else part.viscous
                for part in parts
            ])  # fmt: skip
        return Particles(
            **joined, deformation=torch.cat(carried) if carried else None, viscous=viscous
        )

    def validated(self, source: str = "Particles") -> Particles:
        """Return self after checking for rows that are finite and have positive mass and volume.

        Raises:
            InputError: Otherwise, with the number of bad rows and the first of them.
        """
        if self.count == 0:
            raise InputError(
                f"{source}: there must be at least one particle, got 0", "check the filled solid"
            )
        for name in ("position", "velocity", "affine", "strain", "alpha", "mass", "volume"):
            value = getattr(self, name).reshape(self.count, -1)
            good = torch.isfinite(value).all(dim=1)
            if name in ("mass", "volume"):
                good &= value[:, 0] > 0
            if not bool(good.all()):
                first, total = int((~good).nonzero()[0]), int((~good).sum())
                wanted = "finite and positive" if name in ("mass", "volume") else "finite"
                where = f"{total} of {self.count} rows, first row {first}"
                raise InputError(
                    f"{source}: {name} must be {wanted}, got otherwise in {where}",
                    "correct these rows",
                )
        return self
