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
from collections.abc import Sequence
from types import FrameType
from typing import Any

from gsfluent.errors import GsfluentError, InputError, RunError

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

_log = logging.getLogger("gsfluent")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit code.

    Args:
        argv: Arguments without the program's name; the process's own by default.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
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
    _configure_logging()
    _treat_termination_as_interrupt()
    try:
        result = command.execute()
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
        text += "\n  mend: GSFLUENT_DEBUG=1 shows the traceback; please report it"
        return _fail(as_json, type(error).__name__, text, 1)
    if as_json:
        _print_json(result)
    else:
        from gsfluent.cli.show import show

        show(result)
    # only doctor has a verdict of its own to give with its exit code; the others raise
    return 1 if result.get("ok") is False else 0


def _fields(error: GsfluentError) -> dict[str, str]:
    names = ("what", "kept", "mend")
    return {name: getattr(error, name) for name in names if getattr(error, name, "")}


def _explain_os_error(error: OSError) -> tuple[str, int]:
    """Message and exit code for a failed system call."""
    where = f" ({error.filename})" if error.filename else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        mend = "free some space and run the same command again; finished stages are kept"
        return f"the disk is full{where}: {error.strerror}\n  mend: {mend}", 1
    if error.errno in _USER_ERRNO:
        return f"{error.strerror}{where}\n  mend: check the path and its permissions", 2
    return f"{error}\n  mend: run the same command again; finished stages are kept", 1


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


def _configure_logging() -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    _log.handlers = [handler]
    _log.setLevel(logging.DEBUG if os.environ.get("GSFLUENT_DEBUG") == "1" else logging.INFO)
    _log.propagate = False


def _treat_termination_as_interrupt() -> None:
    """Let SIGTERM unwind like Ctrl-C: a batch system's kill leaves the same resumable state."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt(f"stopped by {signal.Signals(number).name}")

    try:
        signal.signal(signal.SIGTERM, stop)
    except ValueError:
        _log.debug("not in the main thread; SIGTERM keeps its default")


__all__ = ["InputError", "RunError", "main"]
