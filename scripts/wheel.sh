#!/usr/bin/env bash
# One wheel for every Python from 3.11, with the CPU library and, where the CUDA toolkit is, the one for GPUs; into dist/.
#   bash scripts/wheel.sh                     # all architectures of GSFLUENT_ARCH (default 80,90,100,120 and PTX)
#   GSFLUENT_ARCH=90 bash scripts/wheel.sh    # one GPU generation: a quarter of the time
#   bash scripts/wheel.sh --cpu               # without the library for GPUs: a minute
# auditwheel names the systems it runs on, abi3audit looks for what hangs on one Python. scripts/wheel_try.sh tries it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export GSFLUENT_CUDA=1 GSFLUENT_CORE=0 GSFLUENT_RELEASE=1 GSFLUENT_ARCH=${GSFLUENT_ARCH:-80,90,100,120}
case ${1:-} in
  -h | --help) sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//;p}' "${BASH_SOURCE[0]}"; exit 0 ;;
  --cpu) GSFLUENT_CUDA=0 ;;
  "") ;;
  *) echo "wheel.sh: $1: no such argument; see --help" >&2; exit 2 ;;
esac
. scripts/setup.sh
prepare wheel

if [ "$GSFLUENT_CUDA" = 1 ]; then
  for candidate in "${CUDA_HOME:-}" /usr/local/cuda-13.0 /usr/local/cuda; do
    [ -n "$candidate" ] && [ -x "$candidate/bin/nvcc" ] && break
  done
  [ -x "$candidate/bin/nvcc" ] || {
    echo "wheel.sh: no nvcc in CUDA_HOME, /usr/local/cuda-13.0 or /usr/local/cuda; set CUDA_HOME, or say --cpu" >&2
    exit 1
  }
  export CUDA_HOME=$candidate
fi

# a folder for each kind of wheel: what one has and the other has not must not stay in it
kind=cpu
[ "$GSFLUENT_CUDA" = 1 ] && kind=cuda-$GSFLUENT_ARCH
work=build/wheel/$kind
rm -rf "$work/lib" "$work/dist"
# --skip-build: bdist_wheel would build once more, and torch adds its flags to an extension each time, so all of it
# the same archive from the same commit
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct 2> /dev/null || echo 315532800)
export SOURCE_DATE_EPOCH
mkdir -p "$work"
"$PYTHON" setup.py -q build --build-base "$work" --build-lib "$work/lib" --build-temp "$work/temp" \
  bdist_wheel --skip-build --bdist-dir "$work/bdist" --dist-dir "$work/dist" > "$work/build.log" 2>&1 || {
  tail -n 40 "$work/build.log"
  echo "wheel.sh: it does not build; all of it is in $work/build.log" >&2
  exit 1
}

# torch brings its own libraries and CUDA's; what is older than a system's glibc says how new the system must be
PATH=$(dirname "$PYTHON"):$PATH
auditwheel repair --wheel-dir dist --exclude 'libtorch*' --exclude 'libc10*' --exclude 'libcudart*' \
  "$work"/dist/*.whl > "$work/audit.log" 2>&1 || { cat "$work/audit.log"; exit 1; }
wheel=$(ls -t dist/gsfluent-*.whl | head -n 1)
auditwheel show "$wheel"
abi3audit --strict --report "$wheel" > "$work/abi3.json" || { cat "$work/abi3.json"; exit 1; }
"$PYTHON" - "$wheel" << 'END'
import sys, zipfile
files = zipfile.ZipFile(sys.argv[1]).infolist()
for one in files:
    if one.filename.endswith(".so"):
        print(f"{one.filename}: {one.file_size / 1e6:.1f} MB, packed {one.compress_size / 1e6:.1f} MB")
END
echo "$wheel: $(($(stat -c %s "$wheel") / 1000)) kB"
