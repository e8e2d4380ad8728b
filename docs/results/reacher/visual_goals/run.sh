#!/usr/bin/env bash
# Goals given as images: LEXA with both of its distances beside FOCUS + LCP, on the same data, updates and seeds.
# One thread. Run from the repository root; what is done already is not done again.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0 OMP_NUM_THREADS=1
here=docs/results/reacher/visual_goals runs=outputs/reacher/visual_goals updates=${UPDATES:-1500}
agents="lexa_cosine lexa_temporal focus_lcp"
python examples/collect.py env=reacher steps=50000 dataset=$runs/data

checkpoints=()
: > $here/wall_time.txt
for seed in ${SEEDS:-0 1}; do
  for agent in $agents; do
    run=$runs/$agent/cpu/seed_$seed name=${agent}_seed_$seed
    python examples/train_offline.py agent=$agent env=reacher size=cpu dataset=$runs/data output=$run \
      training.seed=$seed training.updates=$updates training.threads=1 training.eval_interval=0 training.video_interval=0
    checkpoints+=("$run/checkpoint.zip")
    cp $run/config.yaml $here/$name.yaml
    echo "$name $(($(stat -c %Y $run/checkpoint.zip) - $(stat -c %Y $run/config.yaml))) s" >> $here/wall_time.txt
  done
done
python examples/evaluate.py goals=36 image_goals=true workers=0 envs=18 output=$here \
  "checkpoint=[$(IFS=,; echo "${checkpoints[*]}")]"
