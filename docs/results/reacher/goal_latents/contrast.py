"""How much the latent of a position is like that of the object there, and how much like all others, in each row.

    python docs/results/reacher/goal_latents/contrast.py [--env reacher] [--evidence outputs/evidence] [--output FOLDER]

From the runs of ``ocwm reproduce figure=goal_latents seeds=1``: goal latents of positions beside those of 100 frames of
the data. Where a run is not here, the agent that comes with the package stands for ``focus_lcp``; others are left out.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from torchrl_ocwm.agents import shipped_agents
from torchrl_ocwm.evidence import Evidence, Record, Result, results

COLUMNS = {
    "cosine": "cosine",
    "cosine_with_others": "cosine with others",
    "contrast": "contrast",
    "median_rank": "median rank of 100",
    "distance": "best match, mm",
}


def checkpoint(one: Result, evidence: Path) -> str | None:
    """Where the trained agent of a row is."""
    run, shipped = one.evaluated.trained, f"{one.env}/{one.row.name}"
    file = evidence / run.name / "checkpoint.zip"
    if file.exists() and Record.of(run, evidence).done:
        return str(file)
    return shipped if shipped in shipped_agents() else None


def diagnose(name: str, data: Path, output: Path) -> dict[str, float]:
    """The numbers of ``ocwm diagnose``."""
    settings = [f"checkpoint={name}", f"dataset={data}", f"output={output}", "video_sequences=0"]
    command = [sys.executable, "-m", "torchrl_ocwm.console", "diagnose", *settings]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return json.loads((output / "diagnosis.json").read_text(encoding="utf-8"))["goal_latents"]["position, frame"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="reacher")
    parser.add_argument("--evidence", type=Path, default=Path("outputs/evidence"))
    parser.add_argument("--output", type=Path, default=Path("outputs/goal_latents"))
    arguments = parser.parse_args()
    print(f"| row | {' | '.join(COLUMNS.values())} |\n|---|{'---|' * len(COLUMNS)}")
    for one in results(Evidence(figure="goal_latents", env=arguments.env, seeds=1)):
        if name := checkpoint(one, arguments.evidence):
            data = arguments.evidence / one.evaluated.trained.data.name / "data"
            found = diagnose(name, data, arguments.output / one.evaluated.trained.name)
            found["distance"] *= 1000
            print(f"| {one.row.name} | {' | '.join(f'{found[key]:.3f}' for key in COLUMNS)} |", flush=True)


if __name__ == "__main__":
    main()
