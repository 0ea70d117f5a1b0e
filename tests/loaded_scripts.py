"""Scripts as modules, found as python finds things that runs them: their own folder comes first."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


def load_script(name: str) -> ModuleType:
    """A new module from a file below ``scripts/``.

    What it imports from beside it does not stay among the loaded modules: several folders have a
    ``cases.py``.

    Args:
        name: Path below ``scripts/``, without the suffix.
    """
    path = SCRIPTS / f"{name}.py"
    spec = importlib.util.spec_from_file_location("scripts_" + name.replace("/", "_"), path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    siblings = [sibling.stem for sibling in path.parent.glob("*.py")]
    hidden = {name: sys.modules.pop(name) for name in siblings if name in sys.modules}
    sys.modules[spec.name] = module  # dataclasses look their module up
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(path.parent))
        for sibling in siblings:
            sys.modules.pop(sibling, None)
        sys.modules.update(hidden)
    return module
