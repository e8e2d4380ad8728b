#!/usr/bin/env bash
# What Dreamer and FOCUS know, with and without a disc at the goal: of the reward in recorded frames, of the cube while
# they act, and of what their actions will do. Run from the repository root, after `ocwm reproduce figure=limits env=cube_move size=cpu seeds=1`.
set -eu
export MUJOCO_GL=${MUJOCO_GL:-egl} LP_NUM_THREADS=0 OMP_NUM_THREADS=1
here=docs/results/cube_move/limits runs=${RUNS:-outputs/evidence}
without=(dreamer-s0-1a919b70 dreamer-s0-bf44eb1a focus-s0-c927bc36 focus-s0-3ce3401a)
disc=(dreamer-s0-dcea93bb dreamer-s0-e86bdf1e focus-s0-2c04c63f focus-s0-60bd7c02)

look() {  # name, dataset, trainings
  local files=()
  for training in "${@:3}"; do files+=("$runs/trainings/cube_move-$training/checkpoint.zip"); done
  python docs/results/reacher/reward_prediction.py "${files[@]}" --dataset "$runs/datasets/$2/data" > "$here/reward_$1.md"
  python "$here/believed.py" "${files[@]}" > "$here/believed_$1.md"
  python "$here/imagined.py" "${files[@]}" > "$here/imagined_$1.md"
}
look without cube_move-focus_pcp-3bfa52f9 "${without[@]}"
look disc cube_move-focus_pcp-target-53806f1d "${disc[@]}"
python "$here/imagined.py" cube_move/dreamer_pcp > "$here/imagined_pcp.md"
