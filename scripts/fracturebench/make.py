"""Write the frozen scenes of FractureBench: NAME.yaml to read, NAME.npz to compute with.

    python scripts/fracturebench/make.py [NAME ...] [-o FOLDER]
    python scripts/fracturebench/make.py --freeze NAME ...

Scenes are built by gsfluent/fracturebench and compared with the committed YAML files, whose
sha256 freezes every array; a scene that came out otherwise is not written. --freeze commits to what
the builder gives now: for a new case, or for a new version of one (its old results are void).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
import frozen

from gsfluent.fracturebench.registry import cases, find
from gsfluent.fracturebench.scene import SceneError


def make(names: list[str], out: Path, freeze: bool) -> int:
    """Write scenes; returns how many could not be."""
    out.mkdir(parents=True, exist_ok=True)
    bad = 0
    for case in [find(n) for n in names] if names else cases():
        scene = frozen.build(case)
        said = frozen.text(case, scene)
        if freeze:
            _write(frozen.SCENES / f"{case.name}.yaml", said)
        else:
            try:
                drift = frozen.drift(case, scene)
            except SceneError as error:
                drift = [str(error)]
            if drift:
                bad += 1
                sys.stderr.write("\n  ".join([f"{case.name}: not what was frozen", *drift]) + "\n")
                continue
        scene.save(out / f"{case.name}.npz")
        if out.resolve() != frozen.SCENES:
            committed = (frozen.SCENES / f"{case.name}.yaml").read_text(encoding="utf-8")
            _write(out / f"{case.name}.yaml", committed)
        sys.stdout.write(f"{case.name}: {scene.count} points, dx {scene.dx:.4g} m\n")
    return bad


def _write(path: Path, text: str) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases; default all")
    parser.add_argument("-o", "--out", type=Path, default=frozen.SCENES, metavar="FOLDER")
    parser.add_argument("--freeze", action="store_true", help="write the YAML of what is built")
    args = parser.parse_args()
    try:
        return 1 if make(args.names, args.out, args.freeze) else 0
    except (SceneError, OSError) as error:
        sys.stderr.write(f"make.py: {error}\n")
        return 2


if __name__ == "__main__":
    sys.exit(main())
