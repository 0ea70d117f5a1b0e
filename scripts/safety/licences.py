"""Write docs/measured/licences.md: what an installation of gsfluent brings, under which licences.

    python scripts/safety/licences.py

Read from what this environment has installed: the packages that gsfluent and its extras ask for,
what these ask for, and the ffmpeg that imageio-ffmpeg carries, which is asked itself.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

from gsfluent.figure.markdown import enter

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "measured" / "licences.md"
PROGRAM = "imageio-ffmpeg"
"""The package that carries a program of another licence than its own."""


def main() -> int:
    text = enter(PAGE.read_text(encoding="utf-8"), "licences", table(asked_for()))
    PAGE.write_text(text, encoding="utf-8")
    return 0


def asked_for() -> dict[str, str]:
    """Package -> what asks for it: ``gsfluent``, an extra of it in brackets, or another package."""
    with (ROOT / "pyproject.toml").open("rb") as stream:
        project = tomllib.load(stream)["project"]
    found: dict[str, str] = {}
    for name in project["dependencies"]:
        follow(name, "gsfluent", found)
    for extra, names in project["optional-dependencies"].items():
        for name in names if extra != "dev" else ():  # nobody who uses gsfluent gets these
            follow(name, f"[{extra}]", found)
    return found


def follow(requirement: str, by: str, found: dict[str, str]) -> None:
    """Add a package and what it asks for, as far as it is installed."""
    name, _, condition = requirement.partition(";")
    name = canonical(re.split(r"[\s\[<>=!~(]", name.strip())[0])
    if name in found or "extra ==" in condition:
        return
    try:
        package = metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return  # for another system, or not installed
    found[name] = by
    for each in package.requires or ():
        follow(each, name, found)


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def licence(name: str) -> str:
    """In the package's own words, as short as it has them."""
    about = metadata.metadata(name)
    said = [
        each.split(" :: ")[-1]
        for each in about.get_all("Classifier") or ()
        if each.startswith("License ::") and each != "License :: OSI Approved"
    ]
    text = about.get("License-Expression") or ", ".join(said) or about.get("License") or ""
    return text.strip().splitlines()[0] if text.strip() else "not said"


def ffmpeg() -> str:
    """The row of the program in imageio-ffmpeg."""
    import imageio_ffmpeg

    said = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-version"], capture_output=True, text=True, check=True
    ).stdout
    version = said.split()[2]
    switches = [word for word in ("--enable-gpl", "--enable-version3", "--enable-nonfree")
                if word in said]  # fmt: skip
    if "--enable-nonfree" in switches:
        terms = "not to be passed on"
    else:
        later = "3" if "--enable-version3" in switches else "2"
        terms = f"{'GPL' if '--enable-gpl' in switches else 'LGPL'}, version {later} or later"
    return f"| ffmpeg, a program in it | {version} | {terms} ({', '.join(switches)}) | {PROGRAM} |"


def table(found: dict[str, str]) -> str:
    lines = ["| package | version | licence | asked for by |", "| --- | --- | --- | --- |"]
    for name in sorted(found):
        version = metadata.version(name)
        lines.append(f"| {name} | {version} | {licence(name)} | {found[name]} |")
        if name == PROGRAM:
            lines.append(ffmpeg())
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
