"""The study of fits to tracks: its bodies, and its table from records."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from loaded_scripts import load_script


def record(number: int, error: float, sd: float) -> dict[str, Any]:
    row = {"name": "young_modulus", "error": error, "sd": sd, "grid": 0.0, "unidentified": False,
           "truth": 1e5}  # fmt: skip
    return {"kind": "elastic", "scene": number, "cells": 6, "rows": [row], "rms_mm": 2.0,
            "fit_seconds": 9.0, "runs": [40, 5]}  # fmt: skip


def test_the_table_counts_bands_that_hold() -> None:
    study = load_script("study/fit/tracks")
    made = study.table([record(0, 0.03, 0.03), record(1, -0.05, 0.03)])
    assert "| elastic | log10 E | 2 | 0.04 | 0.02 | 0.189 | 0.087 | 1 of 2 | 0 |" in made
    assert "hold 1 of 2 numbers (50%;" in made and "40 runs on the coarser grid, 5 on" in made


def test_bodies_have_the_volume_and_the_speed_that_is_asked_for() -> None:
    study = load_script("study/fit/tracks")
    half = np.array([0.15, 0.15, 0.12])
    solid = study.ellipsoid(half)
    assert solid.volume == pytest.approx(4 / 3 * math.pi * float(half.prod()), rel=0.01)
    for kind in study.KINDS.values():
        scene = study.scene_of(kind, solid, kind.start, np.array([0, 0, -2.0]))
        assert scene.bodies[0].velocity == (0.0, 0.0, -2.0)
        assert scene.bodies[0].material.law == kind.law
