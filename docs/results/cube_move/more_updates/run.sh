#!/usr/bin/env bash
# Agents on half acted, half scripted and random data of Cube move: 7,500 updates as runs of `ocwm reproduce`, then as many
# again. From the root of the repository; a run that was stopped goes on.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0 OMP_NUM_THREADS=1
evidence=outputs/evidence output=outputs/cube_move_more_updates agents=${AGENTS:-"focus_pcp focus_lcp"}
ocwm reproduce figure=table env=cube_move size=cpu seeds=1 updates=7500 "agents=[${agents// /,}]" output=$evidence
data=$(basename $evidence/datasets/cube_move-focus_pcp-*)
for agent in $agents; do
  run=$(basename $evidence/trainings/cube_move-$agent-s0-*)
  [ -d $output/$agent ] || { mkdir -p $output; cp -r $evidence/trainings/$run $output/$agent; }
  ocwm train agent=$agent env=cube_move size=cpu training.seed=0 training.updates=15000 training.video_interval=0 \
    training.eval_interval=750 training.eval_episodes=5 training.eval_steps=100 training.eval_beside=false \
    training.threads=1 dataset=$evidence/datasets/$data/data output=$output/$agent
  ocwm evaluate goals=100 episode_steps=100 seed=0 workers=0 envs=10 random=false image_goals=false video_goals=9 \
    checkpoint=$output/$agent/checkpoint.zip output=$output/evaluation_$agent
done
