#!/usr/bin/env bash
# How much of the workspace an object visits, and how often it moves, by who acts: nobody who learns (random, scripted), or
# an explorer that learns from its own data (plan2explore, focus_explore). As many steps for each, one seed, one thread.
# Run from the repository root; what is done already is not done again.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0 OMP_NUM_THREADS=1
here=docs/results/exploration runs=outputs/exploration ratio=${RATIO:-0.1}

explore() {  # environment, steps, steps of an episode, seed steps, other settings of the environment
  local env=$1 steps=$2 horizon=$3 seed_steps=$4 options=(env.options.horizon="$3" "${@:5}") data=$runs/$1
  for policy in random scripted; do
    python examples/collect.py env="$env" "${options[@]}" policy=$policy steps="$steps" dataset="$data/$policy"
  done
  for explorer in plan2explore focus_explore; do
    # Training beside the exploration is of no use here: the explorer and its world model are what learns.
    python examples/train_online.py agent=focus_pcp explore=$explorer env="$env" size=cpu "${options[@]}" \
      dataset="$data/$explorer" output="$runs/$env/run_$explorer" training.threads=1 \
      training.eval_interval=0 training.video_interval=0 \
      training.updates="$(awk "BEGIN {print 100 + $ratio * ($steps - $seed_steps)}")" \
      online.behaviours=[explore] online.steps="$steps" online.seed_steps=["$seed_steps"] online.update_ratio="$ratio" \
      online.workers=1
  done
  python $here/exploration.py random="$data/random" scripted="$data/scripted" plan2explore="$data/plan2explore" \
    focus_explore="$data/focus_explore" --output "$here/$env"
}
explore reacher "${REACHER_STEPS:-10000}" 100 1000
explore cube_move "${CUBE_STEPS:-5000}" 100 1000 env.options.image_size=32 env.options.mask_scale=5
