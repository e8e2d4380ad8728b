"""A whole figure, from nothing to its page."""

from __future__ import annotations

import csv
import json
import subprocess
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import pytest
import torch

from torchrl_ocwm.console import COMMANDS
from torchrl_ocwm.data import EpisodeDataset, dataset_coverage
from torchrl_ocwm.errors import UserError
from torchrl_ocwm.evaluation import Report
from torchrl_ocwm.evaluation.report import ReportError
from torchrl_ocwm.evidence import (
    FIGURES,
    Evidence,
    Machine,
    Record,
    Result,
    RunFailedError,
    in_order,
    page,
    queue,
    results,
    work_off,
    write_page,
)
from torchrl_ocwm.settings import to_dict
from torchrl_ocwm.training import CHECKPOINT
from torchrl_ocwm.training.provenance import trained_on


class Here:
    """Does jobs in this process, one at a time."""

    slots, failures = 1, (UserError,)

    def submit(self, perform: Callable[..., None], job: Any) -> Future[None]:
        future: Future[None] = Future()
        try:
            future.set_result(perform(job, Event(), {}))
        except UserError as error:
            future.set_exception(error)
        return future

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *error: object) -> None:
        pass


@pytest.fixture
def work(command: Callable[..., str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., list[str]]:
    """Work off a figure with the recipes in this process; what was run."""
    done: list[str] = []

    def run(job: Any, arguments: Any, *_: Any) -> None:
        done.append(job.folder.parent.name)
        said = command(COMMANDS[arguments[0]][0], *arguments[1:])
        if "Error" in said:
            raise RunFailedError(said)

    monkeypatch.setattr(queue, "_run", run)

    def go(wanted: list[Result]) -> list[str]:
        done.clear()
        runs = in_order(one.evaluated for one in wanted)
        work_off(runs, tmp_path, Machine(), Here())
        return list(done)

    return go


@pytest.mark.slow
def test_a_whole_figure(work: Callable[..., list[str]], tmp_path: Path) -> None:
    wanted = Evidence(figure="table", size="debug", seeds=1, steps=40, updates=2, goals=1)
    found = results(wanted)
    agents = len(FIGURES["table"].rows)
    assert work(found) == ["datasets"] * 2 + ["trainings", "evaluations"] * agents
    assert work(found) == []
    file = write_page(wanted, found, tmp_path)
    text, place = file.read_text(), file.parent / "reacher"
    assert file.parent == tmp_path / "figures" / "table-reacher-debug"
    report = Report.load(place / "results.json")
    names = [row.name for row in FIGURES["table"].rows]
    assert list(report.rows) == [*names[:-1], "random", names[-1], "focus_lcp, image goals"]
    assert report.markdown(intervals=True) in text
    assert "runs are not done" not in text
    for picture in ("heatmap", "curves"):
        assert f"![{picture}](reacher/{picture}.png)" in text
        assert (place / f"{picture}.png").stat().st_size > 1000
    with (place / "curves.csv").open(newline="", encoding="utf-8") as lines:
        curves = list(csv.reader(lines))
    assert curves[0] == ["agent", "run", "updates", "final_score"]
    assert {line[0] for line in curves[1:]} <= set(names)
    logged = next((tmp_path / found[0].evaluated.trained.name).rglob("scalars/evaluation/final_score.csv"))
    steps, scores = zip(*(line.split(",") for line in logged.read_text().split()), strict=True)
    first = [line for line in curves if line[1] == Path(found[0].evaluated.trained.name).name]
    assert [line[2] for line in first] == list(steps)
    assert [float(line[3]) for line in first] == pytest.approx([float(score) for score in scores], abs=1e-4)
    assert "(reacher/curves.csv)" in text
    assert "figure=table env=reacher size=debug seeds=1 steps=40 updates=2 goals=1" in text
    assert "`collect env=reacher" in text
    assert str(tmp_path) not in text
    trainings = [one.evaluated.trained for one in found]
    records = json.loads((file.parent / "runs.json").read_text(encoding="utf-8"))
    (episodes,) = {records[trained.name]["episodes"] for trained in trainings}
    assert episodes == trained_on(tmp_path / trainings[0].name / CHECKPOINT) != ""
    assert "other episodes" not in text
    data = trainings[0].data
    with EpisodeDataset.open(data.dataset(tmp_path)) as dataset:
        seen = dataset_coverage(dataset, dataset.task.objects, dataset.task.workspace)["finger"]
    assert records[data.name]["coverage"] == {"finger": seen._asdict()}
    assert records[data.name]["episodes"] == episodes
    shown = ", ".join(f"`{row.name}`" for row in FIGURES["table"].rows)
    assert f"| {data.name} | {shown} | finger | {seen.moves:.1%} | {seen.visited:.0%} |" in text
    record = Record.of(found[0].evaluated, tmp_path)
    assert record.machine in text
    assert record.commit in text
    returns = report.rows[names[0]].seeds[0]
    assert returns["obtained_return"].item() < 0
    assert abs(returns["predicted_return"].item()) < 1e-3  # a critic starts at zero
    assert "predicted_return" not in report.rows["focus_lcp"].seeds[0]  # whose critic has other rewards


# Pages of results that are made up.


def give(root: Path, one: Result, score: float, goals: int = 4) -> None:
    """Put what an evaluation and its needs leave into their folders."""
    report = Report(torch.arange(1, goals + 1).unsqueeze(-1) * torch.tensor([0.01, 0.01]), {"seed": 0})
    values = {"final_score": torch.full((goals,), score), "goal_error": torch.full((goals,), 1 - score)}
    report.add("dreamer (changed)", values, source="x", run=one.evaluated.name)
    if one.row.random:
        report.add("random", {"final_score": torch.full((goals,), 0.25)}, source="smooth actions")
        report.add("focus_lcp, image goals", values, source="x", run="y")
    report.save(root / one.evaluated.name)
    for run in in_order([one.evaluated]):
        Record(content=to_dict(run.content), pace=run.pace, work=run.work, seconds=3600, done=True).write(
            root / run.name
        )


def test_the_page_of_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = Evidence(figure="loss_scale", size="debug", seeds=2, goals=4)
    found = results(wanted)
    drawn: dict[str, Any] = {}
    monkeypatch.setattr(page, "metric_lines", lambda file, lines, places: drawn.update(lines, places=places))
    assert "17 of 17 runs are not done yet" in write_page(wanted, found, tmp_path).read_text()
    for number, one in enumerate(found[:6]):  # all weights of seed 0, two of seed 1
        give(tmp_path, one, number / 10)
    text = write_page(wanted, found, tmp_path).read_text()
    assert "4 of 17 runs are not done yet" in text
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| dreamer")]
    assert [(row[0], row[1]) for row in rows] == [
        (f"| dreamer, goal weight {weight}", seeds) for weight, seeds in ((1, "2"), (10, "2"), (100, "1"), (1000, "1"))
    ]
    assert rows[0][2:4] == ["0.200 [0.000, 0.400]", "0.20 ± 0.20"]
    assert rows[2][2:4] == ["0.200", "0.20"]
    assert "13.0 h of runs in all" in text
    assert drawn["places"] == "weight of the goal position"
    assert list(drawn["final score"]) == ["dreamer"]
    means = {place: pair[0] for place, pair in drawn["final score"]["dreamer"].items()}
    assert means == pytest.approx({"1": 0.2, "10": 0.3, "100": 0.2, "1000": 0.3})
    assert drawn["goal reconstruction error, m"]["dreamer"]["1"][0] == pytest.approx(0.8)
    assert set(drawn["success within 5 cm"]["dreamer"].values()) == {None}


def test_rows_with_other_episodes_are_named(tmp_path: Path) -> None:
    """Where the dataset was lost and collected again. Targets are drawn into the episodes of the plain one."""
    wanted = Evidence(figure="limits", size="debug", seeds=1, goals=4, env="cube_move")
    found = results(wanted)
    for number, one in enumerate(found):
        give(tmp_path, one, 0.5)
        trained = one.evaluated.trained
        record = replace(Record.of(trained, tmp_path), episodes="again" if number in (1, 2) else "first")
        record.write(tmp_path / trained.name)
    assert len({one.evaluated.trained.data.name for one in found}) == 2
    text = write_page(wanted, found, tmp_path).read_text(encoding="utf-8")
    (said,) = (line for line in text.splitlines() if line.startswith("**Rows with other episodes**"))
    assert in_order([found[0].evaluated])[0].name in said
    assert "collected 2 times" in said
    first, again = said.partition("the same: ")[2].rstrip(".").split("; ")
    names = [f"`{one.row.name}` (seed 0)" for one in found]
    assert again == ", ".join(names[1:3])
    assert first == ", ".join([names[0], *names[3:]])


def test_what_data_shows_of_the_objects(tmp_path: Path) -> None:
    """A line for each dataset and object; none for what no page and no file knows."""
    wanted = Evidence(figure="exploration", size="debug", seeds=1, goals=4)
    found = results(wanted)
    for number, one in enumerate(found):
        give(tmp_path, one, 0.5)
        data = one.evaluated.trained.data
        seen = {"cube": {"moves": number / 1000, "visited": 0.25}} if number else {}
        replace(Record.of(data, tmp_path), coverage=seen).write(tmp_path / data.name)
    text = write_page(wanted, found, tmp_path).read_text(encoding="utf-8")
    names = [one.evaluated.trained.data.name for one in found]
    assert [line for line in text.splitlines() if "| cube |" in line] == [
        f"| {name} | `{one.row.name}` | cube | 0.{number}% | 25% |"
        for number, (name, one) in enumerate(zip(names, found, strict=True))
        if number
    ]


def test_what_data_shows_is_said_of_rows_that_had_its_episodes(tmp_path: Path) -> None:
    """Not of those that learnt before it was lost and collected again, of which older pages do not know."""
    wanted = Evidence(figure="table", size="debug", seeds=1, goals=4)
    found = results(wanted)
    data = found[0].evaluated.trained.data
    assert {one.evaluated.trained.data.name for one in found} == {data.name}
    for one, episodes in zip(found, ("first", "again", *[""] * len(found)), strict=False):
        give(tmp_path, one, 0.5)
        trained = one.evaluated.trained
        replace(Record.of(trained, tmp_path), episodes=episodes).write(tmp_path / trained.name)
    seen = {"finger": {"moves": 0.5, "visited": 0.25}}
    replace(Record.of(data, tmp_path), episodes="again", coverage=seen).write(tmp_path / data.name)
    text = write_page(wanted, found, tmp_path).read_text(encoding="utf-8")
    assert f"| {data.name} | `{found[1].row.name}` | finger | 50.0% | 25% |" in text


def test_its_command_can_be_typed(tmp_path: Path) -> None:
    """A shell takes it apart as it was meant, whatever signs the names of rows have."""
    wanted = Evidence(figure="loss_scale", size="debug", agents=("dreamer, goal weight 10",))
    text = write_page(wanted, results(wanted), tmp_path).read_text()
    (command,) = (line for line in text.splitlines() if line.startswith("ocwm"))
    seen = subprocess.run(["sh", "-c", f"printf '%s\n' {command}"], capture_output=True, text=True, check=True)
    assert 'agents=["dreamer, goal weight 10"]' in seen.stdout.splitlines()


def test_random_actions_have_as_many_seeds(tmp_path: Path) -> None:
    """They are measured beside several agents in some figures, and count once for each seed."""
    found = results(Evidence(figure="exploration", size="debug", seeds=2, goals=4))
    for one in found:
        give(tmp_path, one, 0.5)
    report = page.read_report(found, tmp_path)
    assert len(report.rows["random"].seeds) == 2
    assert len(report.rows["focus_lcp on random"].seeds) == 2
    assert len(report.rows["focus_lcp on random, image goals"].seeds) == 2
    give(tmp_path, found[-1], 0.5, goals=9)
    with pytest.raises(ReportError, match="has other goals than those before it"):
        page.read_report(found, tmp_path)


def test_lines_are_drawn(tmp_path: Path) -> None:
    wanted = Evidence(figure="target_size", size="debug", seeds=1, goals=4)
    found = results(wanted)
    for one in found:
        give(tmp_path, one, 0.5)
    file = write_page(wanted, found, tmp_path).parent / "reacher" / "lines.png"
    assert file.stat().st_size > 1000


def test_each_environment_has_its_part(tmp_path: Path) -> None:
    wanted = Evidence(figure="curves", size="debug", seeds=1, goals=4, env=("reacher", "cube_move"))
    found = results(wanted)
    give(tmp_path, replace(found[0]), 0.5)
    give(tmp_path, next(one for one in found if one.env == "cube_move"), 0.25)
    text = write_page(wanted, found, tmp_path).read_text()
    assert text.index("## reacher") < text.index("0.500") < text.index("## cube_move") < text.index("0.250")
    assert json.loads((tmp_path / "figures/curves-reacher-cube_move-debug/cube_move/results.json").read_text())
