"""Several ranks of the resident solver on CUDA: what each holds, and where.

See docs/theory/ranks.md.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent.errors import GsfluentError, InputError
from gsfluent.ops import solver_buffers as layout

MOST_RANKS = 64
"""``kMostRanks`` of ``csrc/host/solver.h``."""
VIEW_BYTES = 1024
"""``kViewBytes`` of it."""
MAIL_WORDS = 11
"""``kMailWords`` of ``csrc/core/solver/state.h``."""
PATIENCE = 60.0
"""Wall time without a finished step after which a device counts as stalled [s]."""

_POINTS_MORE, _HOMES_MORE, _A_FEW = 0.1, 0.25, 64
"""Room for more points and homes than a rank has now, in parts of them; and for so many."""
_MOVING = ("colliders", "collider_state", "impulse")
_STATIC = ("law", "rows", "sdf", "parent", "cut", "radius", "object")


def check_devices(devices: Sequence[str | torch.device], home: torch.device) -> list[torch.device]:
    """The devices of the ranks, one each, checked.

    Raises:
        InputError: One that is no CUDA device or not there; ``home``, where the points lie, is
            another GPU.
    """
    there = torch.cuda.device_count()
    found = []
    for name in devices:
        try:
            device = torch.device(name)
        except RuntimeError as error:
            raise InputError(
                f"Solver: devices: {name!r} is no device", hint='name them, as in "cuda:0"'
            ) from error
        if device.type != "cuda":
            raise InputError(
                f"Solver: devices must be CUDA devices, got {device}",
                hint="ranks=N cuts a scene on a CPU",
            )
        index = torch.cuda.current_device() if device.index is None else device.index
        if index >= there:
            raise InputError(
                f"Solver: devices: cuda:{index} is not there; this machine has {there}",
                hint="nvidia-smi lists them; CUDA_VISIBLE_DEVICES may hide some",
            )
        found.append(torch.device("cuda", index))
    if not found:
        raise InputError("Solver: devices is empty", hint="leave it out: one device does all")
    if len(found) > MOST_RANKS:
        raise InputError(
            f"Solver: devices: at most {MOST_RANKS}, got {len(found)}", hint="name fewer"
        )
    for name in ("PYTORCH_CUDA_ALLOC_CONF", "PYTORCH_ALLOC_CONF"):
        if len(set(found)) > 1 and "expandable_segments:true" in os.environ.get(name, "").lower():
            raise InputError(
                f"Solver: devices: {name} asks for expandable segments, which other devices cannot "
                "reach",
                hint=f"start without expandable_segments in {name}",
            )
    for device in found:
        for other in found:
            if device != other and not torch.cuda.can_device_access_peer(device, other):
                raise InputError(
                    f"Solver: devices: {device} cannot reach the memory of {other}",
                    hint="name devices that are linked; `nvidia-smi topo -p2p r` shows which",
                )
    if home.type != "cpu" and home not in found:
        raise InputError(
            f"Solver: the points lie on {home}, which is none of devices",
            hint=f"name it too, or move position and the others to {found[0]} or to the CPU",
        )
    return found


class Parts:
    """Buffers of every rank, on its device; those of all are the solver's own.

    Args:
        whole: Buffers of all, which get what only ranks need.
        devices: Device of each rank.
        fields: Velocity fields.
        widths: What is held of each point, and its components.
        ints, floats: Settings of the operators.
    """

    def __init__(
        self, whole: layout.Buffers, devices: Sequence[torch.device], fields: int,
        widths: dict[str, int], ints: list[int], floats: list[float],
    ) -> None:  # fmt: skip
        self.whole, self.devices, self.fields = whole, tuple(devices), fields
        self._settings, self._widths, self._count = (ints, floats), widths, ints[-1]
        self._equip(whole)
        self.parts = [self._part(device) for device in devices]

    def room(self, points: int) -> int:
        """Room for so many points of a rank and some more."""
        return min(self._count, _with_room(points, _POINTS_MORE))

    def reserve(self, homes: int, listed: Sequence[int]) -> None:
        """Room for blocks: of each rank for its share of all homes, and for those listed now."""
        share = _with_room(-(-homes // len(self.parts)), _HOMES_MORE)
        slots = self.whole.slot_next.shape[0]
        for part, own in zip(self.parts, listed, strict=True):
            part.reserve_blocks(max(share, own), slots, self.fields)
            part.clock[layout.INDEX["homes"]] = own

    def _equip(self, b: layout.Buffers) -> None:
        """Room for what ranks need beside the rest."""
        device = b.offset.device
        words = MAIL_WORDS + layout.IMPULSE_SUMS * self.whole.impulse.shape[0]
        b.mail = torch.zeros(words, dtype=torch.int64, device=device)
        room = VIEW_BYTES * (len(self.devices) + 1)
        b.peers = torch.zeros(room, dtype=torch.uint8, device=device)
        b.reserve_ranks()

    def _part(self, device: torch.device) -> layout.Buffers:
        """Buffers of a rank, without points and blocks."""
        whole = self.whole
        part = dataclasses.replace(whole)
        for field in dataclasses.fields(whole):
            value = getattr(whole, field.name)
            if field.name in _STATIC:
                new = value.to(device)
            elif field.name in (*_MOVING, "clock", "impulse_units", "spring_rows"):
                new = torch.zeros_like(value, device=device)
            else:
                new = value.new_zeros((0, *value.shape[1:]), device=device)
            setattr(part, field.name, new)
        self._equip(part)
        return part

    def _lists(self) -> tuple[list[Tensor], list[Tensor], list[int], list[float]]:
        """What the operators take: buffers of all, of one rank after the other, settings."""
        parts = [tensor for part in self.parts for tensor in part.listed()]
        return self.whole.listed(), parts, *self._settings

    def prime(self) -> None:
        """Begin a call: as ``solver_prime``, with what may have changed since the last one."""
        for part in self.parts:
            for name in _MOVING:
                getattr(part, name).copy_(getattr(self.whole, name))
            part.impulse_units.zero_()
        torch.ops.gsfluent.solver_prime_ranks(*self._lists())
        self._wait()

    def run(self, rounds: int, steps: int) -> None:
        """As ``solver_run``."""
        torch.ops.gsfluent.solver_run_ranks(*self._lists(), rounds, steps)
        self._wait()

    def _wait(self) -> None:
        """Wait for what was asked of the devices, as long as steps are finished.

        Raises:
            GsfluentError: A device failed, or none finished a step for :data:`PATIENCE`.
        """
        names = ", ".join(dict.fromkeys(str(device) for device in self.devices))
        home = self.whole.clock.device
        try:
            done = torch.cuda.Event()
            done.record(torch.cuda.current_stream(home))
            beside = torch.cuda.Stream(home)
            step, since = -1, time.monotonic()
            while not done.query():
                time.sleep(1e-4)
                if time.monotonic() - since < PATIENCE:
                    continue
                with torch.cuda.stream(beside):  # past what waits in the other one
                    now = int(self.whole.clock[layout.INDEX["step"]].cpu())
                if now == step:
                    raise GsfluentError(
                        f"solver: no step on {names} was finished in {PATIENCE:g} s\n"
                        "  hint: nvidia-smi shows which of them hangs; start anew without it"
                    )
                step, since = now, time.monotonic()
        except RuntimeError as error:
            raise GsfluentError(
                f"solver: one of {names} failed: {error}\n"
                "  hint: nvidia-smi and dmesg show which and why; start anew without it"
            ) from error

    def grow(self) -> None:
        """Make room on every rank: for as many blocks as ``whole``, and for what the rank wants."""
        slots, table = self.whole.slot_next.shape[0], self.whole.key.shape[0]
        for part in self.parts:
            clock = part.clock.cpu()
            points, homes = (int(clock[layout.INDEX[name]]) for name in ("cursor", "wanted_homes"))
            room = part.home_start0.shape[0]
            if points > part.id.numel():
                part.reserve_points(self._widths, self.room(points))
            if homes > room and points > 0:  # else it is the table of blocks that was full
                room = _with_room(homes, _HOMES_MORE)
            if (room, slots, table) != (
                part.home_start0.shape[0], part.slot_next.shape[0], part.key.shape[0]
            ):  # fmt: skip
                part.reserve_blocks(room, slots, self.fields)
            part.clock[layout.INDEX["grow"]] = 0

    def memory(self) -> int:
        """Return the bytes of all tensors of the ranks."""
        return sum(part.memory() for part in self.parts)

    def counts(self) -> list[dict[str, int]]:
        """Points, homes, slots and shared slots of each rank."""
        rows = []
        for rank, part in enumerate(self.parts):
            clock = part.clock.cpu()
            points, homes, slots = (
                int(clock[layout.INDEX[name]]) for name in ("cursor", "homes", "slots")
            )
            holders = part.holders[part.table_count[:slots].long()]
            shared = int((holders != torch.ones_like(holders) << rank).sum())
            rows.append({"points": points, "homes": homes, "slots": slots, "shared": shared})
        return rows


def _with_room(count: int, more: float) -> int:
    """So many, and room for some more."""
    return count + int(more * count) + _A_FEW
