#!/usr/bin/env bash
# Tries a wheel as a user has it: a new environment, no compiler, no checkout, on every Python that is named.
#   bash scripts/wheel_try.sh dist/gsfluent-*.whl                                  # python3
#   bash scripts/wheel_try.sh dist/gsfluent-*.whl python3.11:2.11.0 python3.13     # with that torch; with the newest
#   bash scripts/wheel_try.sh --demo dist/gsfluent-*.whl python3.12                # and the small demo
# Each installs what the wheel asks for and runs `gsfluent doctor`. Where the checkout is built in place (python setup.py
# build_ext --inplace), what operators compute is compared with it. Environments are removed unless KEEP=1.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
demo=0
case ${1:-} in
  -h | --help | "") sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//;p}' "${BASH_SOURCE[0]}"; exit 0 ;;
  --demo) demo=1; shift ;;
esac
wheel=$1
shift
[ -f "$wheel" ] || { echo "wheel_try.sh: $wheel: no such file; scripts/wheel.sh makes one" >&2; exit 2; }
[ $# -gt 0 ] || set -- python3
export PIP_DISABLE_PIP_VERSION_CHECK=1
top=$PWD
for word; do
  python=${word%%:*}
  torch=${word#"$python"}
  place=$(mktemp -d)
  [ "${KEEP:-0}" = 1 ] || trap 'rm -rf "$place"' EXIT
  "$python" -m venv "$place/venv"
  "$place/venv/bin/python" -m pip install --quiet --no-compile "$wheel" ${torch:+"torch==${torch#:}"}
  # nothing on the path but what was installed: no compiler, no toolkit, no other Python
  alone() { (cd "$place" && env -i HOME="$place" PATH="$place/venv/bin" OMP_WAIT_POLICY=PASSIVE OMP_NUM_THREADS="${OMP_NUM_THREADS:-2}" "$@"); }
  for tool in cc gcc g++ c++ clang nvcc ninja; do
    if alone "$place/venv/bin/python" -c "import shutil, sys; sys.exit(shutil.which('$tool') is None)"; then
      echo "wheel_try.sh: $tool is on the path" >&2
      exit 1
    fi
  done
  alone python -c 'import platform, torch; print("Python", platform.python_version(), "torch", torch.__version__)'
  alone gsfluent doctor --device cpu > "$place/doctor.txt" || { cat "$place/doctor.txt"; exit 1; }
  grep -E '^ *cuda_library' "$place/doctor.txt" || true
  said="bits not compared: the checkout is not built"
  if ls gsfluent/_C.*so > /dev/null 2>&1; then
    said="the same bits as the checkout"
    cp scripts/safety/bits.py "$place/"
    alone python -P bits.py > "$place/wheel.txt"
    alone PYTHONPATH="$top" python -P bits.py > "$place/checkout.txt"
    grep -q "^# $top/" "$place/checkout.txt" && ! grep -q "^# $top/" "$place/wheel.txt"
    sed -i '/^#/d' "$place/checkout.txt" "$place/wheel.txt"
    diff "$place/checkout.txt" "$place/wheel.txt" || { echo "wheel_try.sh: other bits than the checkout's" >&2; exit 1; }
  fi
  echo "doctor passes, $said; $(du -sm "$place/venv" | cut -f1) MB installed"
  if [ "$demo" = 1 ]; then
    alone gsfluent demo --size preview --device cpu -o "$place/demo" > "$place/demo.txt" || { cat "$place/demo.txt"; exit 1; }
    grep -E '^(verdict|reason|  (psnr|interior_error|fragments))' "$place/demo.txt"
    [ -s "$place/demo/video.mp4" ]
  fi
  [ "${KEEP:-0}" = 1 ] && echo "kept: $place" || rm -rf "$place"
done
