#!/usr/bin/env bash
# From a fresh clone to a test report: installs into .venv with the developers' tools, checks style and types, runs pytest.
#   bash scripts/test.sh                        # all of it
#   bash scripts/test.sh tests/pipeline/fill    # the tests of one room; arguments go to pytest: tests/cli -k help
#   bash scripts/test.sh --format               # put the style right: ruff format, ruff's own fixes, clang-format, in place
#   bash scripts/test.sh --docs                 # the documents: links, lengths, every command of README and guide
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
case ${1:-} in
  -h | --help) sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//;p}' "${BASH_SOURCE[0]}"; exit 0 ;;
esac
. scripts/setup.sh
prepare test

sources() { find csrc \( -name '*.h' -o -name '*.cpp' -o -name '*.cu' \) | sort; }
clang_format() { sources | xargs "$(dirname "$PYTHON")/clang-format" "$@"; }

case ${1:-} in
  --format)
    "$PYTHON" -m ruff check --fix-only .
    "$PYTHON" -m ruff format .
    clang_format -i
    exit ;;
  --docs)
    shift
    exec "$PYTHON" -m pytest tests/docs tests/config/test_shot_docs.py tests/config/test_physgaussian.py "$@" ;;
  "")
    # two processes of one thread each: most tests are too small for two threads
    export OMP_NUM_THREADS=1
    # libraries and tests are compiled once for all processes and kept: by one beside the checks
    unset PYTHONDONTWRITEBYTECODE
    export PYTHONPYCACHEPREFIX="$PWD/build/bytecode"
    "$PYTHON" -m pytest --collect-only -q > /dev/null 2>&1 &
    "$PYTHON" -m ruff check .
    "$PYTHON" -m ruff format --check .
    "$PYTHON" -m mypy
    clang_format --dry-run -Werror
    wait # what cannot be collected is said below
    set -- -n 2 --dist loadfile ;;
esac
exec "$PYTHON" -m pytest "$@"
