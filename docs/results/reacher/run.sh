#!/usr/bin/env bash
# The comparison of docs/results/reacher: the same data, the same number of updates, two seeds each.
# Two runs at a time, one thread each. Run from the repository root; what is done already is not done again.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0
python examples/collect.py env=reacher steps=100000 seed=0 dataset=data/reacher

train() {
  for seed in 0 1; do
    python examples/train_offline.py "$@" env=reacher size=cpu dataset=data/reacher \
      training.updates=8000 training.threads=1 training.seed=$seed
  done
}
train agent=dreamer_pcp &
train agent=dreamer &
wait

runs=outputs/reacher
python examples/evaluate.py goals=100 output=docs/results/reacher "checkpoint=[\
$runs/dreamer/cpu/seed_0/checkpoint.zip,$runs/dreamer/cpu/seed_1/checkpoint.zip,\
$runs/dreamer_pcp/cpu/seed_0/checkpoint.zip,$runs/dreamer_pcp/cpu/seed_1/checkpoint.zip]"
