"""A sweep without processes, for tests of what is handed to one: what goes out must be pickled."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from gsfluent.sweep.engine import Outcome


def swept(into: list[dict[str, Any]]) -> Callable[..., list[Outcome]]:
    """A stand-in for ``gsfluent.sweep.map`` that notes in a list how it was called."""

    def mapped(
        function: Any, items: Iterable[Any], folder: Path, *, ids: Any = None, **options: Any
    ) -> list[Outcome]:
        into.append(options)
        found = []
        for number, item in enumerate(items):
            name = ids[number] if ids else str(number)
            place = folder / "shots" / name
            place.mkdir(parents=True)
            function, item = pickle.loads(pickle.dumps((function, item)))
            value = json.loads(json.dumps(function(item, place)))
            found.append(Outcome(name, place, value, 1))
        return found

    return mapped
