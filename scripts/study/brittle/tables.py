"""Tables and the figure of ``scripts/study/brittle/run.py``, from its records."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from gsfluent.figure.style import COLORS, INK, OURS, new_figure, save_png
from gsfluent.lab.peers.known import POINTS

Record = dict[str, Any]
NAMES = {
    "fixed_explicit": "fixed centre, explicit (CD-MPM)",
    "released_explicit": "fixed centre, explicit (GaussianFluent's code)",
    "fixed_implicit": "fixed centre, implicit",
    "dynamic_explicit": "dynamic centre, explicit (the paper's Eq. 6)",
    "dynamic_implicit": "dynamic centre, implicit (gsfluent's map)",
    "elastic": "elastic, no yielding",
    "gsfluent": "gsfluent's solver",
}
ORDERS = {
    "atomics": "real atomics",
    "plain": "shuffled every step",
    "sorted": "sorted",
    "float64": "float64 sums",
    "fixed": "fixed point",
}


def method(r: Record) -> str:
    if r["variant"].get("gsfluent"):
        return "gsfluent"
    return "elastic" if r["scene"] == "rubber" else str(r["variant"]["return_map"])


def order(r: Record) -> str:
    if r["variant"].get("gsfluent"):
        return "fixed"
    sums = str(r["variant"]["sums"])
    return "atomics" if r["atomics"] and sums == "plain" else sums


def table(head: list[str], rows: Iterable[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: float) -> str:
    return "0" if value == 0.0 else f"{value:.1e}"


def order_table(found: list[Record], device: str) -> str:
    own = [r for r in found if r["part"] == "order" and r["device"] == device]
    columns = [
        (o, d)
        for o in ORDERS
        for d in ("float32", "float64")
        if any(order(r) == o and r["dtype"] == d for r in own)
    ]
    rows = []
    for name in NAMES:
        mine = [r for r in own if method(r) == name]
        if not mine:
            continue
        cells = []
        for o, d in columns:
            cell = [r for r in mine if order(r) == o and r["dtype"] == d]
            cells.append(f"{number(cell[0]['rms'])}, {number(cell[0]['alpha'])}" if cell else "")
        broken = f"{100 * mine[0]['broken']:.0f} %" if name != "elastic" else ""
        rows.append([NAMES[name], broken, *cells])
    return table(["map", "broken", *(f"{ORDERS[o]}, {d}" for o, d in columns)], rows)


def born(some: list[Record]) -> str:
    stages = sorted({str(r["birth"]["stage"]) for r in some if r["birth"]})
    return ", ".join(stages)


def between(steps: list[int]) -> str:
    low, high = min(steps), max(steps)
    return f"step {low}" if low == high else f"step {low} to {high}"


def share(some: list[Record]) -> str:
    dead = [r for r in some if r["birth"]]
    text = f"{len(dead)} of {len(some)}"
    if dead:
        text += f" ({born(dead)}, {between([int(r['birth']['step']) for r in dead])})"
    wrong = [r for r in some if not r["birth"] and r.get("violation")]
    if wrong:
        kinds = ", ".join(sorted({str(r["violation"]["kind"]) for r in wrong}))
        text += f" + {len(wrong)} finite but wrong ({kinds}, "
        text += f"{between([int(r['violation']['step']) for r in wrong])})"
    return text


def factor_table(found: list[Record]) -> str:
    """Runs with NaN over the levels of every factor, by part."""
    variant: Callable[[str], Callable[[Record], Any]] = lambda k: lambda r: r["variant"].get(k)  # noqa: E731
    parts: list[tuple[str, str, list[tuple[str, Callable[[Record], Any]]]]] = [
        ("division", "half", [
            ("division", variant("guarded")), ("map", variant("return_map")),
            ("sums", lambda r: r["variant"].get("sums", "plain")),
            ("precision", lambda r: r["dtype"]),
        ]),
        ("division", "drop", [
            ("division", variant("guarded")), ("map", variant("return_map")),
            ("sums", variant("sums")), ("precision", lambda r: r["dtype"]),
        ]),
        ("inversion", "drop", [
            ("speed over wave speed", lambda r: r["mach"]), ("map", variant("return_map")),
            ("storage", variant("storage")), ("clamp", variant("clamp")),
        ]),
        ("bug", "drop", [
            ("claymore's pressure", variant("energy_as_pressure")), ("map", variant("return_map")),
            ("storage", variant("storage")), ("clamp", variant("clamp")),
            ("sums", variant("sums")), ("precision", lambda r: r["dtype"]),
        ]),
    ]  # fmt: skip
    says = {
        ("division", "half"): "points at (n + 1/2) dx",
        ("division", "drop"): "ball on a floor, 40 steps",
        ("inversion", "drop"): "fast impact, step without the speed",
        ("bug", "drop"): "energy in place of pressure",
    }
    words = {"True": "guarded", "False": "unguarded"}
    rows = []
    for part, scene, factors in parts:
        own = [r for r in found if r["part"] == part and r["scene"] == scene]
        # claymore's bug kills whatever else is chosen: the other factors are judged within it
        for name, level in factors:
            some = own
            if name != factors[0][0] and part in ("division", "bug"):
                bad = part == "bug"
                some = [r for r in own if factors[0][1](r) is bad]
            if part == "inversion" and name != factors[0][0]:
                some = [r for r in own if r["mach"] >= 2.0]
            levels = sorted({str(level(r)) for r in some})
            cells = []
            for v in levels:
                label = words.get(v, v) if name == "division" else v
                label = {"None": "none"}.get(label, label)
                if name == "claymore's pressure":
                    label = {"True": "yes", "False": "no"}[v]
                cells.append(f"{label}: {share([r for r in some if str(level(r)) == v])}")
            rows.append([says[part, scene], name, "; ".join(cells)])
    return table(["scene", "factor", "runs with NaN at each level (born in, at)"], rows)


def ejecta_table(found: list[Record]) -> str:
    own = [r for r in found if r["part"] == "ejecta"]
    rows = []
    for device in ("cpu", "cuda"):
        for name in NAMES:
            for guarded in (False, True):
                for dtype in ("float32", "float64"):
                    some = [
                        r for r in own
                        if r["device"] == device and method(r) == name and r["dtype"] == dtype
                        and r["variant"]["guarded"] is guarded
                    ]  # fmt: skip
                    if not some:
                        continue
                    alone = sum(bool(r["birth"]["alone"]) for r in some if r["birth"])
                    broken = statistics.fmean(r["broken"] for r in some)
                    rows.append([
                        device, NAMES[name], dtype, "guarded" if guarded else "unguarded",
                        f"{100 * broken:.0f} %", share(some), str(alone),
                        f"{sum(r['exposure'] for r in some):.1g}",
                    ])  # fmt: skip
    head = ["device", "map", "precision", "division", "broken", "runs with NaN",
            "of a point alone", "0 / 0 expected in these runs, were they unguarded"]  # fmt: skip
    return table(head, rows)


def debris_table(found: list[Record]) -> str:
    own = [r for r in found if r["part"] == "debris"]
    kinds: dict[tuple[Any, ...], list[Record]] = {}
    for r in own:
        v = r["variant"]
        key = (
            r["device"], r["dtype"], bool(v.get("local_positions")), bool(v["guarded"]),
            v.get("sums", "plain"), r["away"],
        )  # fmt: skip
        kinds.setdefault(key, []).append(r)
    rows = []
    for (device, dtype, local, guarded, sums, away), some in kinds.items():
        wanted = 1.0 / statistics.fmean(r["rate"] for r in some)
        steps = [r["taken"] for r in some]
        dead = sum(bool(r["birth"]) for r in some)
        # of waiting times cut off at the end of the run: all steps made over the deaths seen
        mean = f"{sum(steps) / dead:.0f}" if dead else f"none in {sum(steps)} steps"
        rows.append([
            device, f"{dtype}{', cell and offset' if local else ''}",
            "guarded" if guarded else "unguarded", sums, f"{away:g}", f"{dead} of {len(some)}",
            "never" if guarded else f"{wanted:.3g}", mean,
        ])  # fmt: skip
    return table(
        ["device", "positions", "division", "sums", "from origin, dx", "runs with NaN",
         "steps to it, expected", "measured"], rows,
    )  # fmt: skip


def dt_table(found: list[Record]) -> str:
    own = [r for r in found if r["part"] == "dt"]
    rows = []
    for name in NAMES:
        mine = sorted((r for r in own if method(r) == name), key=lambda r: -r["dt"])
        if mine:
            broken = " / ".join(f"{100 * r['broken']:.1f}" for r in mine)
            rows.append([
                NAMES[name], "" if name == "elastic" else broken,
                " / ".join(f"{r['kinetic']:.3f}" for r in mine),
            ])  # fmt: skip
    return table(["map", "broken, %, at dt / dt/2 / dt/4", "kinetic energy over the start"], rows)


def known_table(found: list[Record]) -> str:
    rows = []
    for point in POINTS:
        mine = [r for r in found if r["part"] == "known" and r["scene"] == point.name]
        if not mine:
            continue
        value, sound = (
            "NaN" if mine[-1][k] is None else f"{mine[-1][k]:.3g}" for k in ("value", "sound")
        )
        said = "" if point.reported is None else f"{point.reported:g}"
        seen = "yes" if mine[-1]["failing"] else "no"
        at = ", ".join(f"{k} {v:.3g}" for k, v in point.parameters.items())
        rows.append([
            point.name, point.failure + (f" ({at})" if at else ""), point.quantity, value, said,
            sound, seen,
        ])  # fmt: skip
    head = ["point", "failure", "measured", "with it", "reported", "without", "seen"]
    return table(head, rows)


def tables(found: list[Record]) -> dict[str, str]:
    """Markers of docs/measured/brittle_gpu.md and what stands between them."""
    made: dict[str, str] = {}
    for device in ("cpu", "cuda"):
        if any(r["part"] == "order" and r["device"] == device for r in found):
            made[f"brittle order {device}"] = order_table(found, device)
    cpu = [r for r in found if r["device"] == "cpu"]
    if any(r["part"] in ("division", "inversion", "bug") for r in cpu):
        made["brittle factors"] = factor_table(cpu)
    if any(r["part"] == "ejecta" for r in found):
        made["brittle ejecta"] = ejecta_table(found)
    if any(r["part"] == "debris" for r in found):
        made["brittle debris"] = debris_table(found)
    if any(r["part"] == "dt" for r in cpu):
        made["brittle dt"] = dt_table(cpu)
    if any(r["part"] == "known" for r in found):
        made["brittle known"] = known_table(found)
    return made


def draw(found: list[Record], path: Path) -> None:
    """Growth of the distance between two runs, and where it ends for every order of sums."""
    own = [r for r in found if r["part"] == "order" and r["device"] == "cpu"]
    colours = dict(zip(list(NAMES)[:4], COLORS, strict=False))
    colours |= {"dynamic_implicit": OURS, "elastic": "#999999", "gsfluent": INK}
    with new_figure(9.6, 4.6) as figure:
        left, right = figure.subplots(1, 2, width_ratios=[3, 2])
        for r in own:
            if order(r) != "plain" or "growth" not in r:
                continue
            steps = [4 * (i + 1) for i in range(len(r["growth"]))]
            single = r["dtype"] == "float32"
            left.plot(
                steps, [max(g, 1e-16) for g in r["growth"]], color=colours[method(r)],
                linestyle="-" if single else "--", linewidth=1.6,
                label=NAMES[method(r)] if single else None,
            )  # fmt: skip
        left.set_yscale("log")
        left.set_ylim(1e-16, 1.0)
        left.set_xlabel("step")
        left.set_ylabel("distance of two orders of summation, rms [dx]")
        left.set_title("Same ball, same code, other order (full float32, dashed float64)")
        places = [o for o in ORDERS if any(order(r) == o for r in own)]
        for r in own:
            if r["dtype"] != "float32":
                continue
            at = places.index(order(r)) + 0.11 * (list(NAMES).index(method(r)) - 3)
            zero = r["rms"] == 0.0
            right.plot(
                at, 1e-9 if zero else r["rms"], marker="v" if zero else "o", markersize=6,
                color=colours[method(r)], linestyle="none",
            )  # fmt: skip
        right.set_yscale("log")
        right.set_ylim(3e-10, 1.0)
        right.set_xticks(range(len(places)), [ORDERS[p].replace(" ", "\n", 1) for p in places])
        right.set_title("After 80 steps, float32 (triangle: exactly 0)")
        right.plot([], [], marker="v", color=INK, linestyle="none", label=NAMES["gsfluent"])
        figure.legend(loc="outside lower center", ncols=3)
        save_png(figure, path)
