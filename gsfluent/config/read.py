"""Readers that turn YAML values into typed settings; errors name the full path of a key."""

from __future__ import annotations

import dataclasses
import difflib
import logging
import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from gsfluent.errors import InputError, short

_Section = TypeVar("_Section")
_LARGEST = sys.float_info.max
_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Place:
    """Where in the shot a value stands, and the folder that relative file names start from."""

    path: str
    folder: Path

    def inside(self, key: str) -> Place:
        """Return the place of a key of this section."""
        return Place(f"{self.path}.{key}" if self.path else key, self.folder)

    def error(self, wanted: str, got: Any, hint: str = "") -> InputError:
        """Make the error ``{path} must {wanted}, got {got}``."""
        return InputError(
            f"{self.path} must {wanted}, got {short(got)}", hint or "correct the shot file"
        )


Reader = Callable[[Any, Place], Any]


def key(
    read: Reader,
    doc: str,
    example: str,
    *,
    default: Any = dataclasses.MISSING,
    name: str = "",
    old: str = "",
) -> Any:
    """Declare a setting as a dataclass field.

    Args:
        read: Turns the YAML value into the field's value.
        doc: One sentence for docs/guide/shot-keys.md, with the unit.
        example: A YAML value, read by the documentation's test.
        default: Value when the key is absent; without one the key is required.
        name: Key in the file when it is not a legal field name (``from``).
        old: Name the key had before, still read, with a warning that says the new one.
    """
    facts = {"read": read, "doc": doc, "example": example, "name": name, "old": old}
    if default is not dataclasses.MISSING and default.__class__.__hash__ is None:
        return dataclasses.field(default_factory=lambda: dict(default), metadata=facts)
    return dataclasses.field(default=default, metadata=facts)


def optional(read: Reader, doc: str, example: str, *, name: str = "") -> Any:
    """Declare a setting that is None when its key is absent."""
    return key(read, doc, example, default=None, name=name)


def key_name(field: dataclasses.Field[Any]) -> str:
    """Name of a field in the shot file."""
    return field.metadata["name"] or field.name


def nearest(word: Any, known: Iterable[str]) -> str:
    """Suggest the nearest known word, then list them all."""
    words = list(known)
    close = difflib.get_close_matches(
        str(word)[:80] if isinstance(word, str) else "", words, n=1, cutoff=0.4
    )
    return (f"did you mean {close[0]!r}? " if close else "") + f"known: {', '.join(words)}"


def mapping(value: Any, place: Place) -> dict[str, Any]:
    """Read a section as a mapping with text keys; an empty section is an empty mapping."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise place.error("be a section of keys", value)
    for name in value:
        if not isinstance(name, str):
            raise place.error("have text keys", name)
    return dict(value)


def section(cls: type[_Section], value: Any, place: Place) -> _Section:
    """Read a mapping into the dataclass ``cls`` whose fields were declared with :func:`key`.

    Raises:
        InputError: An unknown or missing key, or a value that its reader refuses.
    """
    fields = {key_name(field): field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    given = _renamed(mapping(value, place), fields, place)
    refuse_unknown(given, fields, place)
    values = {}
    for name, field in fields.items():
        if name in given:
            values[field.name] = field.metadata["read"](given[name], place.inside(name))
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            hint = f"add it, for example {name}: {field.metadata['example']}"
            raise InputError(f"{place.inside(name).path} is missing", hint)
    return cls(**values)


def _renamed(
    given: dict[str, Any], fields: Mapping[str, dataclasses.Field[Any]], place: Place
) -> dict[str, Any]:
    """The keys given, those of before under their names of today.

    Raises:
        InputError: A key stands there under both names.
    """
    for name, field in fields.items():
        old = field.metadata.get("old")
        if old and old in given:
            path = place.inside(old).path
            if name in given:
                raise InputError(f"{path} is called {name} now, and both are given", f"keep {name}")
            _log.warning("%s is called %s now; the old name still works", path, name)
            given = {name if key == old else key: value for key, value in given.items()}
    return given


def refuse_unknown(given: Iterable[str], known: Iterable[str], place: Place) -> None:
    """Raise for the first key that is not known."""
    known = list(known)
    for name in given:
        if name not in known:
            raise InputError(f"{place.inside(name).path}: unknown key", nearest(name, known))


def number(low: float = -math.inf, high: float = math.inf, *, above: float | None = None) -> Reader:
    """Reader of a finite number in ``low..high``, or strictly above ``above``."""

    def read(value: Any, place: Place) -> float:
        if isinstance(value, str):  # YAML 1.1 reads 1e6 as text
            try:
                value = float(value)
            except ValueError:
                raise place.error("be a number", value) from None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise place.error("be a number", value)
        # not isfinite(), which fails for a whole number of hundreds of digits
        if not -_LARGEST <= value <= _LARGEST or not low <= value <= high:
            raise place.error(f"lie in {low:g}..{high:g}", value)
        if above is not None and not value > above:
            raise place.error(f"be above {above:g}", value)
        return float(value)

    return read


def whole(low: int, high: int) -> Reader:
    """Reader of a whole number in ``low..high``."""

    def read(value: Any, place: Place) -> int:
        exact = number(low, high)(value, place)
        if exact != int(exact):
            raise place.error("be a whole number", value)
        return int(exact)

    return read


def text(value: Any, place: Place) -> str:
    """Read text that is not empty."""
    if not isinstance(value, str) or not value.strip():
        raise place.error("be text", value)
    return value


def flag(value: Any, place: Place) -> bool:
    """Read true or false."""
    if not isinstance(value, bool):
        raise place.error("be true or false", value)
    return value


def choice(*known: str) -> Reader:
    """Reader of one of ``known``."""

    def read(value: Any, place: Place) -> str:
        if value is None or value is False:
            value = "no" if value is False else "none"
        if value not in known:
            raise place.error(f"be one of {', '.join(known)}", value, nearest(value, known))
        return str(value)

    return read


def vector(count: int, low: float = -math.inf, high: float = math.inf) -> Reader:
    """Reader of ``count`` numbers as a tuple."""

    def read(value: Any, place: Place) -> tuple[float, ...]:
        if not isinstance(value, list | tuple) or len(value) != count:
            raise place.error(f"be {count} numbers in brackets", value)
        one = number(low, high)
        return tuple(one(part, place.inside(str(index))) for index, part in enumerate(value))

    return read


def several(read_one: Reader) -> Reader:
    """Reader of a list as a tuple; one value alone counts as a list of one."""

    def read(value: Any, place: Place) -> tuple[Any, ...]:
        items = value if isinstance(value, list | tuple) else [value]
        return tuple(
            read_one(item, Place(f"{place.path}[{i}]", place.folder))
            for i, item in enumerate(items)
        )

    return read


def several_of(read_one: Reader, low: int, high: int = 1000) -> Reader:
    """Reader of a list of ``low`` to ``high`` values as a tuple."""

    def read(value: Any, place: Place) -> tuple[Any, ...]:
        if not isinstance(value, list | tuple) or not low <= len(value) <= high:
            count = str(low) if low == high else f"{low} or more"
            raise place.error(f"be a list of {count}", value)
        return tuple(several(read_one)(value, place))

    return read


def typed(value: Any, place: Place, known: Mapping[str, type[Any]], noun: str) -> tuple[Any, ...]:
    """Read a list of sections whose key ``type`` names a dataclass of ``known``."""
    if value is None:
        return ()
    if not isinstance(value, list | tuple):
        raise place.error(f"be a list of {noun}s", value)
    found = []
    for index, item in enumerate(value):
        where = Place(f"{place.path}[{index}]", place.folder)
        settings = mapping(item, where)
        kind = settings.pop("type", None)
        if not isinstance(kind, str) or kind not in known:
            raise InputError(
                f"{where.path}.type: unknown {noun} {short(kind)}", nearest(kind, known)
            )
        found.append(section(known[kind], settings, where))
    return tuple(found)


def typed_dict(settings: Any, known: Mapping[str, type[Any]]) -> dict[str, Any]:
    """Turn a section that :func:`typed` has read back into what the shot file has."""
    kind = next(name for name, cls in known.items() if type(settings) is cls)
    return without_none({"type": kind, **plain(settings)})


def either_of(
    settings: Any, names: tuple[str, str], place: Place, hint: str = "keep one of them"
) -> None:
    """Refuse a section that has both or neither of two keys."""
    first, second = (getattr(settings, name) is not None for name in names)
    if first == second:
        got = "both" if first else "neither"
        raise InputError(
            f"{place.path} must have either {names[0]!r} or {names[1]!r}, got {got}", hint
        )


def preset(value: Any, place: Place) -> str:
    """Read the name of a material preset."""
    from gsfluent import materials

    name = text(value, place)
    try:
        materials.get(name)
    except InputError as error:
        raise InputError(f"{place.path}: {error.what}", error.hint) from None
    return name


def either(words: Reader, other: Reader) -> Reader:
    """Reader that lets text that is no number go to ``words`` and everything else to ``other``."""

    def read(value: Any, place: Place) -> Any:
        if isinstance(value, str) and not _is_number(value):
            return words(value, place)
        return other(value, place)

    return read


def existing_path(value: Any, place: Place) -> Path:
    """Read a path relative to the shot file, which must exist; ``$NAME`` is replaced."""
    written = os.path.expandvars(text(value, place))
    if "$" in written:
        raise InputError(
            f"{place.path}: {short(value)} names an environment variable that is not set",
            "set it, or write the path out",
        )
    try:
        path = (place.folder / Path(written).expanduser()).resolve()
        there = path.exists()
    except (OSError, ValueError, RuntimeError) as error:  # too long, a NUL, an unknown ~user
        why = error.strerror if isinstance(error, OSError) else error
        raise InputError(
            f"{place.path}: {short(written)} is no path ({why})", "correct the path"
        ) from error
    if not there:
        raise InputError(
            f"{place.path}: {short(str(path), bare=True)} does not exist",
            "check the path; it starts from the shot file's folder",
        )
    return path


INPUTS = {"capture": "a capture", "splats": "a splat", "mesh": "a mesh"}
"""Keys of a shot that name its input, and what they take in words."""


def input_path(key: str) -> Reader:
    """Reader of a path for one of :data:`INPUTS`; what belongs under another is told which."""

    def read(value: Any, place: Place) -> Path:
        from gsfluent.io.capture import kind_of

        path = existing_path(value, place)
        kind = kind_of(path)
        if kind in INPUTS and kind != key:
            raise InputError(
                f"{place.path}: {value} is {INPUTS[kind]}, not {INPUTS[key]}",
                f"write {kind}: {value}",
            )
        if key == "mesh" and kind is None:
            raise InputError(
                f"{place.path}: {value} is no mesh", "give .obj, .glb, .stl, .ply, .off or .dae"
            )
        return path

    return read


def nested(cls: type[Any]) -> Reader:
    """Reader of a section as the dataclass ``cls``."""
    return lambda value, place: section(cls, value, place)


def plain(value: Any) -> Any:
    """Turn settings back into what JSON and YAML hold, keys as in the file."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        shown = {
            key_name(field): field
            for field in dataclasses.fields(value)
            if "read" in field.metadata
        }
        return {name: plain(getattr(value, field.name)) for name, field in shown.items()}
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


class Section:
    """Base of sections whose settings are passed on as far as they are set."""

    def given(self) -> dict[str, Any]:
        """Return the fields that are set (not None), by field name."""
        names = (field.name for field in dataclasses.fields(self))  # type: ignore[arg-type]
        pairs = ((name, getattr(self, name)) for name in names)
        return {name: value for name, value in pairs if value is not None}


def without_none(value: Any) -> Any:
    """Drop keys whose value is None, at every depth."""
    if isinstance(value, dict):
        return {name: without_none(item) for name, item in value.items() if item is not None}
    return [without_none(item) for item in value] if isinstance(value, list) else value


def read_direction(value: Any, place: Place) -> tuple[float, ...]:
    """Read a direction [x, y, z] that is not zero."""
    numbers: tuple[float, ...] = vector(3)(value, place)
    if not any(numbers):
        raise place.error("not be zero", value)
    return numbers


def _is_number(value: str) -> bool:
    try:
        float(value)
    except ValueError:
        return False
    return True
