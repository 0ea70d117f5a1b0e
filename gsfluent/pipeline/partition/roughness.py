"""Roughness of crack faces below the scale of the grid: a displacement hashed from the rest place.

Crack faces are self-affine: the height over a distance r goes as ``r^0.8``, on metals, glass, rock
and ceramics alike (Bouchaud 1997). Both sides of a crack ask for the same place and get the same
displacement, so that faces fit. Values lie on lattices of the voxels of the partition, one for each
octave, and are interpolated by smoothsteps along one axis after the other: one operation at a time,
so that every device rounds alike.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import ops

HURST = 0.8
"""Exponent of the structure function, from 2 to 12 voxels (four point spacings)."""
SPACINGS = (48.0, 24.0, 12.0, 6.0, 3.0, 1.5)
"""Lattices of the octaves, in voxels. Longer ones than 12 carry the law up to there."""
_WEIGHT = 0.97  # exponent of the octaves that gives 0.8: a finite band of them is flatter
_FAMILIES = {
    "fruit": 0.25, "bread": 0.4, "foam": 0.4, "snow": 0.4, "glass": 0.03, "ice": 0.03,
}  # fmt: skip
_OTHERS = 0.15
_POROUS = {"bread": 0.016, "foam": 0.016}  # a pore of 3 mm is a quarter darker than the crumb
_UNIFORM = 3.0**-0.5  # rms of what is uniform in -1 to 1
# mean of the square of a smoothstep blend of independent values, three axes
_BLEND = (2.0 * 13.0 / 35.0) ** 1.5


def amplitude(material: str) -> float:
    """Rms height of crack faces of a material, in point spacings, by the family of its preset.

    Args:
        material: Name of the preset; what stands before its first dot is the family.
    """
    return _FAMILIES.get(material.split(".")[0], _OTHERS)


def relief(material: str) -> float:
    """How much higher white matter stands than black on crack faces [m]: pores are dark pits.

    Args:
        material: Name of the preset; what stands before its first dot is the family.
    """
    return _POROUS.get(material.split(".")[0], 0.0)


def displacement(low: tuple[int, int, int], shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Unit displacements at the voxels of a box.

    Args:
        low: Index of the first voxel.
        shape: Voxels along each axis.
        device: Where.

    Returns:
        Vectors [3, X, Y, Z], each component with an rms of 1.
    """
    axes = [torch.arange(a, a + n, device=device) for a, n in zip(low, shape, strict=True)]
    return displacements(torch.cartesian_prod(*axes)).T.reshape(3, *shape)


def displacements(voxels: Tensor) -> Tensor:
    """Unit displacements at voxels, int64 [M, 3]: vectors [M, 3], float32."""
    weights = [spacing**_WEIGHT for spacing in SPACINGS]
    norm = sum(w * w for w in weights) ** 0.5 * _UNIFORM * _BLEND
    # lattices of different octaves have no plane in common
    shifts = [0.37 * (octave + 1) for octave in range(len(SPACINGS))]
    return ops.value_noise(voxels, SPACINGS, shifts, [weight / norm for weight in weights])
