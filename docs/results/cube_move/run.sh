#!/usr/bin/env bash
# What docs/results/cube_move shows: three agents on the same data, the same number of updates.
# One thread each, two runs at a time. Run from the repository root; what is done already is not done again.
# On a GPU: SIZE=paper UPDATES=250000 STEPS=1000000 GOALS=100 DEVICE=cuda docs/results/cube_move/run.sh
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0
size=${SIZE:-cpu} updates=${UPDATES:-4000} steps=${STEPS:-32000} device=${DEVICE:-cpu}
here=docs/results/cube_move runs=outputs/cube_move
python examples/collect.py env=cube_move steps=$((steps * 25 / 32)) policy=scripted dataset=data/cube_move
python examples/collect.py env=cube_move steps="$steps" policy=random dataset=data/cube_move

train() {  # agent
  python examples/train_offline.py agent="$1" env=cube_move size="$size" dataset=data/cube_move \
    output="$runs/$1/$size/seed_0" training.updates="$updates" training.threads=1 training.device="$device" \
    training.eval_interval=$((updates / 8)) training.eval_episodes=5
}
(train focus_lcp; train dreamer) &
train focus_pcp
wait

checkpoints=()
: > "$here/wall_time.txt"
for agent in dreamer focus_pcp focus_lcp; do
  run=$runs/$agent/$size/seed_0 name=${agent}_seed_0
  checkpoints+=("$run/checkpoint.zip")
  cp "$run/.hydra/config.yaml" "$here/$name.yaml"
  cp "$run/log/scalars/evaluation/final_score.csv" "$here/$name.csv"
  echo "$name $(($(stat -c %Y "$run/checkpoint.zip") - $(stat -c %Y "$run/.hydra/config.yaml"))) s" >> "$here/wall_time.txt"
done
python examples/evaluate.py goals=${GOALS:-36} image_goals=true episode_steps=100 output=$here \
  "checkpoint=[$(IFS=,; echo "${checkpoints[*]}")]"
python examples/diagnose.py checkpoint="$runs/focus_lcp/$size/seed_0/checkpoint.zip" dataset=data/cube_move \
  output=$here/diagnosis
