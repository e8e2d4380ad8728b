#!/usr/bin/env bash
# Shelf place or Pick & place from nothing, in one command: an agent that collects its own data, in rounds, after scripted
# and random steps. One thread. Run from the repository root; what is done already is not done again.
#   docs/results/meta_world/run.sh shelf_place focus_pcp
# Four control steps for each action: with one, imagination would not reach from the hand's start to the object.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0 OMP_NUM_THREADS=1
env=$1 agent=$2 size=${SIZE:-cpu} updates=${UPDATES:-12000} goals=${GOALS:-36}
here=docs/results/meta_world/$env/$agent run=outputs/meta_world/$env/$agent/$size/seed_0 data=data/${env}_$agent

python examples/train_online.py agent="$agent" env="$env" size="$size" dataset="$data" output="$run" \
  training.updates="$updates" training.eval_interval=1500 training.threads=1 \
  env.options.image_size=32 env.options.mask_scale=5 env.options.horizon=60 env.options.action_repeat=4 \
  "online.seed_policy=[scripted,random]" "online.seed_steps=[12000,3000]" online.seed_updates=3000 \
  online.round_episodes=60 online.update_ratio=0.5

mkdir -p "$here"
cp "$run/config.yaml" "$here/seed_0.yaml"
cp "$run/log/scalars/evaluation/final_score.csv" "$here/seed_0.csv"
cp "$run/log/scalars/collected/steps.csv" "$here/seed_0_steps.csv"
python examples/diagnose.py checkpoint="$run/checkpoint.zip" dataset="$data" output="$here/diagnosis"
python examples/evaluate.py goals="$goals" image_goals=true episode_steps=60 envs=18 workers=0 output="$here" \
  checkpoint="$run/checkpoint.zip"
