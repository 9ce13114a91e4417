#!/usr/bin/env bash
# The whole pipeline: demonstrations, co-design beside its yardstick, fine-tuning, evaluation and
# a report that shows both. One thread each: two processes for two cores. What a folder holds
# already is kept, and a run that was interrupted goes on.
#   scripts/codesign.sh [FOLDER] [SEED]
set -euo pipefail
out=${1:-runs/codesign}
seed=${2:-0}
mkdir -p "$out"
trap 'kill $(jobs -p) 2>/dev/null || true; wait' EXIT
step() { echo "[$SECONDS s] $*"; }

# learn FOLDER ARGUMENTS...: one run of `codesign policy ARGUMENTS`, from where it is to its end.
learn() {
  local folder=$1
  shift
  [ ! -f "$folder/policy.npz" ] || return 0
  [ ! -f "$folder/run.json" ] || set -- "$@" --resume
  codesign policy "$@" --out "$folder" --seed "$seed"
}

# yardstick: the original gripper, all of it.
yardstick() {
  learn "$out/original" train --space stock
  learn "$out/original-tuned" finetune "$out/original"
}

if [ ! -d "$out/demonstrations" ]; then
  step "demonstrations: three expert fingers fitted, one grasp with each"
  codesign policy demonstrate --space wide-12 --seed "$seed" --out "$out/demonstrations"
fi
step "co-design; beside it the original gripper (see $out/original.log)"
yardstick >>"$out/original.log" 2>&1 &
learn "$out/codesign" train --demonstrations "$out/demonstrations"
step "fine-tuning with more weight on stress"
learn "$out/codesign-tuned" finetune "$out/codesign"
wait $! || { echo "the original gripper's run failed: see $out/original.log" >&2; exit 1; }
step "evaluation: 50 episodes with each, 2,400 tetrahedra"
for name in codesign original; do
  codesign policy evaluate --checkpoint "$out/$name-tuned" --json >"$out/$name-evaluation.json"
done
codesign policy show "$out"/{codesign,original}{,-tuned} --out "$out/curves.png"
step "report: both pick up the same blocks over the graph"
codesign demo --policy "$out/codesign-tuned" --policy "$out/original-tuned" --out "$out/demo"
step "done: $out/demo/report.html"
