"""A figure's page: table, pictures, settings, and how it was made."""

from __future__ import annotations

import csv
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from pathlib import Path

from torchrl_ocwm.envs import make_task
from torchrl_ocwm.evaluation.output import writing
from torchrl_ocwm.evaluation.plots import heatmap, learning_curves, metric_lines, read_scalar
from torchrl_ocwm.evaluation.report import COLUMNS, Report, ReportError
from torchrl_ocwm.evidence.command_line import written
from torchrl_ocwm.evidence.earlier import CURVES, IMAGE_GOALS, METRIC, RANDOM, random_run, save_records
from torchrl_ocwm.evidence.estimate import in_words
from torchrl_ocwm.evidence.figures import FIGURES, Figure
from torchrl_ocwm.evidence.plan import Result
from torchrl_ocwm.evidence.queue import in_order
from torchrl_ocwm.evidence.records import Record
from torchrl_ocwm.evidence.run import Run
from torchrl_ocwm.evidence.settings import Evidence

CURVE = {METRIC: "final score, landmark goals"}


def write_page(wanted: Evidence, results: Sequence[Result], root: Path) -> Path:
    """Write the page of a figure with what is done of it.

    Args:
        wanted: What is asked for.
        results: All that belongs to it.
        root: Folder of all runs.

    Returns:
        The page.

    Raises:
        OutputError: if it cannot be written.
        ReportError: if the results of an evaluation cannot be read.
    """
    figure = FIGURES[wanted.figure]
    folder = root / "figures" / "-".join([wanted.figure, *wanted.environments, wanted.size])
    runs = in_order(one.evaluated for one in results)
    records = {run.name: _record(run, root) for run in runs}
    parts = [f"# {figure.title}"]
    if missing := [run for run in runs if not records[run.name].done]:
        parts.append(f"{len(missing)} of {len(runs)} runs are not done yet: the numbers are of the others.")
    for env in wanted.environments:
        done = [one for one in results if one.env == env and records[one.evaluated.name].done]
        if done:
            parts += [*_section(env, figure, done, root, folder), *_shown(done, records)]
            parts += _collected_again(done, records)
    parts += ["## How it was made", _command(wanted), *_making(runs, records)]
    page = folder / "README.md"
    with writing(page) as file:
        file.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    save_records(folder, {name: record for name, record in records.items() if record.done})
    return page


def _record(run: Run, root: Path) -> Record:
    """What is known of a run; of one that was done elsewhere are no files here, and what a page said is kept."""
    record = Record.of(run, root)
    episodes, coverage = run.episodes(root) or record.episodes, run.coverage(root) or record.coverage
    return replace(record, episodes=episodes, coverage=coverage)


def read_report(done: Iterable[Result], root: Path) -> Report:
    """One report of several evaluations in one environment, with the rows' names in the figure.

    Raises:
        ReportError: if the results of one cannot be read, or were made with other goals.
    """
    whole: Report | None = None
    for one in done:
        file = root / one.evaluated.name / "results.json"
        report = Report.load(file)
        if whole is None:
            whole = Report(report.goals, {**report.settings, "seed": "that of the training"})
        if report.goals.shape != whole.goals.shape or not report.goals.allclose(whole.goals):
            raise ReportError(f"{file}: has other goals than those before it")
        for name, row in report.rows.items():
            _add(whole, one, name, row.seeds[0])
    assert whole is not None
    return whole


def _add(report: Report, one: Result, name: str, metrics: dict) -> None:
    """A row of one evaluation, which has one seed. Random actions count once, whoever they were played beside."""
    seed = random_run(one.evaluated.trained.seed)
    if name == RANDOM:
        if seed not in getattr(report.rows.get(name), "runs", ()):
            report.add(name, metrics, source="smooth actions", run=seed)
        return
    ours = one.row.name + (IMAGE_GOALS if name.endswith(IMAGE_GOALS) else "")
    report.add(ours, metrics, source=one.evaluated.trained.name, run=one.evaluated.name)


def _section(env: str, figure: Figure, done: Sequence[Result], root: Path, folder: Path) -> list[str]:
    """Table and pictures of one environment."""
    report, place = read_report(done, root), folder / env
    report.save(place)
    pictures, numbers = [], f"Goal by goal: [results.json]({env}/results.json)."
    for kind in figure.draws:
        if kind == "heatmap":
            data = done[0].evaluated.trained.data
            workspace = make_task(env, **data.options).workspace
            heatmap(place / "heatmap.png", report.per_goal("final_score"), workspace, title="final score")
        elif kind == "curves":
            if not learning_curves(place / "curves.png", _folders(done, root), CURVE):
                continue
            _save_curves(place / CURVES, _folders(done, root))
            numbers += f" Update by update: [{CURVES}]({env}/{CURVES})."
        else:
            metric_lines(place / "lines.png", _lines(figure, done, report), figure.places)
        pictures.append(f"![{kind}]({env}/{kind}.png)")
    steps = done[0].evaluated.episode_steps
    text = (
        f"{len(report.goals)} goals, {steps} steps each; ± is the standard error over seeds. IQM is the mean of the "
        "middle half of all seeds and goals; in brackets its 95% interval, a stratified bootstrap over seeds for each "
        f"goal. {numbers}"
    )
    return [f"## {env}", report.markdown(intervals=True), text, *pictures]


def _shown(done: Sequence[Result], records: dict[str, Record]) -> list[str]:
    """What each dataset shows of the objects: nobody learns to move what never moves.

    Where its episodes are known, only rows that had them are named.
    """
    rows: dict[str, dict[str, None]] = {}
    for one in done:
        trained = one.evaluated.trained
        if records[trained.data.name].episodes in ("", records[trained.name].episodes):
            rows.setdefault(trained.data.name, {})[f"`{one.row.name}`"] = None
    lines = [
        f"| {name} | {', '.join(learnt)} | {thing} | {seen['moves']:.1%} | {seen['visited']:.0%} |"
        for name, learnt in rows.items()
        for thing, seen in records[name].coverage.items()
    ]
    head = ["| data | rows | object | steps in which it moves | workspace visited |", "|---|---|---|---|---|"]
    return ["\n".join([*head, *lines])] if lines else []


def _collected_again(done: Sequence[Result], records: dict[str, Record]) -> list[str]:
    """Which rows had the same episodes, for each dataset that was collected more than once."""
    times: dict[str, dict[str, dict[str, None]]] = {}
    for one in done:
        trained = one.evaluated.trained
        collected = in_order([trained.data])[0].name  # targets are drawn into episodes that are there
        rows = times.setdefault(collected, {}).setdefault(records[trained.name].episodes, {})
        rows[f"`{one.row.name}` (seed {trained.seed})"] = None
    return [
        f"**Rows with other episodes**: {name} was collected {len(groups)} times, by the same settings. "
        f"These had the same: {'; '.join(', '.join(rows) for rows in groups.values())}."
        for name, groups in times.items()
        if len(groups) > 1
    ]


def _save_curves(path: Path, runs: dict[str, list[Path]]) -> None:
    """The numbers of the curves: one line for each score of each run."""
    with writing(path) as new, new.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file)
        lines.writerow(["agent", "run", "updates", METRIC.rpartition("/")[-1]])
        for agent, folders in runs.items():
            for folder in folders:
                for updates, score in zip(*(read_scalar(folder, METRIC) or ((), ())), strict=True):
                    lines.writerow([agent, folder.name, updates, f"{score:.4f}"])


def _folders(done: Sequence[Result], root: Path) -> dict[str, list[Path]]:
    runs: dict[str, list[Path]] = {}
    for one in done:
        runs.setdefault(one.row.name, []).append(root / one.evaluated.trained.name)
    return runs


def _lines(figure: Figure, done: Sequence[Result], report: Report) -> dict:
    """Metric → line → place → mean and error."""
    rows = {one.row.name: one.row for one in done}
    lines: dict = {COLUMNS[metric][0]: {} for metric in figure.metrics}
    for metric in figure.metrics:
        for name, row in rows.items():
            points = lines[COLUMNS[metric][0]].setdefault(row.line, {})
            points[row.at] = report.summary(name, metric)
    return lines


def _command(wanted: Evidence) -> str:
    values = {one.name: getattr(wanted, one.name) for one in fields(Evidence)}
    settings = [f"{name}={written(value)}" for name, value in values.items() if value not in (None, ())]
    return f"```bash\nocwm reproduce {shlex.join(settings)}\n```"


def _making(runs: Sequence[Run], records: dict[str, Record]) -> list[str]:
    """Machines, times, and each run with its settings."""
    done = [run for run in runs if records[run.name].done]
    machines = dict.fromkeys(records[run.name].machine for run in done)
    total = sum(records[run.name].seconds for run in done)
    lines = ["| run | settings | commit | wall time |", "|---|---|---|---|"]
    for run in done:
        record = records[run.name]
        lines.append(f"| {run.name} | {_settings(record)} | {record.commit} | {in_words(record.seconds)} |")
    return [f"On {' and '.join(machines)}; {in_words(total)} of runs in all.", "\n".join(lines)]


def _settings(record: Record) -> str:
    """The commands, without the paths that were theirs."""
    kept = ([part for part in command if not part.partition("=")[2].startswith("'")] for command in record.commands)
    return "; ".join(f"`{' '.join(command)}`" for command in kept)
