"""The command line: ``gsfluent VERB``, one dataclass per verb, read by tyro.

Contract (interface.md section 1): exit 0 on success, 2 on bad input, 1 on a failure while running,
130 after Ctrl-C; ``--json`` puts exactly one object on stdout and everything else on stderr; no
traceback unless ``GSFLUENT_DEBUG=1``.
"""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

from gsfluent.errors import GsfluentError

if TYPE_CHECKING:
    from gsfluent.cli.common import Verb

# Read by OpenMP when torch is first imported. Thread teams that spin at their barriers make small
# torch operations tens of times slower as soon as anything else runs on the machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# errno of things a user can mend by naming another path
_USER_ERRNO = (
    errno.ENOENT,
    errno.EACCES,
    errno.EPERM,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EEXIST,
    errno.EROFS,
)
_INTERRUPTED = 130
_READER_GONE = 141

_log = logging.getLogger("gsfluent")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit code."""
    try:
        code = _command(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
    except BrokenPipeError:
        # whoever read our words has gone (`| head`); what is left of them goes nowhere, in silence
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _READER_GONE
    return code


def _command(arguments: list[str]) -> int:
    """Parse and run one command line."""
    as_json = "--json" in arguments
    from gsfluent.cli.parse import parse

    try:
        command = parse(arguments)
    except SystemExit as stop:  # tyro has printed help (0) or what is wrong (2)
        code = stop.code if isinstance(stop.code, int) else 2
        if code and as_json:
            _print_json(
                {"error": {"kind": "InputError", "message": "see stderr"}, "exit_code": code}
            )
        return code
    with _logging_to_stderr(), _termination_as_interrupt():
        return _execute(command, as_json)


def _execute(command: Verb, as_json: bool) -> int:
    """Run a verb and turn whatever happens into words and an exit code."""
    try:
        result = command.heard()
    except KeyboardInterrupt as stop:
        return _fail(as_json, "Interrupted", str(stop) or "interrupted by Ctrl-C", _INTERRUPTED)
    except GsfluentError as error:
        _show_traceback()
        return _fail(as_json, type(error).__name__, str(error), error.exit_code, _fields(error))
    except OSError as error:
        _show_traceback()
        return _fail(as_json, type(error).__name__, *_explain_os_error(error))
    except Exception as error:
        _show_traceback()
        text = f"unexpected {type(error).__name__}: {error}"
        text += "\n  hint: GSFLUENT_DEBUG=1 shows the traceback; please report it"
        return _fail(as_json, type(error).__name__, text, 1)
    if as_json:
        _print_json(result)
    else:
        from gsfluent.cli.show import show

        readable = command.text(result)
        if readable is None:
            show(result)
        else:
            sys.stdout.write(readable + "\n")
    # only doctor has a verdict of its own to give with its exit code; the others raise
    return 1 if result.get("ok") is False else 0


def _fields(error: GsfluentError) -> dict[str, str]:
    names = ("what", "kept", "hint")
    return {name: getattr(error, name) for name in names if getattr(error, name, "")}


def _explain_os_error(error: OSError) -> tuple[str, int]:
    """Message and exit code for a failed system call."""
    where = f" ({error.filename})" if error.filename else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        hint = "free some space and run the same command again; finished stages are kept"
        return f"the disk is full{where}: {error.strerror}\n  hint: {hint}", 1
    if error.errno in _USER_ERRNO:
        return f"{error.strerror}{where}\n  hint: check the path and its permissions", 2
    return f"{error}\n  hint: run the same command again; finished stages are kept", 1


def _fail(
    as_json: bool, kind: str, text: str, code: int, fields: dict[str, str] | None = None
) -> int:
    sys.stderr.write(f"gsfluent: {text}\n")
    if as_json:
        _print_json({"error": {"kind": kind, "message": text, **(fields or {})}, "exit_code": code})
    return code


def _print_json(value: dict[str, Any]) -> None:
    from gsfluent.cli.show import to_json

    sys.stdout.write(to_json(value) + "\n")
    sys.stdout.flush()


def _show_traceback() -> None:
    if os.environ.get("GSFLUENT_DEBUG") == "1":
        import traceback

        traceback.print_exc()


@contextmanager
def _logging_to_stderr() -> Iterator[None]:
    """Show gsfluent's log lines plainly on stderr while a verb runs."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    before = (_log.handlers, _log.level, _log.propagate)
    _log.handlers, _log.propagate = [handler], False
    _log.setLevel(logging.DEBUG if os.environ.get("GSFLUENT_DEBUG") == "1" else logging.INFO)
    try:
        yield
    finally:
        _log.handlers, _log.propagate = before[0], before[2]
        _log.setLevel(before[1])


@contextmanager
def _termination_as_interrupt() -> Iterator[None]:
    """Let SIGTERM unwind like Ctrl-C: a batch system's kill leaves the same resumable state."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt(f"stopped by {signal.Signals(number).name}")

    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
