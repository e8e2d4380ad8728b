#!/usr/bin/env bash
# Two runs of Dreamer that 1,500 updates do nothing for (figures target_size and loss_scale), four times as long, and how
# well they know their reward: a disc of 12 pixels at the goal, and a goal position that weighs 100. One thread.
# Run from the repository root; what is done already is not done again.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0 OMP_NUM_THREADS=1
here=docs/results/reacher/longer runs=outputs/reacher/longer updates=${UPDATES:-6000}

collect() {  # dataset, options: 25,000 scripted steps, then as many random ones
  python examples/collect.py env=reacher env.options.horizon=100 "${@:2}" policy=scripted dataset="$1" steps=25000
  python examples/collect.py env=reacher env.options.horizon=100 "${@:2}" policy=random dataset="$1" steps=50000
}
longer() {  # name, dataset, weight of the goal position
  local run=$runs/$1
  python examples/train_offline.py agent=dreamer env=reacher size=cpu dataset="$2" output="$run" \
    agent.world_model.lambda_object_position=1 agent.world_model.lambda_goal_position="$3" \
    training.updates="$updates" training.threads=1 training.video_interval=0 \
    training.eval_interval=$((updates / 10)) training.eval_steps=150 training.eval_beside=false
  mkdir -p "$here/$1"
  cp "$run/config.yaml" "$here/$1/seed_0.yaml"
  cp "$run/log/scalars/evaluation/final_score.csv" "$here/$1/seed_0.csv"
  python docs/results/reacher/reward_prediction.py "$run/checkpoint.zip" --dataset "$2" > "$here/$1/reward.md"
  python examples/evaluate.py checkpoint="$run/checkpoint.zip" goals=100 episode_steps=150 workers=0 random=false \
    video_goals=0 output="$here/$1"
}
plain=${PLAIN:-data/reacher_plain} target=${TARGET:-data/reacher_target_12}
collect "$plain"
longer goal_weight_100 "$plain" 100
collect "$target" env.options.virtual_target=12
longer target_12 "$target" 1
