"""Which side the loss of the latent positional encoder should train, and with which weight: short runs of FOCUS + LCP.

    python docs/results/reacher/positional_gradient.py [--updates 1500] [--seeds 0 1] [--parallel 2]

Run from the repository root, with a dataset from ``examples/collect.py`` in data/reacher. Runs that are done already
are not done again.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

# Side and weight. The weight is nothing to an encoder alone: the optimiser divides by the size of gradients.
GOAL = "agent.behaviours.reach.goal"
CHOICES = (("encoder", 1), ("latent", 1), ("both", 1), ("both", 10), ("both", 100))


def run(script: str, *settings: str) -> None:
    """One of the recipes."""
    subprocess.run([sys.executable, f"examples/{script}.py", *settings], check=True, stdout=subprocess.DEVNULL)


def measure(side: str, weight: int, seed: int, arguments: argparse.Namespace) -> list[str]:
    """Train, look at the goal latents, and give a row of the table."""
    output = Path(arguments.output) / f"{side}_{weight}" / f"seed_{seed}"
    updates, dataset = f"training.updates={arguments.updates}", f"dataset={arguments.dataset}"
    settings = ["agent=focus_lcp", "env=reacher", "size=cpu", "training.threads=1", "training.video_interval=0"]
    settings += [f"{GOAL}.gradient={side}", f"{GOAL}.weight={weight}", f"training.eval_interval={arguments.updates}"]
    run("train_offline", *settings, updates, dataset, f"training.seed={seed}", f"output={output}")
    looked_at = [f"checkpoint={output}/checkpoint.zip", dataset, "video_sequences=0", f"output={output}/diagnosis"]
    run("diagnose", *looked_at)
    with (output / "log/scalars/evaluation/final_score.csv").open() as file:
        score = float(list(csv.reader(file))[-1][1])
    latents = json.loads((output / "diagnosis/diagnosis.json").read_text())["goal_latents"]["position, frame"]
    numbers = (latents["cosine"], latents["median_rank"], 1000 * latents["distance"])
    return [side, str(weight), str(seed), f"{score:.3f}", *(f"{number:.2f}" for number in numbers)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=1500)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--parallel", type=int, default=2, help="runs at a time, one thread each")
    parser.add_argument("--dataset", default="data/reacher")
    parser.add_argument("--output", default="outputs/reacher/positional_gradient")
    arguments = parser.parse_args()
    head = [
        "trained by L_pos",
        "weight",
        "seed",
        "score, ten landmarks",
        "cosine",
        "median rank of 100",
        "best match, mm",
    ]
    print(f"{arguments.updates} updates\n\n| {' | '.join(head)} |\n|{'---|' * len(head)}")
    with ThreadPoolExecutor(arguments.parallel) as pool:
        jobs = [(*choice, seed) for seed in arguments.seeds for choice in CHOICES]
        for row in pool.map(lambda job: measure(*job, arguments), jobs):
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
