#!/usr/bin/env bash
# From a fresh clone to a test report: installs into .venv with the developers' tools, checks style and types, runs pytest.
# Arguments go to pytest:  bash scripts/test.sh tests/cli -k help
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. scripts/setup.sh
prepare test
if [ $# -eq 0 ]; then
  "$PYTHON" -m ruff check .
  "$PYTHON" -m ruff format --check .
  "$PYTHON" -m mypy
  find csrc -name '*.h' -o -name '*.cpp' -o -name '*.cu' | sort | xargs "$(dirname "$PYTHON")/clang-format" --dry-run -Werror
fi
exec "$PYTHON" -m pytest "$@"
