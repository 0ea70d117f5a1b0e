#!/usr/bin/env bash
# From a fresh clone to a video of a melon breaking: installs into .venv, then runs `gsfluent demo`.
# Arguments go to the demo:  bash scripts/demo.sh --size preview -o /tmp/melon
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. scripts/setup.sh
prepare demo
exec "$PYTHON" -P -m gsfluent demo "$@"
