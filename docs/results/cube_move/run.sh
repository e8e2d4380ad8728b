#!/usr/bin/env bash
# What docs/results/cube_move shows: three agents on scripted and random data; two of them then go on in rounds, in which
# they act and learn from it. One thread each, two runs at a time. Run from the repository root; what is done already is
# not done again.
# On a GPU: SIZE=paper UPDATES=50000 STEPS=300000 GOALS=100 DEVICE=cuda docs/results/cube_move/run.sh
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0
size=${SIZE:-cpu} updates=${UPDATES:-4000} steps=${STEPS:-32000} rounds=${ROUNDS:-9} device=${DEVICE:-cpu}
here=docs/results/cube_move first=outputs/cube_move own=outputs/cube_move_rounds

collect() {  # policy, steps, dataset
  python examples/collect.py env=cube_move policy="$1" steps="$2" dataset="$3"
}
train() {  # agent, runs, dataset, updates, share of the learning rates that is left
  python examples/train_offline.py agent="$1" env=cube_move size="$size" dataset="$3" output="$2/$1/$size/seed_0" \
    training.updates="$4" training.final_lr="$5" training.eval_interval=$((updates / 4)) training.eval_episodes=5 \
    training.threads=1 training.device="$device"
}
evaluate() {  # folder, runs, agents...
  local folder=$1 runs=$2 checkpoints=""
  shift 2
  mkdir -p "$folder"
  for agent in "$@"; do
    local run=$runs/$agent/$size/seed_0 name=${agent}_seed_0
    checkpoints+=,$run/checkpoint.zip
    cp "$run/.hydra/config.yaml" "$folder/$name.yaml"
    cp "$run/log/scalars/evaluation/final_score.csv" "$folder/$name.csv"
  done
  python examples/evaluate.py goals=${GOALS:-36} image_goals=true episode_steps=100 workers=0 envs=18 \
    output="$folder" "checkpoint=[${checkpoints#,}]"
}

collect scripted $((steps * 25 / 32)) data/cube_move
collect random "$steps" data/cube_move
(train focus_lcp $first data/cube_move "$updates" 0.1; train dreamer $first data/cube_move "$updates" 0.1) &
train focus_pcp $first data/cube_move "$updates" 0.1
wait
evaluate $here $first dreamer focus_pcp focus_lcp

if [ ! -d $own ]; then
  cp -r data/cube_move data/cube_move_rounds
  for agent in focus_pcp focus_lcp; do
    mkdir -p "$own/$agent"
    cp -r "$first/$agent/$size" "$own/$agent/"
  done
fi
for round in $(seq "$rounds"); do
  collect $own/focus_pcp/"$size"/seed_0/checkpoint.zip $((steps * (64 + 18 * round - 9) / 64)) data/cube_move_rounds
  collect $own/focus_lcp/"$size"/seed_0/checkpoint.zip $((steps * (64 + 18 * round) / 64)) data/cube_move_rounds
  left=$([ "$round" -gt $((rounds - 2)) ] && echo 0.1 || echo 0.4)
  train focus_lcp $own data/cube_move_rounds $((updates + round * updates / 2)) "$left" &
  train focus_pcp $own data/cube_move_rounds $((updates + round * updates / 2)) "$left"
  wait
done
python examples/diagnose.py checkpoint="$own/focus_lcp/$size/seed_0/checkpoint.zip" dataset=data/cube_move_rounds \
  output=$here/diagnosis
evaluate $here/rounds $own focus_lcp focus_pcp
