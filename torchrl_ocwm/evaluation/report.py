"""Scores of several agents and seeds as numbers and as a table."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_ocwm.errors import UserError
from torchrl_ocwm.evaluation.output import writing
from torchrl_ocwm.evaluation.scores import (
    bootstrap_interval,
    interquartile_mean,
    mean_and_error,
    score_is_undefined,
)
from torchrl_ocwm.files import seen_from

#: Metric → column of the table and digits after the point.
COLUMNS = {
    "final_score": ("final score", 2),
    "mean_score": ("mean score", 2),
    "success": ("success within 5 cm", 2),
    "final_distance": ("final distance, m", 3),
    "imagined_distance": ("final distance as imagined, m", 3),
    "entity_error": ("entity reconstruction error, m", 3),
    "goal_error": ("goal reconstruction error, m", 3),
    "predicted_return": ("return predicted at the start", 2),
    "obtained_return": ("return obtained", 2),
}
#: The metric that also gets an interval.
SCORE = "final_score"


class ReportError(UserError, ValueError):
    """Results that cannot be read, or do not go together."""


@dataclass
class Row:
    """The seeds of one agent.

    Args:
        kind: What tells the agent from others of its name, such as its settings in full.
        seeds: What was measured for each seed: metric → ``[N]`` values, one per goal, NaN where it is not defined.
        sources: Where each seed comes from: a file, or in words.
        runs: What tells one seed from another, whatever its file is called.
    """

    kind: str
    seeds: list[dict[str, Tensor]] = field(default_factory=list)
    sources: list[str | Path] = field(default_factory=list)
    runs: list[str] = field(default_factory=list)


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
    rows: dict[str, Row] = field(default_factory=dict)

    @classmethod
    def load(cls, file: str | Path) -> Report:
        """Read a ``results.json`` that :meth:`save` wrote.

        Raises:
            ReportError: if it is something else.
        """
        try:
            values = json.loads(Path(file).read_text(encoding="utf-8"))
            report = cls(torch.tensor(values["goals"]), values["settings"])
            for agent, row in values["agents"].items():
                runs = row.get("runs", row["sources"])  # older files know runs by their sources only
                sources = [_source(text, Path(file).parent) for text in row["sources"]]
                seeds = [_tensors(seed) for seed in row["per_goal"]]
                report.rows[agent] = Row(row.get("kind", agent), seeds, sources, runs)
        except (OSError, AttributeError, KeyError, TypeError, ValueError) as error:
            raise ReportError(f"{file}: not the results.json of an evaluation ({error!r})") from error
        return report

    def include(self, other: Report) -> None:
        """Add the rows of another report.

        Raises:
            ReportError: if it was made with other goals or settings, or holds a run that is here already.
        """
        if self.goals.shape != other.goals.shape or not torch.allclose(self.goals, other.goals):
            raise ReportError("these results were made with other goals")
        if self.settings != other.settings:
            raise ReportError(f"these results were made with other settings: {other.settings}, here {self.settings}")
        for agent, row in other.rows.items():
            for metrics, source, run in zip(row.seeds, row.sources, row.runs, strict=True):
                self.add(agent, metrics, source=source, run=run, kind=row.kind)

    def add(
        self,
        agent: str,
        metrics: dict[str, Tensor],
        *,
        source: str | Path,
        run: str | None = None,
        kind: str | None = None,
    ) -> None:
        """Add one seed of an agent.

        An agent of another kind than that of its name gets a row of its own, with a number behind the name.

        Args:
            agent: Its name.
            metrics: Metric → ``[N]`` values, one per goal, NaN where it is not defined.
            source: Where it comes from: the path of a checkpoint, or words.
            run: What tells it from other seeds, such as the contents of the checkpoint; the source by default.
            kind: What tells the agent from others of its name; nothing by default.

        Raises:
            ReportError: if the row has that run already.
        """
        kind, run = agent if kind is None else kind, str(source) if run is None else run
        row = self.rows.setdefault(self._row_name(agent, kind), Row(kind))
        if run in row.runs:
            raise ReportError(
                f"{source}: the same run as {row.sources[row.runs.index(run)]}, which counts as a seed of {agent} "
                "already; leave one of them out"
            )
        row.seeds.append(metrics)
        row.sources.append(source)
        row.runs.append(run)

    def _row_name(self, agent: str, kind: str) -> str:
        names = [agent, *(f"{agent} #{number}" for number in range(2, len(self.rows) + 2))]
        return next(name for name in names if name not in self.rows or self.rows[name].kind == kind)

    def per_goal(self, metric: str) -> dict[str, Tensor]:
        """Agent → ``[N]``, the mean over its seeds; NaN where it is not defined."""
        return {agent: torch.stack([one[metric] for one in row.seeds]).mean(0) for agent, row in self.rows.items()}

    def summary(self, agent: str, metric: str) -> tuple[float, float | None] | None:
        """Mean over goals and seeds and its standard error over seeds; ``None`` if it was not measured.

        Goals for which the metric is not defined are left out.
        """
        means = [one[metric].nanmean() for one in self.rows[agent].seeds if metric in one]
        seeds = torch.stack(means) if means else torch.empty(0)
        return mean_and_error(seeds) if len(seeds) and not seeds.isnan().any() else None

    def interval(self, agent: str, metric: str) -> tuple[float, tuple[float, float] | None] | None:
        """Interquartile mean over goals and seeds, and its 95% interval; ``None`` if it was not measured.

        Goals for which the metric is not defined are left out.
        """
        found = [one[metric] for one in self.rows[agent].seeds if metric in one]
        values = torch.stack(found) if found else torch.empty(0, 0)
        values = values[:, ~values.isnan().any(0)]
        return (float(interquartile_mean(values.flatten())), bootstrap_interval(values)) if values.numel() else None

    def markdown(self, *, intervals: bool = False) -> str:
        """A table, one row per agent; a dash where there is nothing to measure.

        Args:
            intervals: Also show the interquartile mean of the final score, with its interval.
        """
        columns = [name for name in COLUMNS if any(self.summary(agent, name) for agent in self.rows)]
        more = [f"{COLUMNS[SCORE][0]}, IQM [95%]"] * intervals
        lines = [
            "| " + " | ".join(["agent", "seeds", *more, *(COLUMNS[name][0] for name in columns)]) + " |",
            "|" + "---|" * (2 + len(more) + len(columns)),
        ]
        for agent, row in self.rows.items():
            cells = [_interval_cell(self.interval(agent, SCORE), COLUMNS[SCORE][1])] * intervals
            cells += [_cell(self.summary(agent, name), COLUMNS[name][1]) for name in columns]
            lines.append("| " + " | ".join([agent, str(len(row.seeds)), *cells]) + " |")
        at_start = int(score_is_undefined(self.goals).sum())
        if at_start:
            lines += ["", f"Without a score, as they lie at the start: {at_start} of {len(self.goals)} goals."]
        return "\n".join(lines)

    def to_dict(self, folder: str | Path = ".") -> dict[str, Any]:
        """All numbers, ready for JSON; paths as seen from a folder."""
        agents: dict[str, Any] = {}
        for agent, row in self.rows.items():
            summaries = {name: self.summary(agent, name) for name in COLUMNS}
            agents[agent] = {
                "kind": row.kind,
                "sources": [seen_from(folder, one) if isinstance(one, Path) else one for one in row.sources],
                "runs": row.runs,
                "metrics": {
                    name: None if pair is None else {"mean": pair[0], "standard_error": pair[1]}
                    for name, pair in summaries.items()
                },
                "per_goal": row.seeds,
            }
        return _plain({"settings": self.settings, "goals": self.goals, "agents": agents})

    def save(self, folder: str | Path) -> None:
        """Write ``results.json`` and ``results.md``, each in one step.

        Raises:
            OutputError: if they cannot be written; the files of before are then as they were.
        """
        with writing(Path(folder) / "results.json") as file:
            file.write_text(to_json(self.to_dict(folder)), encoding="utf-8")
        with writing(Path(folder) / "results.md") as file:
            file.write_text(self.markdown() + "\n", encoding="utf-8")


def to_json(values: Any) -> str:
    r"""JSON of values with tensors among them. JSON has no NaN and no infinity, so that they become ``null``.

    Examples:
        >>> to_json({"score": torch.tensor([0.5, float("nan")])})
        '{\n "score": [\n  0.5,\n  null\n ]\n}\n'
    """
    return json.dumps(_plain(values), indent=1, allow_nan=False) + "\n"


def _plain(values: Any) -> Any:
    if isinstance(values, dict):
        return {name: _plain(value) for name, value in values.items()}
    if isinstance(values, Tensor):
        return _plain(values.tolist())
    if isinstance(values, (list, tuple)):
        return [_plain(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values


def _source(text: str, folder: Path) -> str | Path:
    """A path begins with a dot (:func:`~torchrl_ocwm.files.seen_from`); all else, as of older files, is as it is."""
    return (folder / text).resolve() if text.startswith(".") else text


def _tensors(seed: dict[str, list[float | None]]) -> dict[str, Tensor]:
    return {
        name: torch.tensor([math.nan if value is None else value for value in values]) for name, values in seed.items()
    }


def _cell(pair: tuple[float, float | None] | None, digits: int) -> str:
    """Mean ± error; an error that would be shown as zero gets a digit more, and is rounded up."""
    if pair is None:
        return "–"
    mean, error = pair
    if error is None:
        return f"{mean:.{digits}f}"
    if 0 < error < 0.5 * 10**-digits:
        digits += 1
        error = math.ceil(error * 10**digits) / 10**digits
    return f"{mean:.{digits}f} ± {error:.{digits}f}"


def _interval_cell(found: tuple[float, tuple[float, float] | None] | None, digits: int) -> str:
    """Interquartile mean and interval, if there is one; with a digit more, as it is narrow with many goals."""
    if found is None:
        return "–"
    mean, ends = found
    digits += 1
    interval = "" if ends is None else f" [{ends[0]:.{digits}f}, {ends[1]:.{digits}f}]"
    return f"{mean:.{digits}f}{interval}"
