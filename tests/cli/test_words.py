"""The command line as words: help, wrong words, devices, exit codes, one JSON object."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from gsfluent.cli import main
from gsfluent.cli.common import parse_size
from gsfluent.cli.parse import VERBS
from gsfluent.cli.show import to_json
from gsfluent.errors import InputError


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_help_teaches_by_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb, "--help"]) == 0
    text = capsys.readouterr().out
    assert "Examples:" in text
    assert text.count(f"gsfluent {verb}") >= 3  # usage and at least two examples
    for flag in ("--json", "--device", "--seed"):
        assert flag in text


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_every_example_is_a_command_line_that_parses(verb: str) -> None:
    import shlex

    from gsfluent.cli.parse import parse

    lines = [line.strip() for line in (VERBS[verb].__doc__ or "").splitlines()]
    examples = [line for line in lines if line.startswith("gsfluent ")]
    assert len(examples) >= 2
    for line in examples:
        words = shlex.split(line, comments=True)[1:]
        assert isinstance(parse(words), VERBS[verb]), line


def test_no_word_at_all_shows_the_verbs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    text = capsys.readouterr().out
    assert all(verb in text for verb in VERBS)


def test_reader_that_leaves_early_sees_no_traceback() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "gsfluent", "run", "--help"]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert done.returncode == 141 and done.stderr == ""


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("gsfluent 0.")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["smash"], "smash"),
        (["run"], "INPUT"),
        (["doctor", "--sed", "1"], "--seed"),
        (["doctor", "--seed", "x"], "--seed"),
        (["reconstruct", "."], "--out"),
    ],
)
def test_wrong_words_exit_2_and_say_which(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("device", ["gpu", "cuda:x", "mps", "cuda:99"])
def test_wrong_device_exits_2_with_a_mend(device: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--device", device]) == 2
    text = capsys.readouterr().err
    assert f"--device {device}" in text
    assert "hint:" in text


def test_json_errors_are_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "missing.yaml", "-o", "x", "--json"]) == 2
    captured = capsys.readouterr()
    value = json.loads(captured.out)
    assert value["exit_code"] == 2
    assert "missing.yaml" in value["error"]["message"]
    assert value["error"]["hint"]
    assert "missing.yaml" in captured.err
    assert not Path("x").exists()


def test_json_after_wrong_words_is_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["exit_code"] == 2


def test_unexpected_failure_exits_1_without_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("boom")

    monkeypatch.setattr("gsfluent.inspection.doctor.examine", fail)
    monkeypatch.delenv("GSFLUENT_DEBUG", raising=False)
    assert main(["doctor"]) == 1
    text = capsys.readouterr().err
    assert "boom" in text and "Traceback" not in text
    monkeypatch.setenv("GSFLUENT_DEBUG", "1")
    assert main(["doctor"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_doctor_reports_and_tests_every_op(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json", "--device", "cpu"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] is True
    assert report["torch"] == torch.__version__
    names = {"p2g", "grid_update", "g2p", "return_mapping", "rasterize", "mvee"}
    names |= {"photometric_loss", "adam_step"}
    assert names <= set(report["ops"])
    assert all("cpu" in report["ops"][name] for name in names)
    assert {test["op"] for test in report["self_test"]} == names


def test_doctor_finds_a_wrong_op(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gsfluent import ops

    right = ops.g2p

    def off(*args: object, **options: object) -> object:
        x, v, c, f = right(*args, **options)  # type: ignore[call-overload]
        return x, v * 1.01, c, f

    monkeypatch.setattr(ops, "g2p", off)
    assert main(["doctor", "--json", "--device", "cpu"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert [test["op"] for test in report["self_test"] if not test["ok"]] == ["g2p"]


def test_python_dash_m_runs_the_same_command_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "gsfluent", "--version"],
        capture_output=True,
        text=True,
        env=os.environ,
        check=False,
    )
    assert done.returncode == 0
    assert done.stdout.startswith("gsfluent ")


@pytest.mark.parametrize("text", ["1280", "1281x720", "0x0", "ax b", "10x10"])
def test_wrong_sizes_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="--size"):
        parse_size(text)


def test_sizes_are_read() -> None:
    assert parse_size("1280x720") == (1280, 720)


def test_json_has_no_nan() -> None:
    text = to_json({"a": float("nan"), "b": [float("inf"), 1.0], "c": Path("x"), "d": (1, 2)})
    assert json.loads(text) == {"a": None, "b": [None, 1.0], "c": "x", "d": [1, 2]}


def test_logging_is_left_as_it_was() -> None:
    import logging

    logger = logging.getLogger("gsfluent")
    before = (list(logger.handlers), logger.level, logger.propagate)
    assert main(["demo", "brick"]) == 2
    assert (logger.handlers, logger.level, logger.propagate) == before


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["--version"]])
def test_words_cost_no_torch(words: list[str]) -> None:
    """Help is read by people who wait for it: importing torch takes seconds."""
    program = (
        "import sys; from gsfluent.cli import main; code = main(sys.argv[1:]); "
        "sys.exit(code or any(name in sys.modules for name in ('torch', 'numpy', 'scipy')))"
    )
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
