"""What FOCUS's exploration reward pays for in Cube move, by world model: the cube's motion or the arm's.

    python docs/results/exploration/entropy.py focus_lcp=cube_move/focus_lcp focus_explore=runs/checkpoint.zip
        --dataset data/cube_move [--episodes 80] [--output FOLDER]

Every agent sees the same episodes, without their first ten frames. The entropy of the cube's latent in each third frame
among all of them, as the reward has it (k = 30 neighbours), is averaged over frames in which the cube has moved by
more than 2 cm, those in which it has not while the gripper is low (below 10 cm) or high (above 40 cm), all with the
cube in sight, and those in which it is hidden. Agents are names or files, as ``load_agent`` takes them. Prints a
table and writes it as ``entropy.md`` and ``entropy.json``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_ocwm.agents import load_agent
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.modules import particle_entropy

HEAD = ["| world model | frames | share of frames | entropy, cube | entropy, background |", "|---|---|---|---|---|"]
START, EVERY = 10, 3


def read(path: Path, episodes: int) -> TensorDict:
    """``[episodes, T]`` records, evenly out of the dataset; all episodes have the same length."""
    with EpisodeDataset.open(path) as dataset:
        if dataset.task.name != "cube_move":
            raise SystemExit(f"{path} is of {dataset.task.name}; only Cube move's proprioception ends with the gripper")
        chosen = torch.linspace(0, len(dataset) - 1, episodes).long().tolist()
        return torch.stack([dataset[at].to_tensordict() for at in chosen])


def groups(records: TensorDict) -> dict[str, Tensor]:
    """Name → which of the frames that are looked at ``[episodes, T]`` belong to it."""
    cube = records["next", "object_position_true"][:, :, 0]
    moved = (cube - cube[:, :1]).norm(dim=-1) > 0.02
    seen, height = records["next", "object_visible"][:, :, 0], records["next", "proprio"][:, :, -1]
    found = {
        "cube moved": seen & moved,
        "cube at its start, gripper low": seen & ~moved & (height < 0.1),
        "cube at its start, gripper high": seen & ~moved & (height > 0.4),
        "cube hidden": ~seen,
    }
    return {name: frames[:, START::EVERY] for name, frames in found.items()}


@torch.no_grad()
def measure(name: str, records: TensorDict) -> dict[str, dict[str, float]]:
    """Group of frames → its share, and the entropies of the two latents."""
    model = load_agent(name).agent.model
    torch.manual_seed(0)  # what is seen is a distribution, of which a state is drawn
    latents = model.records()(records.clone())["next", "object_latent"][:, START::EVERY]
    particles = latents.flatten(0, 1).transpose(0, 1)
    cube, background = particle_entropy(particles, k=30, clip=1e-4).unflatten(-1, latents.shape[:2])
    entropies = {"cube": cube, "background": background}
    return {
        group: {"share": frames.float().mean().item()}
        | {name: entropy[frames].mean().item() for name, entropy in entropies.items()}
        for group, frames in groups(records).items()
        if frames.any()
    }


def table(measured: dict[str, dict[str, dict[str, float]]]) -> str:
    """A line for each world model and group."""
    lines = [
        f"| {name} | {group} | {one['share']:.0%} | {one['cube']:.2f} | {one['background']:.2f} |"
        for name, found in measured.items()
        for group, one in found.items()
    ]
    return "\n".join([*HEAD, *lines])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("agents", nargs="+", metavar="NAME=AGENT")
    parser.add_argument("--dataset", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=80)
    parser.add_argument("--output", type=Path, default=Path("outputs/exploration"))
    arguments = parser.parse_args()
    records = read(arguments.dataset, arguments.episodes)
    named = (one.partition("=") for one in arguments.agents)
    measured = {name: measure(agent, records) for name, _, agent in named}
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "entropy.md").write_text(table(measured) + "\n", encoding="utf-8")
    (arguments.output / "entropy.json").write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")
    print(table(measured))


if __name__ == "__main__":
    main()
