#!/usr/bin/env bash
# Build the CPU operators with the address and undefined-behaviour sanitizers, and run their tests.
#
#     bash scripts/safety/sanitize.sh                          # all of tests/ops
#     bash scripts/safety/sanitize.sh tests/ops/test_mpm.py    # these only; any words of pytest
#
# Everything is built and run in a folder of its own (SANITIZE_DIR, default build/sanitize): the
# libraries of the checkout are not touched. The first report ends the process that makes it, and
# the script ends with its exit code. Leaks are not looked for: Python keeps what it has.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
root="$PWD"
python="${PYTHON:-python}"
folder="${SANITIZE_DIR:-$root/build/sanitize}"
[ $# -gt 0 ] || set -- tests/ops

flags="-fsanitize=address,undefined -fno-sanitize=vptr -fno-sanitize-recover=all -fno-omit-frame-pointer"
mkdir -p "$folder/package"
# what Python has beside the libraries
rm -rf "$folder/package/gsfluent"
cp -r gsfluent "$folder/package/"
rm -f "$folder"/package/gsfluent/*.so
# -O1 -g: fast enough, and reports name lines
DEBUG=1 GSFLUENT_CUDA=0 CFLAGS="$flags" CXXFLAGS="$flags" LDFLAGS="$flags" MAX_JOBS="${MAX_JOBS:-1}" \
    "$python" setup.py -q build_ext --build-lib "$folder/package" --build-temp "$folder/objects"

preload="$(gcc -print-file-name=libasan.so):$(gcc -print-file-name=libubsan.so):$(gcc -print-file-name=libstdc++.so)"
export ASAN_OPTIONS="detect_leaks=0:exitcode=66:allocator_may_return_null=1"
export UBSAN_OPTIONS="halt_on_error=1:exitcode=66"
export PYTHONPATH="$folder/package" OMP_NUM_THREADS="${OMP_NUM_THREADS:-2}"
# the operators must be those just built
LD_PRELOAD="$preload" "$python" -P -c "
import sys, gsfluent
sys.exit(not gsfluent.__file__.startswith('$folder/'))"
# -s: what pytest holds back is lost when a report ends it
LD_PRELOAD="$preload" "$python" -P -m pytest -q -s -p no:cacheprovider --timeout 3000 "$@"
