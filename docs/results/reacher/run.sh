#!/usr/bin/env bash
# The comparison of docs/results/reacher: the same data, the same number of updates.
# Two runs at a time, one thread each. Run from the repository root; what is done already is not done again.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0
here=docs/results/reacher runs=outputs/reacher
python examples/collect.py env=reacher steps=100000 seed=0 dataset=data/reacher

train() {  # folder, seed, further settings
  python examples/train_offline.py "${@:3}" env=reacher size=cpu dataset=data/reacher output="$runs/$1/cpu/seed_$2" \
    training.updates=8000 training.threads=1 training.seed="$2"
}
{ train dreamer_pcp 0 agent=dreamer_pcp; train dreamer_pcp 1 agent=dreamer_pcp; } &
{ train dreamer 0 agent=dreamer; train dreamer 1 agent=dreamer; } &
wait

checkpoints=()
: > "$here/wall_time.txt"
for run in dreamer/cpu/seed_0 dreamer/cpu/seed_1 dreamer_pcp/cpu/seed_0 dreamer_pcp/cpu/seed_1; do
  file=$runs/$run/checkpoint.zip
  checkpoints+=("$file")
  name=${run//\/cpu\//_}
  cp "$runs/$run/.hydra/config.yaml" "$here/$name.yaml"
  cp "$runs/$run/log/scalars/evaluation/final_score.csv" "$here/$name.csv"
  echo "$name $(($(stat -c %Y "$file") - $(stat -c %Y "$runs/$run/.hydra/config.yaml"))) s" >> "$here/wall_time.txt"
done
python examples/evaluate.py goals=100 output=$here "checkpoint=[$(IFS=,; echo "${checkpoints[*]}")]"
