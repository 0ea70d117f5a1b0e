"""scripts/stages/silence.py: silences are found, on a terminal and in a pipe."""

from __future__ import annotations

import sys

import pytest
from loaded_scripts import load_script

SAYS = "import sys, time; print('first'); time.sleep(0.3); print(sys.stdout.isatty()); sys.exit(3)"


@pytest.mark.parametrize("terminal", [False, True])
def test_a_silence_is_found(terminal: bool) -> None:
    silence = load_script("stages/silence")
    heard = silence.listen([sys.executable, "-c", SAYS], terminal)
    assert heard.code == 3
    assert heard.seconds >= heard.longest >= 0.25
    assert heard.before in ("first", "(start)")  # a busy machine starts slowly


def test_the_worse_of_both_is_named() -> None:
    silence = load_script("stages/silence")
    piped, drawn = silence.Heard(9.0, 1.0, "soon", 0), silence.Heard(9.0, 2.0, "late", 0)
    line = silence.table({"plan": (piped, drawn)}).splitlines()[-1]
    assert line == "| plan | 9 | 1.0 | 2.0 | late |"


def test_rows_of_what_was_not_run_stay_and_all_stand_in_order() -> None:
    silence = load_script("stages/silence")
    heard = silence.Heard(3.0, 1.0, "soon", 0)
    page = "| plan | 9 | 1.0 | 2.0 | late |\n| render | 8 | 1.0 | 2.0 | later |\n"
    rows = silence.table({"fill": (heard, heard), "plan": (heard, heard)}, page).splitlines()[2:]
    assert [row.split(" | ")[:2] for row in rows] == [
        ["| plan", "3"], ["| fill", "3"], ["| render", "8"],
    ]  # fmt: skip
