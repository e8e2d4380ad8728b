"""Scores of several agents and seeds as numbers and as a table."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_ocwm.evaluation.scores import mean_and_error

#: Metric → column of the table and digits after the point.
COLUMNS = {
    "final_score": ("final score", 2),
    "mean_score": ("mean score", 2),
    "success": ("success within 5 cm", 2),
    "final_distance": ("final distance, m", 3),
    "imagined_distance": ("final distance as imagined, m", 3),
    "entity_error": ("entity reconstruction error, m", 3),
    "goal_error": ("goal reconstruction error, m", 3),
}


@dataclass
class Report:
    """Collects what was measured, goal by goal, for each seed of each agent.

    Args:
        goals: ``[N, D]`` metres.
        settings: What else to write down, such as steps per episode; must fit in JSON.

    Examples:
        >>> report = Report(goals=torch.tensor([[0.1, 0.1], [0.2, 0.2]]))
        >>> report.add("dreamer_pcp", {"final_score": torch.tensor([0.8, 1.0])}, source="seed 0")
        >>> report.add("dreamer_pcp", {"final_score": torch.tensor([0.6, 0.8])}, source="seed 1")
        >>> print(report.markdown())
        | agent | seeds | final score |
        |---|---|---|
        | dreamer_pcp | 2 | 0.80 ± 0.10 |
    """

    goals: Tensor
    settings: dict[str, Any] = field(default_factory=dict)
    seeds: dict[str, list[dict[str, Tensor]]] = field(default_factory=dict)
    sources: dict[str, list[str]] = field(default_factory=dict)

    @classmethod
    def load(cls, file: str | Path) -> Report:
        """Read a ``results.json`` that :meth:`save` wrote.

        Raises:
            ValueError: if it is something else.
        """
        try:
            values = json.loads(Path(file).read_text())
            report = cls(torch.tensor(values["goals"]), values["settings"])
            for agent, row in values["agents"].items():
                for source, seed in zip(row["sources"], row["per_goal"], strict=True):
                    report.add(agent, {name: torch.tensor(one) for name, one in seed.items()}, source=source)
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{file}: not the results.json of an evaluation ({error!r})") from error
        return report

    def include(self, other: Report) -> None:
        """Add the rows of another report.

        Raises:
            ValueError: if it was made with other goals or settings.
        """
        if self.goals.shape != other.goals.shape or not torch.allclose(self.goals, other.goals):
            raise ValueError("these results were made with other goals")
        if self.settings != other.settings:
            raise ValueError(f"these results were made with other settings: {other.settings}, here {self.settings}")
        for agent, seeds in other.seeds.items():
            self.seeds.setdefault(agent, []).extend(seeds)
            self.sources.setdefault(agent, []).extend(other.sources[agent])

    def add(self, agent: str, metrics: dict[str, Tensor], *, source: str) -> None:
        """Add one seed of an agent: metric → ``[N]`` values, one per goal."""
        self.seeds.setdefault(agent, []).append(metrics)
        self.sources.setdefault(agent, []).append(source)

    def per_goal(self, metric: str) -> dict[str, Tensor]:
        """Agent → ``[N]``, the mean over its seeds."""
        return {agent: torch.stack([one[metric] for one in seeds]).mean(0) for agent, seeds in self.seeds.items()}

    def summary(self, agent: str, metric: str) -> tuple[float, float | None] | None:
        """Mean over goals and seeds and its standard error over seeds; ``None`` if it was not measured."""
        seeds = [one[metric].mean() for one in self.seeds[agent] if metric in one]
        return mean_and_error(torch.stack(seeds)) if seeds else None

    def markdown(self) -> str:
        """A table, one row per agent; a dash where there is nothing to measure."""
        columns = [name for name in COLUMNS if any(self.summary(agent, name) for agent in self.seeds)]
        lines = [
            "| " + " | ".join(["agent", "seeds", *(COLUMNS[name][0] for name in columns)]) + " |",
            "|" + "---|" * (2 + len(columns)),
        ]
        for agent, seeds in self.seeds.items():
            cells = [_cell(self.summary(agent, name), COLUMNS[name][1]) for name in columns]
            lines.append("| " + " | ".join([agent, str(len(seeds)), *cells]) + " |")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """All numbers, ready for JSON."""
        agents: dict[str, Any] = {}
        for agent, seeds in self.seeds.items():
            summaries = {name: self.summary(agent, name) for name in COLUMNS}
            agents[agent] = {
                "sources": self.sources[agent],
                "metrics": {
                    name: None if pair is None else {"mean": pair[0], "standard_error": pair[1]}
                    for name, pair in summaries.items()
                },
                "per_goal": [{name: values.tolist() for name, values in one.items()} for one in seeds],
            }
        return {"settings": self.settings, "goals": self.goals.tolist(), "agents": agents}

    def save(self, folder: str | Path) -> None:
        """Write ``results.json`` and ``results.md``, each in one step."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        _replace(folder / "results.json", json.dumps(self.to_dict(), indent=1) + "\n")
        _replace(folder / "results.md", self.markdown() + "\n")


def _cell(pair: tuple[float, float | None] | None, digits: int) -> str:
    if pair is None:
        return "–"
    mean, error = pair
    return f"{mean:.{digits}f}" if error is None else f"{mean:.{digits}f} ± {error:.{digits}f}"


def _replace(file: Path, text: str) -> None:
    draft = file.with_name(f".{file.name}.draft")
    draft.write_text(text)
    os.replace(draft, file)
