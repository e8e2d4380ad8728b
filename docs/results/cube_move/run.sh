#!/usr/bin/env bash
# Cube move from nothing: two agents that collect their own data, in rounds, after scripted and random steps; then a third
# on the data of one of them. One thread each, two runs at a time. Run from the repository root; what is done already is
# not done again. The numbers in README.md were made by the script of commit c1b4e61, in which two agents acted in turn.
# Small images make updates cheap.
# On a GPU: SIZE=paper IMAGE=64 FINER=3 UPDATES=50000 STEPS=300000 ROUNDS=8 GOALS=100 DEVICE=cuda \
#   docs/results/cube_move/run.sh
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0
size=${SIZE:-cpu} updates=${UPDATES:-5000} steps=${STEPS:-28000} rounds=${ROUNDS:-4} device=${DEVICE:-cpu}
image=${IMAGE:-32} finer=${FINER:-5}  # pixels, and how many times finer the segmentation is
here=docs/results/cube_move runs=outputs/cube_move data=data/cube_move

total=$((updates + rounds * updates / 2)) episodes=$((steps * 18 / 6400))  # of a round: 18/64 of the first steps
settings="size=$size training.updates=$total training.eval_interval=$((updates / 2)) training.threads=1
  training.device=$device"

run() {
  echo "$runs/$1/$size/seed_0"
}
online() {  # agent, dataset
  python examples/train_online.py agent="$1" env=cube_move $settings dataset="$2" output="$(run "$1")" \
    env.options.image_size="$image" env.options.mask_scale="$finer" env.options.horizon=100 \
    "online.seed_policy=[scripted,random]" "online.seed_steps=[$((steps * 25 / 32)),$((steps * 7 / 32))]" \
    online.seed_updates="$updates" online.round_episodes=$episodes \
    online.update_ratio="$(awk "BEGIN {print $updates / (200 * $episodes)}")"
}

online focus_pcp ${data}_focus_pcp &
online focus_lcp $data
wait
python examples/train_offline.py agent=dreamer env=cube_move $settings dataset=$data output="$(run dreamer)"

for agent in dreamer focus_pcp focus_lcp; do
  cp "$(run $agent)/config.yaml" $here/${agent}_seed_0.yaml
  cp "$(run $agent)/log/scalars/evaluation/final_score.csv" $here/${agent}_seed_0.csv
  cp "$(run $agent)/log/scalars/return_high.csv" $here/${agent}_seed_0_imagined_return.csv
done
python examples/diagnose.py checkpoint="$(run focus_lcp)/checkpoint.zip" dataset=$data \
  output=$here/diagnosis
python examples/evaluate.py goals=${GOALS:-36} image_goals=true episode_steps=100 workers=0 envs=18 \
  output=$here \
  "checkpoint=[$(run dreamer)/checkpoint.zip,$(run focus_pcp)/checkpoint.zip,$(run focus_lcp)/checkpoint.zip]"
