"""Fronts: which runs no other run of a method beats, and one method's front against another's."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence

from gsfluent.lab.charts.record import Record

NO_ANSWER = 1.0
"""Errors of the cases are relative: at 1 a run knows as much as one that says nothing, and such a
level is not reached."""
ROUND_OFF = 1e-6
"""Errors below this are what rounding leaves of an exact answer, and count as equal."""


@dataclasses.dataclass(frozen=True)
class Versus:
    """One error level of a peer's front against our cheapest run that is at least as good."""

    case: str  # the case
    peer: Record  # the peer's run
    # our cheapest run of at most the peer's error; None where we reach no such error
    ours: Record | None
    ratio: float | None  # peer's time over ours; None likewise

    @property
    def below_left(self) -> bool:
        """Whether we are at least as good for no more time."""
        return self.ratio is not None and self.ratio >= 1.0


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What all levels say together."""

    rows: tuple[Versus, ...]  # by case and peer; a peer without any level has none
    # pairs (case, peer) that were run and reach no level, with the reason
    absent: tuple[tuple[str, str, str], ...]

    @property
    def below_left(self) -> bool:
        """Whether our front is below and left of every peer's at every level that one reaches.

        False where there is nothing to compare.
        """
        return bool(self.rows) and all(row.below_left for row in self.rows)

    def text(self) -> str:
        """The verdict in a sentence."""
        if not self.rows:
            return "No peer reaches an error level on any case: nothing to compare."
        lost = [row for row in self.rows if not row.below_left]
        pairs = {(row.case, row.peer.method) for row in self.rows}
        ratios = sorted(row.ratio for row in self.rows if row.ratio is not None)
        count = f"{len(self.rows)} error levels of {len(pairs)} fronts"
        if not lost:
            return (
                f"At all {count} that peers reach gsfluent is at least as good for less time: "
                f"{ratios[0]:.3g} to {ratios[-1]:.3g} times cheaper, "
                f"median {ratios[len(ratios) // 2]:.3g}."
            )
        where = "; ".join(
            f"{row.case}, {row.peer.method} at {row.peer.error:.2g}"
            + (": not reached" if row.ratio is None else f": {row.ratio:.2g} times")
            for row in lost
        )
        return f"At {len(self.rows) - len(lost)} of {count} gsfluent is cheaper; not at: {where}."


def cases(records: Iterable[Record]) -> list[str]:
    """Names of the cases in the order of their first record; the machine's own lines left out."""
    return list(dict.fromkeys(r.case for r in records if r.kind != "machine"))


def methods(records: Iterable[Record], ours: str = "gsfluent") -> list[str]:
    """Names of the methods, ours first, the others in the order of their first record."""
    found = dict.fromkeys(r.method for r in records if r.kind != "machine")
    return [m for m in (ours,) if m in found] + [m for m in found if m != ours]


def counted(record: Record) -> float:
    """A run's error as it counts: at least :data:`ROUND_OFF`."""
    return max(record.error, ROUND_OFF)


def front(
    records: Iterable[Record], cost: Callable[[Record], float] = lambda r: r.wall_per_simulated
) -> list[Record]:
    """Runs that no other one beats in both time and error, from cheap and rough to dear and good.

    Runs that broke off, errors of :data:`NO_ANSWER` or more, and runs that are there to differ in
    time only (``settings["trades"]`` false) are on no front.
    """
    good = [r for r in _counting(records) if r.error < NO_ANSWER]
    kept: list[Record] = []
    for record in sorted(good, key=lambda r: (cost(r), counted(r))):
        if not kept or counted(record) < counted(kept[-1]):
            kept.append(record)
    return kept


def _counting(records: Iterable[Record]) -> list[Record]:
    return [r for r in records if r.ok and r.settings.get("trades", True)]


def cheapest(records: Iterable[Record], error: float) -> Record | None:
    """The cheapest run of at most this error, or None."""
    good = [r for r in _counting(records) if counted(r) <= max(error, ROUND_OFF)]
    return min(good, key=lambda r: r.wall_per_simulated, default=None)


def compare(records: Sequence[Record], ours: str, peer: str) -> dict[str, list[Versus]]:
    """At every error level that a peer reaches: our cheapest time, and the ratio.

    Returns:
        By case that both ran; an empty list where the peer reaches no level.
    """
    result: dict[str, list[Versus]] = {}
    for case in cases(records):
        mine = [r for r in records if r.case == case and r.method == ours]
        theirs = [r for r in records if r.case == case and r.method == peer]
        if not mine or not theirs:
            continue
        rows = []
        for level in front(theirs):
            best = cheapest(mine, level.error)
            ratio = None if best is None else level.wall_per_simulated / best.wall_per_simulated
            rows.append(Versus(case, level, best, ratio))
        result[case] = rows
    return result


def verdict(records: Sequence[Record], ours: str = "gsfluent") -> Verdict:
    """Compare our front with every peer's on every case."""
    rows: list[Versus] = []
    absent = []
    for peer in methods(records, ours):
        if peer == ours:
            continue
        for case, levels in compare(records, ours, peer).items():
            rows += levels
            if not levels:
                absent.append((case, peer, _why(records, case, peer)))
    return Verdict(tuple(rows), tuple(absent))


def _why(records: Iterable[Record], case: str, peer: str) -> str:
    theirs = [r for r in records if r.case == case and r.method == peer]
    through = [r for r in theirs if r.ok]
    if through:
        return f"smallest error {min(r.error for r in through):.3g}"
    return f"all {len(theirs)} runs broke off: {theirs[0].failed}"
