#!/usr/bin/env bash
# What docs/results/cube_move shows: scripted and random data first; then, in rounds, two agents train, act, and train on
# what they did. Dreamer trains on the same data. One thread each, two runs at a time. Run from the repository root; what
# is done already is not done again.
# Small images make updates cheap.
# On a GPU: SIZE=paper IMAGE=64 FINER=3 UPDATES=50000 STEPS=300000 ROUNDS=8 GOALS=100 DEVICE=cuda \
#   docs/results/cube_move/run.sh
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0
size=${SIZE:-cpu} updates=${UPDATES:-5000} steps=${STEPS:-28000} rounds=${ROUNDS:-4} device=${DEVICE:-cpu}
image=${IMAGE:-32} finer=${FINER:-5}  # pixels, and how many times finer the segmentation is
here=docs/results/cube_move runs=outputs/cube_move data=data/cube_move

collect() {  # policy, steps in all
  python examples/collect.py env=cube_move env.options.image_size="$image" env.options.mask_scale="$finer" \
    env.options.horizon=100 policy="$1" steps="$2" dataset=$data
}
train() {  # agent, updates in all, share of the learning rates that is left
  python examples/train_offline.py agent="$1" env=cube_move size="$size" dataset=$data output="$(run "$1")" \
    training.updates="$2" training.final_lr="$3" "training.changed=[dataset,final_lr]" \
    training.eval_interval=$((updates / 2)) training.threads=1 training.device="$device"
}
run() {
  echo "$runs/$1/$size/seed_0"
}

collect scripted $((steps * 25 / 32))
collect random "$steps"
for round in $(seq 0 "$rounds"); do
  if [ "$round" -gt 0 ]; then  # each agent adds 9/64 of the first data
    collect "$(run focus_pcp)/checkpoint.zip" $((steps * (64 + 18 * round - 9) / 64))
    collect "$(run focus_lcp)/checkpoint.zip" $((steps * (64 + 18 * round) / 64))
  fi
  left=$([ "$round" -eq "$rounds" ] && echo 0.1 || echo 0.4)
  train focus_lcp $((updates + round * updates / 2)) "$left" &
  train focus_pcp $((updates + round * updates / 2)) "$left"
  wait
done
train dreamer $((updates + rounds * updates / 2)) 0.1

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
