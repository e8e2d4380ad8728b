#!/usr/bin/env bash
# FOCUS + LCP before and after all goal latents were given one length: the same data, seeds and updates, one thread.
# Run from the repository root in a checkout of this repository with git; what is done already is not done again.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} OMP_NUM_THREADS=1
here=$PWD/docs/results/reacher/goal_length runs=$PWD/outputs/reacher/goal_length
declare -A commits=([before]=8937f01 [after]=2978348)

for when in before after; do
  tree=$runs/$when/tree
  [ -e "$tree" ] || git worktree add --detach "$tree" "${commits[$when]}"
  cd "$tree"
  export PYTHONPATH=$tree
  python examples/collect.py env=reacher steps=50000 dataset="$runs/data"
  checkpoints=()
  for seed in ${SEEDS:-0 1}; do
    output=$runs/$when/seed_$seed
    python examples/train_offline.py agent=focus_lcp env=reacher size=cpu dataset="$runs/data" output="$output" \
      training.seed="$seed" training.updates=1500 training.threads=1 training.eval_interval=0 training.video_interval=0
    checkpoints+=("$output/checkpoint.zip")
  done
  python examples/evaluate.py goals=100 image_goals=true random=false video_goals=0 workers=1 envs=10 \
    output="$runs/$when/evaluation" "checkpoint=[$(IFS=,; echo "${checkpoints[*]}")]"
  cp "$runs/$when/evaluation/results.json" "$here/$when.json"
done
