#!/usr/bin/env bash
# On a GPU: how long updates take, and the first updates of FOCUS + PCP on the data of Cube move's figures
# (`ocwm reproduce figure=table env=cube_move`), whose folder is the argument. Run from the repository root.
set -eu
export PYTHONWARNINGS=ignore
here=docs/results/gpu speed="python benchmarks/update_speed.py --device cuda --rounds 5 --updates 10 --no-compile --agents focus_lcp"
{
  $speed --sizes cpu small
  $speed --sizes cpu --no-cudagraph
  $speed --sizes small --mixed-precision
} >$here/update_speed.txt
python benchmarks/sampling_share.py --agent focus_lcp --device cuda --no-compile --rounds 5 >$here/sampling_share.txt
timeout -s INT "${SECONDS_AT_MOST:-3600}" \
  ocwm train agent=focus_pcp env=cube_move size=cpu dataset="$1" output=outputs/gpu training.device=cuda training.compile=false \
  training.seed=2 training.updates=15000 training.eval_interval=0 training.video_interval=0 2>&1 | tr '\r' '\n' | tail -n 3 >$here/train.txt
