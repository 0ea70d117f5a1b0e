"""YAML with errors that name the line; a key written twice is an error, not a silent choice."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from gsfluent.errors import InputError, short
from gsfluent.io.checked.files import read_text
from gsfluent.io.checked.limits import DEPTH, limit

_WRONG_VALUE = (ValueError, ArithmeticError, LookupError, TypeError, AttributeError)
"""What PyYAML lets through for 2020-13-45, 0b_, !!int abc, !!bool maybe, !!timestamp x."""


class _UniqueKeyLoader(yaml.SafeLoader):
    """Safe loader that refuses a mapping with the same key twice, and what grows when read.

    An alias costs a word in the file and its whole value wherever somebody walks through it, so
    aliases count as if they were written out.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """One node, its depth and its size with all aliases written out checked."""
        self._depth += 1
        event = self.peek_event()
        if self._depth > DEPTH:
            raise _refused(f"nested more than {DEPTH} deep", event)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(event, yaml.AliasEvent):
            if id(node) not in self._sizes:
                raise _refused("an alias inside of what it stands for", event)
        elif node is not None:
            size = 1 + sum(self._sizes.get(id(part), 0) for part in _parts(node))
            if size > limit("yaml_values"):
                raise _refused(
                    f"more than {limit('yaml_values')} values with all aliases written out; "
                    "GSFLUENT_MAX_YAML_VALUES allows more",
                    event,
                )
            self._sizes[id(node)] = size
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """One value; what the safe loader cannot make of it names the line."""
        try:
            return super().construct_object(node, deep)
        except yaml.YAMLError:
            raise
        except _WRONG_VALUE as error:
            kind = node.tag.rpartition(":")[2]
            raise _refused(
                f"not a value of the kind {kind} ({short(str(error), bare=True)})", node
            ) from error


def _refused(problem: str, at: Any) -> yaml.MarkedYAMLError:
    return yaml.constructor.ConstructorError(None, None, problem, at.start_mark)


def _parts(node: yaml.Node) -> Iterator[yaml.Node]:
    if isinstance(node, yaml.SequenceNode):
        yield from node.value
    elif isinstance(node, yaml.MappingNode):
        for pair in node.value:
            yield from pair


def _unique_mapping(loader: _UniqueKeyLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    loader.flatten_mapping(node)
    values: dict[Any, Any] = {}
    for key_node, value_node in node.value:
        name = loader.construct_object(key_node, deep=True)
        if not isinstance(name, str | int | float | bool | None):
            raise yaml.constructor.ConstructorError(
                None, None, "a key must be plain text", key_node.start_mark
            )
        if name in values:
            raise yaml.constructor.ConstructorError(
                None, None, f"key {short(name)} stands twice", key_node.start_mark
            )
        values[name] = loader.construct_object(value_node, deep=True)
    return values


_UniqueKeyLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _unique_mapping)


def read_yaml(path: Path) -> Any:
    """Read one YAML document.

    Raises:
        InputError: The file is missing, not text, or not YAML; the message names the line.
    """
    text = read_text(path, "yaml_bytes")
    try:
        return yaml.load(text, Loader=_UniqueKeyLoader)
    except RecursionError as error:
        raise InputError(f"{path}: not valid YAML (nested too deeply)", "flatten it") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error)
        raise InputError(
            f"{path}{line}: not valid YAML ({problem})", "correct that line"
        ) from error
