"""Hashed lattice noise: the same value at the same point for every resolution and plane."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


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


def gradient_noise(points: np.ndarray, frequency: float, seed: int) -> np.ndarray:
    """Gradient noise (Perlin 2002) in about -1..1 at points [n, 3].

    Its zeros are smooth sheets without the lattice showing through: veins and fibres follow them.
    """
    scaled = (points * frequency).astype(np.float32)
    base = np.floor(scaled)
    t = scaled - base
    corner = base.astype(np.int32)
    fade = t * t * t * (t * (t * 6 - 15) + 10)
    total = np.zeros(len(points), np.float32)
    x, y, z = np.ascontiguousarray(corner.T)
    u, v, w = np.ascontiguousarray(t.T)
    share = [(1 - f, f) for f in fade.T]
    for i, j, k in np.ndindex(2, 2, 2):
        # four bits choose among the twelve directions from the middle of a cube to its edges
        which = _hash(x + i, y + j, z + k, seed) >> np.uint32(28)
        slope = _SLOPES[0].take(which) * (u - i)
        slope += _SLOPES[1].take(which) * (v - j)
        slope += _SLOPES[2].take(which) * (w - k)
        slope *= share[0][i] * share[1][j] * share[2][k]
        total += slope
    return total


_SLOPES = np.array(
    [
        [1, -1, 1, -1, 1, -1, 1, -1, 0, 0, 0, 0, 1, 0, -1, 0],
        [1, 1, -1, -1, 0, 0, 0, 0, 1, -1, 1, -1, 1, -1, 1, -1],
        [0, 0, 0, 0, 1, 1, -1, -1, 1, 1, -1, -1, 0, 1, 0, -1],
    ],
    np.float32,
)

# lattices lie askew: the middle planes of an object, where it is cut, must not be special ones.
# A turn between octaves also keeps the lattices of one seed from lying in line.
_TURN = np.array([[0.0, 0.8, 0.6], [-0.8, 0.36, -0.48], [-0.6, -0.48, 0.64]])


def _shift(seed: int) -> np.ndarray:
    """Somewhere in a lattice cell [3], another place for every seed."""
    return np.random.default_rng([abs(seed), 17]).random(3)


def fractal(points: np.ndarray, frequency: float, seed: int, octaves: int = 3) -> np.ndarray:
    """Sum of octaves of gradient noise, each twice as fine and 0.55 as strong; about -1..1."""
    total = np.zeros(len(points), np.float32)
    gain, norm = 1.0, 0.0
    points = points + _shift(seed) / frequency
    for octave in range(octaves):
        points = points @ _TURN
        total += gain * gradient_noise(points, frequency * 2**octave, seed + 31 * octave)
        norm += gain
        gain *= 0.55
    return total * (1.6 / norm)


_TEN = np.uint32(1023)


class Cells(NamedTuple):
    """Nearest feature point of a jittered lattice (Worley 1996).

    Attributes:
        first: Distance to the nearest feature point [n], in lattice cells.
        second: Distance to the second nearest [n].
        key: Hash of the nearest feature's cell, uint32 [n].
        offset: Vector from the nearest feature to the point [n, 3], in cells.
    """

    first: np.ndarray
    second: np.ndarray
    key: np.ndarray
    offset: np.ndarray

    def random(self, salt: int) -> np.ndarray:
        """Uniform number in 0..1 per point, the same for all points of one cell."""
        zero = np.zeros_like(self.key)
        return _unit(_hash(self.key, zero, zero, salt))


def cells(points: np.ndarray, frequency: float, seed: int, jitter: float = 0.8) -> Cells:
    """Find the nearest features around points [n, 3]."""
    turned = (points * frequency + _shift(seed)) @ _TURN
    scaled = np.ascontiguousarray(turned.T, dtype=np.float32)
    base = np.floor(scaled).astype(np.int32)
    # where the point is in its own cell, from that cell's middle
    local = scaled - base - np.float32(0.5)
    count = len(points)
    first = np.full(count, np.inf, np.float32)
    second = np.full(count, np.inf, np.float32)
    key = np.zeros(count, np.uint32)
    step = np.float32(jitter / 1024.0)
    middle = np.float32(0.5 * jitter)
    offset = np.zeros((3, count), np.float32)
    for shift in np.ndindex(3, 3, 3):
        near = base + np.array(shift, np.int32)[:, None] - np.int32(1)
        h = _hash(near[0], near[1], near[2], seed)
        # ten bits of the hash place the feature along each axis
        delta = [
            local[k]
            - (shift[k] - 1)
            + middle
            - ((h >> np.uint32(10 * k)) & _TEN).astype(np.float32) * step
            for k in range(3)
        ]
        distance = delta[0] * delta[0] + delta[1] * delta[1] + delta[2] * delta[2]
        closer = distance < first
        np.minimum(second, np.maximum(distance, first), out=second)
        np.minimum(first, distance, out=first)
        np.copyto(key, h, where=closer)
        for k in range(3):
            np.copyto(offset[k], delta[k], where=closer)
    np.sqrt(first, out=first)
    np.sqrt(second, out=second)
    offset = np.ascontiguousarray(offset.T) @ _TURN.T.astype(np.float32)
    return Cells(first, second, key, offset)
