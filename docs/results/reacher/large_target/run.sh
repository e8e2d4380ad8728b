#!/usr/bin/env bash
# Dreamer with a disc of 12 pixels at the goal, four times as long as in the figure target_size, and how well it knows its
# reward then. One thread. Run from the repository root; what is done already is not done again.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0 OMP_NUM_THREADS=1
here=docs/results/reacher/large_target run=outputs/reacher/large_target data=${DATA:-data/reacher_large_target}
updates=${UPDATES:-6000}

for policy in scripted random; do  # steps=50000: all in all
  python examples/collect.py env=reacher env.options.horizon=100 env.options.virtual_target=12 policy=$policy \
    dataset="$data" steps=$([ $policy = scripted ] && echo 25000 || echo 50000)
done
python examples/train_offline.py agent=dreamer env=reacher size=cpu dataset="$data" output=$run \
  agent.world_model.lambda_object_position=1 agent.world_model.lambda_goal_position=1 \
  training.updates="$updates" training.threads=1 training.video_interval=0 \
  training.eval_interval=$((updates / 10)) training.eval_steps=150 training.eval_beside=false
cp $run/config.yaml $here/seed_0.yaml
cp $run/log/scalars/evaluation/final_score.csv $here/seed_0.csv
python docs/results/reacher/reward_prediction.py $run/checkpoint.zip --dataset "$data" > $here/reward.md
python examples/evaluate.py checkpoint=$run/checkpoint.zip goals=100 episode_steps=150 workers=0 random=false \
  video_goals=0 output=$here
