#!/usr/bin/env bash
# FOCUS + PCP on half acted, half scripted and random data of Cube move: 7,500 updates as a run of `ocwm reproduce`, then
# as many again. From the root of the repository; a run that was stopped goes on.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0 OMP_NUM_THREADS=1
evidence=outputs/evidence output=outputs/cube_move_more_updates
ocwm reproduce figure=table env=cube_move size=cpu seeds=1 updates=7500 'agents=[focus_pcp]' workers=1 output=$evidence
run=$(basename $evidence/trainings/cube_move-focus_pcp-s0-*)
data=$(basename $evidence/datasets/cube_move-focus_pcp-*)
[ -d $output/focus_pcp ] || { mkdir -p $output; cp -r $evidence/trainings/$run $output/focus_pcp; }
ocwm train agent=focus_pcp env=cube_move size=cpu training.seed=0 training.updates=15000 training.video_interval=0 \
  training.eval_interval=750 training.eval_episodes=5 training.eval_steps=100 training.eval_beside=false \
  training.threads=1 dataset=$evidence/datasets/$data/data output=$output/focus_pcp
ocwm evaluate goals=100 episode_steps=100 seed=0 workers=0 envs=10 random=false image_goals=false video_goals=9 \
  checkpoint=$output/focus_pcp/checkpoint.zip output=$output/evaluation
