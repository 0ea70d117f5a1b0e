"""``report.html``: a run on one page, from ``run.json`` alone.

Verdict, plan against fact, energy and momentum, damage, pieces, holes, and where the time went.
Nothing is computed again, so the page of an old run can be made anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsfluent.errors import InputError, MissingPackage
from gsfluent.figure.page import Page
from gsfluent.figure.series import Panel, curves
from gsfluent.io.checked.files import read_json

REPORT = "report.html"
_KINDS = {"clean": "good", "healed": "warn", "failed": "bad"}
Values = Mapping[str, Any]


def read_run(out: Path) -> dict[str, Any]:
    """Read ``OUT/run.json``.

    Raises:
        InputError: It is not there, or it is not such a file.
    """
    path = out / "run.json"
    if not path.exists():
        raise InputError(
            f"{path}: not there", "name the folder of a run, as `gsfluent run -o` was given it"
        )
    values = read_json(path, "run the shot again")
    if not isinstance(values, dict) or "verdict" not in values:
        raise InputError(f"{path}: not the record of a run", "run the shot again")
    return values


def write_report(out: Path, values: Values) -> Path:
    """Write the page of a run beside its video.

    Returns:
        ``OUT/report.html``.

    Raises:
        RunError: The folder cannot be written.
    """
    return report_page(out, values).write(out / REPORT)


def report_page(out: Path, values: Values) -> Page:
    """Make the page; sections of which the run says nothing are left out."""
    page = Page(out.resolve().name, f"gsfluent {values.get('version', '')} on {values['device']}")
    verdict = str(values["verdict"])
    simulation = values.get("simulation") or {}
    notes = simulation.get("notes") or []  # the reason names them too
    kind = "warn" if verdict == "clean" and notes else _KINDS.get(verdict, "")
    page.text(f"{verdict}: {values.get('reason', '')}", kind=kind)
    _unbroken(page, simulation.get("unbroken") or [])
    outputs = values.get("outputs") or {}
    if (video := outputs.get("video")) and (out / video).is_file():
        page.video(video, "the shot as it was asked for")
    if (inside := outputs.get("interior")) and (out / inside).is_file():
        page.picture(out / inside, "cuts through the filled and textured object")
    if warnings := values.get("warnings"):
        page.heading("Warnings").listing([str(w) for w in warnings], kind="warn")
    _summary(page, values)
    _choice(page, out, values)
    _plan(page, values.get("plan"))
    _motion(page, simulation.get("per_frame") or {}, simulation)
    _grips(page, simulation.get("per_frame") or {}, simulation.get("grips") or [])
    _pictures(page, values)
    _stages(page, values.get("stages") or [])
    _left_out(page, simulation.get("skipped") or {})
    return page


def _summary(page: Page, values: Values) -> None:
    simulation, render = values.get("simulation") or {}, values.get("render") or {}
    reconstruction = values.get("reconstruction") or {}
    frames = simulation.get("per_frame") or {}
    rows = [
        ("held-out PSNR of the photographs [dB]", reconstruction.get("psnr")),
        ("Gaussians", reconstruction.get("gaussians")),
        ("material points", simulation.get("particles")),
        ("cell of the grid [m]", simulation.get("dx")),
        ("time steps", simulation.get("substeps")),
        ("shortest and longest step [s]", _pair(simulation, "dt_min", "dt_max")),
        ("pieces at the end", _last(frames, "pieces", "fragments")),
        ("pieces over 1 % of the mass", _last(frames, "pieces_over_1_percent")),
        ("share of the mass ever broken", _last(frames, "broken_fraction")),
        ("share of the mass loose at the end", _last(frames, "loose_fraction")),
        ("rollbacks", simulation.get("rollbacks")),
        ("largest error of momentum", simulation.get("momentum_error")),
        ("rendered frames", render.get("frames")),
        ("time per rendered frame [s]", render.get("seconds_per_frame")),
    ]
    kept = [row for row in rows if row[1] not in (None, "")]
    if kept:
        page.heading("In short").table(["figure", "value"], kept)


def _unbroken(page: Page, rows: Sequence[Values]) -> None:
    """What was struck and stayed whole."""
    if rows:
        page.heading("Nothing broke")
        names = ("body", "material", "met", "speed", "speed_needed")
        head = ["struck", "weakest material", "by", "speed [m/s]", "breaks from about [m/s]"]
        page.table(head, [[row.get(name) for name in names] for row in rows])


def _last(frames: Values, *names: str) -> Any:
    """The value of the last frame under the first of these names that the run has kept."""
    return next((frames[name][-1] for name in names if frames.get(name)), None)


def _pair(values: Values, first: str, second: str) -> str:
    low, high = values.get(first), values.get(second)
    return "" if low is None or high is None else f"{low:.3g}, {high:.3g}"


def _choice(page: Page, out: Path, values: Values) -> None:
    """What ``solve.error`` has chosen, and how sure that is."""
    choice = values.get("choice")
    if not isinstance(choice, Mapping):
        return
    taken = choice.get("chosen") or choice.get("enough") or {}
    page.heading("The setting, chosen by error")
    page.text(str(choice.get("reason", "")), kind="" if choice.get("met") else "warn")
    rows = [
        ("asked for", choice.get("bound")),
        ("expected (median)", taken.get("error")),
        ("5 % to 95 %", _pair(taken, "low", "high")),
        ("share of the draws that meet it", choice.get("sure")),
        ("cells along the largest solid", taken.get("cells")),
        ("Courant number", taken.get("cfl")),
    ]
    page.table(["figure", "value"], [row for row in rows if row[1] not in (None, "")])
    picture = (values.get("outputs") or {}).get("chart")
    if picture and (out / picture).is_file():
        page.picture(out / picture, "what every setting costs, and what is expected of it")


def _plan(page: Page, plan: Any) -> None:
    """What was predicted before the run, beside what it took."""
    rows = _compared(plan.get("predicted"), plan.get("actual")) if isinstance(plan, Mapping) else []
    if not rows:
        return
    page.heading("Plan against fact")
    if plan.get("calibrated") is False:
        page.text(
            "No times were foreseen: `gsfluent plan` measures what work costs on this machine, "
            "and runs teach it"
        )
    page.table(["quantity", "predicted", "actual", "actual / predicted"], rows)


def _compared(predicted: Any, actual: Any, of: str = "") -> list[tuple[str, Any, Any, Any]]:
    """Rows of what stands on both sides, stage by stage, bytes as megabytes."""
    rows: list[tuple[str, Any, Any, Any]] = []
    for name, guess in (predicted or {}).items():
        fact: Any = (actual or {}).get(name)
        if isinstance(guess, Mapping):
            rows += _compared(guess, fact, of if name == "stages" else f"{of}{name}: ")
        elif _is_number(guess) and _is_number(fact):
            ratio, label = (fact / guess if guess else None), name.replace("_", " ")
            if name.endswith("_bytes"):
                guess, fact = round(guess / 1e6), round(fact / 1e6)
                label = label.removesuffix(" bytes") + " [MB]"
            rows.append((of + label, guess, fact, ratio))
    return rows


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _sizes(vectors: Sequence[Sequence[float]]) -> list[float]:
    return [sum(c * c for c in vector) ** 0.5 for vector in vectors]


def _motion(page: Page, frames: Values, simulation: Values) -> None:
    time = frames.get("time") or []
    if not time:
        return
    energies = {
        name: frames[name]
        for name in ("kinetic", "elastic", "dissipated", "gravity")
        if name in frames
    }
    if len(energies) == 4:
        parts = zip(*energies.values(), strict=True)
        energies["sum"] = [None if None in p else sum(p) for p in parts]
    panels = [
        Panel("Energy", "J", energies),
        Panel("Momentum", "kg m/s", {"momentum": _sizes(frames.get("momentum") or [])}),
        Panel(
            "Momentum that no force explains", "share", {"error": frames.get("momentum_error", [])},
            bar=simulation.get("momentum_bar"), log=True,
        ),
        Panel(
            "Damage", "share of the matter",
            {"broken": frames.get("damaged_fraction", []),
             "ever broken": frames.get("broken_fraction", []),
             "loose": frames.get("loose_fraction", []),
             "largest piece": frames.get("largest_fragment", [])},
        ),
        Panel(
            "Pieces", "count",
            {"all": frames.get("pieces") or frames.get("fragments", []),
             "over 1 % of the matter": frames.get("pieces_over_1_percent", []),
             "over 3 % of the matter": frames.get("fragments_over_3_percent", [])},
            whole=True,
        ),
        Panel("Grid", "blocks in use", {"blocks": frames.get("active_blocks", [])}, whole=True),
    ]  # fmt: skip
    _curves(page, "Motion", time, "time [s]", panels, "dashed: the largest value that passes")


def _grips(page: Page, frames: Values, grips: Sequence[Values]) -> None:
    """What held and drove points needed for it."""
    rows = frames.get("grips") or []
    if not grips or not rows:
        return
    names = [str(row["name"]) for row in grips]
    sizes = {
        what: {name: _sizes([frame[name][what] for frame in rows]) for name in names}
        for what in ("force", "moment")
    }
    _curves(
        page, "Grips", frames.get("time") or [], "time [s]",
        [Panel("Force of each grip", "N", sizes["force"]),
         Panel("Moment of each grip", "N m", sizes["moment"])],
        "means over a frame; moments about the point of the grip",
    )  # fmt: skip
    head = ["grip", "largest force [N]", "at [s]", "largest moment [N m]", "at [s]"]
    keys = ("name", "force", "force_at", "moment", "moment_at")
    page.table(head, [[row[key] for key in keys] for row in grips])


def _curves(
    page: Page,
    head: str,
    along: Sequence[float],
    label: str,
    panels: list[Panel],
    caption: str = "",
) -> None:
    """A section of curves; without matplotlib a line that says what would draw them."""
    kept = [  # without the series that the run did not keep
        replace(p, series={n: v for n, v in p.series.items() if len(v) == len(along)})
        for p in panels
    ]
    try:
        if drawing := curves(along, label, kept):
            page.heading(head).svg(drawing, caption)
    except MissingPackage as missing:
        page.heading(head).text(f"{missing.what}: {missing.hint}", kind="warn")


def _pictures(page: Page, values: Values) -> None:
    render = values.get("render") or {}
    holes = render.get("hole_fraction") or []
    if not holes:
        return
    panels = [
        Panel(
            "Holes in the picture", "share of the object",
            {"with crack faces": holes, "without": render.get("hole_fraction_before", [])},
        ),
        Panel("Splats born at cracks", "count", {"born": render.get("transition_gaussians", [])},
              whole=True),
    ]  # fmt: skip
    _curves(page, "Pictures", range(len(holes)), "frame", panels)


def _stages(page: Page, stages: Sequence[Values]) -> None:
    if not stages:
        return
    total = sum(float(stage.get("seconds") or 0.0) for stage in stages)
    rows = [
        (
            stage["name"],
            stage.get("seconds"),
            f"{100.0 * float(stage.get('seconds') or 0.0) / total:.0f} %" if total else "",
            _gigabytes(stage.get("peak_memory_bytes")),
            _gigabytes(stage.get("peak_device_memory_bytes")),
            "taken up from before" if stage.get("resumed") else "",
        )
        for stage in stages
    ]
    page.heading("Where the time went")
    head = ["stage", "seconds", "share", "memory [GB]", "on the device [GB]", ""]
    page.table(head, [*rows, ("all", total, "", None, None, "")])


def _gigabytes(size: Any) -> float | None:
    return round(size / 1e9, 2) if size else None


def _left_out(page: Page, skipped: Values) -> None:
    """What the scene did not need and was not computed."""
    if skipped:
        page.heading("What was left out")
        page.text(
            "Counted while the run went on; docs/theory/simulation.md says what each figure means."
        )
        page.table(["figure", "value"], [(k.replace("_", " "), v) for k, v in skipped.items()])
