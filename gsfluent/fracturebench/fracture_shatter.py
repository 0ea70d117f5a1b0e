"""Case ``shatter``: a brittle ball thrown on a plane breaks into pieces."""

from __future__ import annotations

import numpy as np

from .elastic import ball
from .fracture_rows import brittle, levels, shape_noise, wave
from .scene import Scene

import os
RADIUS = 0.05
SPEED = float(os.environ.get("SP", 0.1))
STRENGTH = float(os.environ.get("ST", 0.01))
SOFT = float(os.environ.get("SO", 0.004))
CO = float(os.environ.get("CO", 0.3))
FR = float(os.environ.get("FR", 2.0))
LEN = float(os.environ.get("LEN", 0.5))
AMP = float(os.environ.get("AMP", 0.3))
END = float(os.environ.get("END", 20))

def shatter(dx: float, per_cell: int) -> Scene:
    """Brittle ball thrown on a plane: statistics of its pieces."""
    points = ball(RADIUS, dx, per_cell)
    row = brittle(
        1e6, 0.2, 1000.0, friction=FR, cohesion=CO, strength=STRENGTH, softening=SOFT,
        energy=0.1, dx=dx, reference=RADIUS / 4.0, shear_damage=float(os.environ.get("SD", 0.0)),
    )
    noise = shape_noise(points, LEN*RADIUS, 3)
    rows, index = levels(row, np.clip(1.0 + AMP * noise, 0.3, 1.7))
    c = wave(row)
    n = points.shape[0]
    velocity = np.zeros_like(points)
    velocity[:, 2] = -SPEED * c
    times = np.linspace(0.0, END * RADIUS / c, 41)[1:]
    return Scene(
        name="shatter", dx=dx, x=points, v=velocity, volume=np.full(n, dx**3 / per_cell),
        material=index, body=np.zeros(n, np.int32), affine=np.zeros((n, 3, 3)), times=times,
        materials=rows,
        colliders=({"point": [0.0, 0.0, -RADIUS], "normal": [0.0, 0.0, 1.0], "kind": "separate", "friction": 0.3},),
    )
