r"""Where the gripper of Cube move is, and whether it hides the cube, in each part of a dataset.

    python docs/results/exploration/gripper.py focus_explore=data/focus_explore [--parts 10] [--output FOLDER]

Prints a table and writes it as ``gripper.md`` and ``gripper.json``: medians of the gripper's height above the place
where the cube starts and of its horizontal distance from the cube, and the share of frames in which the cube is hidden.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from torchrl_ocwm.data import EpisodeDataset

HEAD = ["| data | steps until | height, cm | distance, cm | cube hidden |", "|---|---|---|---|---|"]


def measure(path: Path, parts: int) -> dict[int, dict[str, float]]:
    """Steps until the end of a part → what is seen in it."""
    found = {}
    with EpisodeDataset.open(path) as dataset:
        if dataset.task.name != "cube_move":
            raise SystemExit(f"{path} is of {dataset.task.name}; only Cube move's proprioception ends with the gripper")
        frames, size = dataset.records["next"], len(dataset.records) // parts
        for part in range(parts):
            seen = frames[part * size : (part + 1) * size]
            gripper, cube = seen["proprio"][:, -3:], seen["object_position"][:, 0]
            found[round(dataset.num_steps * (part + 1) / parts)] = {
                "height": gripper[:, 2].median().item(),
                "distance": (gripper[:, :2] - cube).norm(dim=-1).median().item(),
                "hidden": 1 - seen["object_visible"][:, 0].float().mean().item(),
            }
    return found


def table(measured: dict[str, dict[int, dict[str, float]]]) -> str:
    """A line for each part."""
    lines = [
        f"| {name} | {steps:,} | {100 * one['height']:.0f} | {100 * one['distance']:.0f} | {one['hidden']:.1%} |"
        for name, parts in measured.items()
        for steps, one in parts.items()
    ]
    return "\n".join([*HEAD, *lines])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", metavar="NAME=FOLDER")
    parser.add_argument("--parts", type=int, default=10)
    parser.add_argument("--output", type=Path, default=Path("outputs/exploration"))
    arguments = parser.parse_args()
    named = (one.partition("=") for one in arguments.datasets)
    measured = {name: measure(Path(folder), arguments.parts) for name, _, folder in named}
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "gripper.md").write_text(table(measured) + "\n", encoding="utf-8")
    (arguments.output / "gripper.json").write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")
    print(table(measured))


if __name__ == "__main__":
    main()
