#!/usr/bin/env bash
# The comparison of docs/results/reacher: the same data, the same number of updates.
# Two runs at a time, one thread each. Run from the repository root; what is done already is not done again.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0
here=docs/results/reacher runs=outputs/reacher
python examples/collect.py env=reacher steps=100000 seed=0 dataset=data/reacher

train() {  # agent, seed
  python examples/train_offline.py agent="$1" env=reacher size=cpu dataset=data/reacher output="$runs/$1/cpu/seed_$2" \
    training.updates=8000 training.threads=1 training.seed="$2"
}
agents="dreamer dreamer_pcp focus focus_pcp focus_lcp"
for seed in 0 1; do
  (for agent in $agents; do train "$agent" $seed; done) &
done
wait

checkpoints=()
: > "$here/wall_time.txt"
for agent in $agents; do
  for seed in 0 1; do
    run=$runs/$agent/cpu/seed_$seed name=${agent}_seed_$seed
    checkpoints+=("$run/checkpoint.zip")
    cp "$run/config.yaml" "$here/$name.yaml"
    cp "$run/log/scalars/evaluation/final_score.csv" "$here/$name.csv"
    echo "$name $(($(stat -c %Y "$run/checkpoint.zip") - $(stat -c %Y "$run/config.yaml"))) s" >> "$here/wall_time.txt"
  done
done
python examples/evaluate.py goals=100 image_goals=true output=$here "checkpoint=[$(IFS=,; echo "${checkpoints[*]}")]"
python examples/diagnose.py checkpoint="$runs/focus_lcp/cpu/seed_0/checkpoint.zip" dataset=data/reacher \
  output=$here/diagnosis
