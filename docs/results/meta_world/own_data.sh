#!/usr/bin/env bash
# An agent on Shelf place that acts itself while it learns, with all else as for the table's data, where FOCUS + PCP acts:
# as many steps and updates. One thread. Run from the repository root; what is done already is not done again.
#   docs/results/meta_world/own_data.sh focus_lcp
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0 OMP_NUM_THREADS=1
agent=$1 steps=${STEPS:-50000} scripted=${SCRIPTED:-18750} random=${RANDOM_STEPS:-6250} size=${SIZE:-cpu}
updates=${UPDATES:-15000} goals=${GOALS:-100}
here=docs/results/meta_world/shelf_place/own_data run=outputs/meta_world/own_data/$agent data=data/own_data_$agent

python examples/train_online.py agent="$agent" env=shelf_place size="$size" dataset="$data" output="$run" \
  training.updates="$updates" training.eval_interval=$((updates / 10)) training.eval_episodes=5 training.video_interval=0 \
  training.threads=1 env.options.image_size=32 env.options.mask_scale=5 env.options.horizon=60 \
  env.options.action_repeat=4 "online.seed_policy=[scripted,random]" "online.seed_steps=[$scripted,$random]" \
  online.seed_updates=$((updates / 3)) online.steps="$steps" online.round_episodes=104 online.update_ratio=0.4 \
  online.workers=0

mkdir -p "$here"
cp "$run/config.yaml" "$here/seed_0.yaml"
cp "$run/log/scalars/evaluation/final_score.csv" "$here/seed_0.csv"
cp "$run/log/scalars/collected/steps.csv" "$here/seed_0_steps.csv"
python examples/evaluate.py goals="$goals" image_goals=true episode_steps=60 envs=10 workers=0 output="$here" \
  checkpoint="$run/checkpoint.zip"
