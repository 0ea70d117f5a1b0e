"""What the page does, without the page: files to choose, the shot, the commands."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from gsfluent import materials
from gsfluent.config import load_shot
from gsfluent.errors import InputError
from gsfluent.io import atomic_path, kind_of
from gsfluent.run.from_input import made_shot
from gsfluent.spatial.mesh_file import ENDINGS
from gsfluent.studio.job import RUNNING, Job

GUESS = "as its name and colour suggest"
SUGGESTED, DROP, THROW = "a fall that breaks it", "a fall from a height", "thrown at the floor"
EVENTS = (SUGGESTED, DROP, THROW)
UPLOADS = (
    *ENDINGS, ".ply", ".splat", ".spz", ".ksplat", ".sog", ".pt", ".ckpt", ".zip",
)  # fmt: skip
"""Endings of files that the page takes."""

FORMATS = ("mp4", "gif", "webp", "png", "ply-seq", "spz", "splat", "ksplat", "sog",
           "glb", "delta", "usd", "vtk")  # fmt: skip
_THROWN_FROM = 0.5  # metres
_LARGEST = 1 << 30  # bytes of an uploaded file


class Desk:
    """A folder of objects and the results beside them.

    Attributes:
        folder: Where objects are looked for and results are written.
        job: The command at work or the last one.
        plan_words: How a plan is asked for; the first one measures the machine.

    Args:
        folder: See above.
        device: ``auto``, ``cpu`` or ``cuda``, for the commands.
        seed: For the commands.
    """

    def __init__(self, folder: Path, device: str, seed: int) -> None:
        self.folder = folder.resolve()
        self.job: Job | None = None
        self.plan_words = ["plan"]
        self._common = ["--device", device, "--seed", str(seed)]

    def objects(self) -> list[str]:
        """Names of what a run can start from in the folder, sorted."""
        return sorted(
            path.name
            for path in self.folder.iterdir()
            if not path.name.startswith(".")
            and kind_of(path) in ("mesh", "splats", "capture")
            and path.suffix.lower() != ".json"
        )

    def receive(self, name: str, content: bytes) -> str:
        """Keep an uploaded file in the folder; a file that is there is not written over.

        Returns:
            Its name there.

        Raises:
            InputError: A kind of file that no run starts from, or too large.
        """
        plain = Path(re.sub(r"[^\w. ()-]", "_", Path(name.replace("\\", "/")).name).lstrip("."))
        if plain.suffix.lower() not in UPLOADS:
            raise InputError(f"{plain.name} is not an object", f"drop one of {', '.join(UPLOADS)}")
        if len(content) > _LARGEST:
            raise InputError(f"{plain.name} is too large to upload", f"copy it to {self.folder}")
        target, number = self.folder / plain.name, 1
        while target.exists():
            number += 1
            target = self.folder / f"{plain.stem}_{number}{plain.suffix}"
        with atomic_path(target) as part:
            part.write_bytes(content)
        return target.name

    def out(self, name: str) -> Path:
        """Result folder of an object."""
        return self.folder / f"{Path(name).stem}_out"

    def prepare(
        self, name: str, material: str, event: str, height: float, speed: float, size: float
    ) -> Path:
        """Write the shot that was chosen.

        Args:
            name: Of an object of the folder.
            material: A preset, or :data:`GUESS`.
            event: One of :data:`EVENTS`.
            height: Of :data:`DROP` [m].
            speed: Of :data:`THROW` [m/s].
            size: Largest extent of the object [m]; 0 leaves it as it is in the file.

        Returns:
            The shot file.

        Raises:
            InputError: Nothing is chosen, or the shot would be wrong.
        """
        import yaml

        if name not in self.objects():
            raise InputError(
                f"{name or 'no object'} is chosen", "choose one of the list, or drop a file"
            )
        chosen = None if material == GUESS else material
        made = made_shot(self.folder / name, self.out(name), chosen)
        values: dict[str, Any] = yaml.safe_load(made.read_text(encoding="utf-8"))
        if size > 0:
            values["size"] = size
        if event == DROP:
            values["events"] = [{"type": "drop", "height": height}]
        elif event == THROW:
            down = {"type": "throw", "velocity": [0.0, 0.0, -speed]}
            values["events"] = [{"type": "drop", "height": _THROWN_FROM}, down]
        target = self.out(name) / "studio.yaml"
        with atomic_path(target) as part:
            part.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
        load_shot(target)  # what is wrong is said now
        return target

    def plan(self, shot: Path) -> None:
        """Begin to plan a shot."""
        self._begin("plan", [*self.plan_words, str(shot)])

    def run(self, shot: Path) -> None:
        """Begin to run a shot."""
        self._begin("run", ["run", str(shot), "-o", str(shot.parent)])

    def export(self, name: str, kind: str) -> None:
        """Begin to export the result of an object.

        Raises:
            InputError: There is no result.
        """
        out = self.out(name)
        if not (out / "run.json").is_file():
            raise InputError(f"{name or 'nothing'} has not been run", "press Run first")
        self._begin(f"export {kind}", ["export", str(out), "--to", kind])

    def stop(self) -> None:
        """Stop what is at work."""
        if self.job is not None:
            self.job.stop()

    def _begin(self, name: str, words: list[str]) -> None:
        if self.job is not None and self.job.state == RUNNING:
            raise InputError(f"{self.job.name} is at work", "wait, or press Stop")
        self.job = Job(name, [*words, *self._common], self.folder)


def preset_names() -> list[str]:
    """Materials to choose from, the guess first."""
    return [GUESS, *sorted(materials.names())]
