"""A Taichi kernel that writes velocity gradients into a field of matrices (imports taichi)."""

# no `from __future__ import annotations`: taichi reads the annotations themselves
import taichi as ti


@ti.kernel
def set_affine(field: ti.template(), values: ti.types.ndarray()):  # type: ignore[valid-type,no-untyped-def]
    for p in range(values.shape[0]):
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                field[p][i, j] = values[p, i, j]
