"""How a run ended, as a person reads it: verdict, pieces, time of each stage, the film."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsfluent.cli.plan_table import seconds_text, table
from gsfluent.stages.findings import summary


def run_text(values: Mapping[str, Any], out: Path) -> str:
    """A short table; all that is known stands in ``run.json``.

    Args:
        values: Content of ``run.json``.
        out: Folder of the run.
    """
    simulation = values.get("simulation") or {}
    reason = simulation.get("reason") or str(values["reason"]).split("; ")[0]
    rows = [["verdict", f"{values['verdict']}: {reason}"]]
    if broke := summary(simulation.get("per_frame") or {}):
        rows.append(["broke", broke])
    if plan := values.get("plan"):
        rows.append(["planned", seconds_text(plan["predicted"]["seconds"])])
    stages = values["stages"]
    rows += [
        [row["name"], "taken up from before" if row["resumed"] else seconds_text(row["seconds"])]
        for row in stages
    ]
    took = sum(row["seconds"] for row in stages if not row["resumed"])
    rows.append(["in all", seconds_text(took)])
    outputs = values["outputs"]
    rows += [[name, str(out / outputs[name])] for name in ("video", "report") if name in outputs]
    rows.append(["record", str(out / "run.json")])
    if warnings := values.get("warnings"):
        rows.append(["warnings", f"{len(warnings)}, above and in the report"])
    return "\n".join(table(rows))
