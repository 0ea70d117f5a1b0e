"""Hashed lattice noise: the same value at the same point for every resolution and plane."""

from __future__ import annotations

import numpy as np

__all__ = ["Cells", "cells", "fractal", "value_noise"]


def _hash(x: np.ndarray, y: np.ndarray, z: np.ndarray, seed: int) -> np.ndarray:
    """Well mixed uint32 of integer coordinates (multiply, fold, multiply)."""
    with np.errstate(over="ignore"):
        h = x.astype(np.uint32) * np.uint32(0x8DA6B343)
        h ^= y.astype(np.uint32) * np.uint32(0xD8163841)
        h ^= z.astype(np.uint32) * np.uint32(0xCB1AB31F)
        h ^= np.uint32((seed * 0x9E3779B1) & 0xFFFFFFFF)
        for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
            h ^= h >> np.uint32(shift)
            h *= np.uint32(factor)
        h ^= h >> np.uint32(16)
    return h


def _unit(h: np.ndarray) -> np.ndarray:
    return h.astype(np.float32) * np.float32(1.0 / 4294967296.0)


def value_noise(points: np.ndarray, frequency: float, seed: int) -> np.ndarray:
    """Smooth noise in -1..1 at points [n, 3] with features of size 1 / frequency."""
    scaled = points * frequency
    base = np.floor(scaled)
    t = (scaled - base).astype(np.float32)
    t = t * t * t * (t * (t * 6 - 15) + 10)
    corner = base.astype(np.int64)
    total = np.zeros(len(points), np.float32)
    for i, j, k in np.ndindex(2, 2, 2):
        value = _unit(_hash(corner[:, 0] + i, corner[:, 1] + j, corner[:, 2] + k, seed))
        weight = (t[:, 0] if i else 1 - t[:, 0]) * (t[:, 1] if j else 1 - t[:, 1])
        total += value * weight * (t[:, 2] if k else 1 - t[:, 2])
    return 2.0 * total - 1.0


def fractal(points: np.ndarray, frequency: float, seed: int, octaves: int = 3) -> np.ndarray:
    """Sum of octaves, each twice as fine and 0.55 as strong; about -1..1."""
    total = np.zeros(len(points), np.float32)
    gain, norm = 1.0, 0.0
    for octave in range(octaves):
        total += gain * value_noise(points, frequency * 2**octave, seed + 31 * octave)
        norm += gain
        gain *= 0.55
    scaled: np.ndarray = total * (1.6 / norm)
    return scaled


class Cells:
    """Nearest feature point of a jittered lattice (Worley 1996).

    Attributes:
        first: Distance to the nearest feature point [n], in lattice cells.
        second: Distance to the second nearest [n].
        key: Hash of the nearest feature's cell, uint32 [n].
        offset: Vector from the nearest feature to the point [n, 3], in cells.
    """

    def __init__(
        self, first: np.ndarray, second: np.ndarray, key: np.ndarray, offset: np.ndarray
    ) -> None:
        self.first, self.second, self.key, self.offset = first, second, key, offset

    def random(self, salt: int) -> np.ndarray:
        """Uniform number in 0..1 per point, the same for all points of one cell."""
        zero = np.zeros_like(self.key)
        return _unit(_hash(self.key, zero, zero, salt))


def cells(points: np.ndarray, frequency: float, seed: int, jitter: float = 0.8) -> Cells:
    """Find the nearest features around points [n, 3]."""
    scaled = (points * frequency).astype(np.float32)
    base = np.floor(scaled).astype(np.int64)
    count = len(points)
    first = np.full(count, np.inf, np.float32)
    second = np.full(count, np.inf, np.float32)
    key = np.zeros(count, np.uint32)
    offset = np.zeros((count, 3), np.float32)
    for shift in np.ndindex(3, 3, 3):
        cell = base + np.array(shift) - 1
        h = _hash(cell[:, 0], cell[:, 1], cell[:, 2], seed)
        place = np.stack(
            [_unit(_hash(h, h, np.full_like(h, axis), seed + 7)) for axis in range(3)], 1
        )
        delta = scaled - (cell + 0.5 + jitter * (place - 0.5)).astype(np.float32)
        distance = np.sqrt((delta * delta).sum(1))
        closer = distance < first
        second = np.where(closer, first, np.minimum(second, distance))
        first = np.where(closer, distance, first)
        key = np.where(closer, h, key)
        offset[closer] = delta[closer]
    return Cells(first, second, key, offset)
