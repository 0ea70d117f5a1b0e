"""Write requirements.lock: what gsfluent is built, run and tested with, each file by its hash.

    python scripts/safety/lock.py                # the versions of this environment, hashes of PyPI
    pip install --require-hashes -r requirements.lock
    pip install --no-deps --no-build-isolation -e .

pip resolves every extra without installing or downloading: pinned to what is installed here, and to
its own choice for what is not, which is what torch needs for CUDA.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
LOCK = ROOT / "requirements.lock"
INDEX = "https://pypi.org/simple"
FILES = "https://files.pythonhosted.org/"
HEAD = """\
# Made by scripts/safety/lock.py, not by hand: every package that gsfluent is built, run and tested
# with, extras and all, as wheels of PyPI for Linux on x86-64 and CPython 3.11. Others use
# pyproject.toml. GSFLUENT_LOCK=1 makes scripts/setup.sh install from here.
"""


def main() -> int:
    with tempfile.TemporaryDirectory() as made:
        report = resolved(Path(made))
    lines = sorted(map(line, report["install"]), key=str.lower)
    LOCK.write_text(HEAD + "".join(lines), encoding="utf-8")
    print(f"{LOCK.name}: {len(lines)} packages")
    return 0


def wanted() -> list[str]:
    """Requirements of the build, of the package and of the extras that developers have."""
    with (ROOT / "pyproject.toml").open("rb") as stream:
        project = tomllib.load(stream)
    extras = project["project"]["optional-dependencies"]
    found = [*project["build-system"]["requires"], *project["project"]["dependencies"]]
    for one in extras["dev"]:
        name, _, some = one.partition("[")
        names = some.rstrip("]").split(",") if name == "gsfluent" else []
        found += [each for extra in names for each in extras[extra]] if names else [one]
    return list(dict.fromkeys(found))


def pins() -> Iterator[str]:
    """What is installed here, without the words of a local build (``+cpu``)."""
    for package in metadata.distributions():
        if package.name != "gsfluent":
            yield f"{package.name}=={package.version.split('+')[0]}"


def resolved(folder: Path) -> Any:
    """pip's report of an installation into nothing, from PyPI alone."""
    (folder / "pins.txt").write_text("\n".join(pins()))
    words = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
    words += ["--only-binary", ":all:", "--index-url", INDEX, "--report", str(folder / "report")]
    words += ["--constraint", str(folder / "pins.txt"), *wanted()]
    # other places, which a machine may be set up with, have other files under the same names
    env = {k: v for k, v in os.environ.items() if not re.match("PIP_(FIND_LINKS|.*INDEX.*)", k)}
    subprocess.run(words, check=True, env=env | {"PIP_CONFIG_FILE": os.devnull})
    return json.loads((folder / "report").read_text(encoding="utf-8"))


def line(item: Any) -> str:
    """A package of the report, with its hash."""
    found, about = item["download_info"], item["metadata"]
    if not found["url"].startswith(FILES):
        raise SystemExit(f"{about['name']}: {found['url']} is no file of PyPI")
    digest = found["archive_info"]["hashes"]["sha256"]
    return f"{about['name']}=={about['version']} --hash=sha256:{digest}\n"


if __name__ == "__main__":
    sys.exit(main())
