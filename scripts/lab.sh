#!/usr/bin/env bash
# The whole lab with one command: how far every op, scene and setting is from its known answer, what it costs, where it fails.
#   bash scripts/lab.sh                          # on the CPU: about half an hour on two cores; figures, tables and pages in out/lab
#   bash scripts/lab.sh --device cuda -o out/gpu # on a GPU: a few minutes
#   bash scripts/lab.sh --quick                  # a smoke subset, two minutes
#   bash scripts/lab.sh --only chart,stability   # some parts
#   bash scripts/lab.sh --enter                  # put what out/lab holds into docs/measured (tables, records, pictures); runs nothing
# Parts: ops battery bench shatter chart stability brittle. What is in the folder already is not run again.
# PYTHON=... names an interpreter that has gsfluent already; else one is set up in .venv.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
device=cpu out=out/lab quick= enter= parts=ops,battery,bench,shatter,chart,stability,brittle
while [ $# -gt 0 ]; do
  case $1 in
    --device | -o | --out | --only)
      [ $# -ge 2 ] || { echo "$1 needs a value" >&2; exit 2; }
      case $1 in --device) device=$2 ;; --only) parts=$2 ;; *) out=$2 ;; esac
      shift ;;
    --quick) quick=--quick ;;
    --enter) enter=yes ;;
    -h | --help) sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//;p}' "${BASH_SOURCE[0]}"; exit 0 ;;
    *) echo "unknown argument $1; see --help" >&2; exit 2 ;;
  esac
  shift
done
case $device in cpu | cuda) ;; *) echo "--device: cpu or cuda, not $device" >&2; exit 2 ;; esac
if [ -z "${PYTHON:-}" ]; then
  . scripts/setup.sh
  prepare test || exit 1
fi
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" OMP_WAIT_POLICY=PASSIVE
mkdir -p "$out" || exit 1
jobs=1
[ "$device" = cpu ] && jobs=$(getconf _NPROCESSORS_ONLN)
status=0 began=$SECONDS summary=()

# part NAME COMMAND...: run it if it was asked for; what it says goes to OUT/NAME.txt
part() {
  local name=$1 start=$SECONDS verdict=ok
  shift
  case ",$parts," in *",$name,"*) ;; *) return 0 ;; esac
  echo "--- $name"
  "$@" > "$out/$name.txt" 2> "$out/$name.log" || { verdict=FAILED status=1; tail -n 5 "$out/$name.log" "$out/$name.txt"; }
  summary+=("$(printf '%-10s %6d s  %s' "$name" $((SECONDS - start)) "$verdict")")
  echo "    ${summary[-1]}"
}

bench() {
  "$PYTHON" scripts/fracturebench/run_gsfluent.py -o "$out/runs" --device "$device" $quick &&
    "$PYTHON" scripts/fracturebench/table.py "$out/runs" --records "$out/fracturebench.jsonl" --page "$out/fracturebench.md"
}

brittle() {
  local which=()
  # on a GPU torch makes a thousand small calls a step; orders and debris are what a GPU can add
  [ "$device" = cuda ] && which=(--quick --parts order debris ejecta)
  "$PYTHON" scripts/study/brittle/run.py -o "$out/brittle.jsonl" --device "$device" $quick "${which[@]}"
}

if [ -z "$enter" ]; then
  part ops "$PYTHON" scripts/accuracy/ops.py --device "$device" --json "$out/ops.json" $quick
  battery_tier=(--tier all)
  [ -n "$quick" ] && battery_tier=(--only wave)
  part battery "$PYTHON" scripts/accuracy/battery.py --device "$device" --json "$out/battery.json" --known docs/measured/accuracy.md "${battery_tier[@]}"
  part bench bench
  part shatter "$PYTHON" scripts/fracturebench/shatter.py compare -o "$out/shatter.jsonl" --device "$device" $quick
  part chart "$PYTHON" -m gsfluent chart -o "$out/chart" --device "$device" $quick
  part stability "$PYTHON" -m gsfluent stability -o "$out/stability" --device "$device" --jobs $jobs $quick
  part brittle brittle
  printf '%s\n' "${summary[@]}" "$(printf '%-10s %6d s' all $((SECONDS - began)))" | tee "$out/seconds.txt"
  exit $status
fi

# have FILE: whether the lab left it; what was not run stays as it was in docs/measured
have() { [ -s "$out/$1" ]; }
keep() { have "$1" && mkdir -p docs/measured/data && cp "$out/$1" "docs/measured/data/$2"; }
set -e
if [ "$device" = cpu ]; then
  if have ops.json; then "$PYTHON" scripts/accuracy/ops.py --table "$out/ops.json" --markdown docs/measured/accuracy.md > /dev/null; fi
  if have battery.json; then "$PYTHON" scripts/accuracy/battery.py --json "$out/battery.json" --known docs/measured/accuracy.md --markdown docs/measured/accuracy.md > /dev/null; fi
  if keep shatter.jsonl shatter.jsonl; then "$PYTHON" scripts/fracturebench/shatter.py page; fi
elif have ops.json; then
  "$PYTHON" scripts/accuracy/ops.py --table "$out/ops.json" --markdown docs/measured/accuracy.md > /dev/null
fi
if have runs; then "$PYTHON" scripts/fracturebench/table.py "$out/runs" docs/measured/data/peers_*.jsonl > /dev/null; fi
if keep chart/chart.jsonl "chart_$device.jsonl"; then "$PYTHON" scripts/pictures/chart.py; fi
if keep stability/stability.jsonl "stability_$device.jsonl"; then
  "$PYTHON" scripts/pictures/stability.py docs/measured/data/stability_*.jsonl
fi
if keep brittle.jsonl "brittle_$device.jsonl"; then
  "$PYTHON" scripts/study/brittle/run.py -o docs/measured/data/brittle_*.jsonl --only-tables \
    --markdown docs/measured/brittle_gpu.md --figure docs/images/brittle_gpu.png > /dev/null
fi
echo "entered what $out holds into docs/measured"
