"""What the result pages say is in the files beside them."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import pytest

from torchrl_ocwm.evaluation import Report
from torchrl_ocwm.evaluation.report import COLUMNS, _cell

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"


def page(name: str) -> str:
    """A page with each run of white space as one blank."""
    return " ".join((RESULTS / name / "README.md").read_text().split())


def report(name: str) -> Report:
    return Report.load(RESULTS / name / "results.json")


def mean(report: Report, agent: str, metric: str, scale: float = 1) -> float:
    summary = report.summary(agent, metric)
    assert summary is not None
    return scale * summary[0]


def cell(report: Report, agent: str, metric: str) -> str:
    return _cell(report.summary(agent, metric), COLUMNS[metric][1])


def diagnosis(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Goal latents, and errors in millimetres after 15 steps."""
    numbers = json.loads((RESULTS / name / "diagnosis" / "diagnosis.json").read_text())
    after = {
        view: {kind: 1000 * values[0][14] for kind, values in curves.items()}
        for view, curves in numbers["errors"].items()
    }
    return numbers["goal_latents"], after


def curve(file: Path) -> dict[int, float]:
    with file.open() as lines:
        return {int(float(step)): float(value) for step, value in csv.reader(lines)}


@pytest.mark.parametrize("name", ["reacher", "reacher/ablations", "cube_move"])
def test_tables_are_those_of_the_numbers(name: str) -> None:
    table = report(name).markdown()
    assert (RESULTS / name / "results.md").read_text() == table + "\n"
    if (RESULTS / name / "README.md").exists():
        assert table in (RESULTS / name / "README.md").read_text()


def test_tables_of_the_readme() -> None:
    text = (ROOT / "README.md").read_text()
    for name in ("reacher", "cube_move"):
        for agent in report(name).rows:
            shown = f"`{agent}`".replace(", image goals`", "`, goals as images").replace("`random`", "random actions")
            score = cell(report(name), agent, "final_score")
            assert re.search(rf"^\| {shown}(, 7,500 updates.*)? \| {score} \|$", text, re.MULTILINE), (name, agent)


def reacher_sentences() -> list[str]:
    numbers, ablations = report("reacher"), report("reacher/ablations")
    goals, after = diagnosis("reacher")
    off = [mean(numbers, agent, "goal_error", 100) for agent in ("dreamer", "focus")]
    tip = [mean(numbers, agent, "entity_error", 1000) for agent in ("dreamer", "focus")]
    assert {f"{value:.0f}" for value in off} == {"16"}
    assert {f"{value:.0f}" for value in tip} == {"2"}
    pcp = sorted(mean(numbers, agent, "final_distance", 1000) for agent in ("focus_pcp", "dreamer_pcp"))
    known = sorted(mean(numbers, agent, "entity_error", 1000) for agent in ("focus_pcp", "dreamer_pcp"))
    assert [mean(numbers, agent, "success") for agent in ("focus_pcp", "dreamer_pcp", "focus_lcp")] == [1, 1, 1]
    lcp = mean(numbers, "focus_lcp", "final_distance", 1000)
    before = sorted(mean(ablations, agent, "final_distance", 100) for agent in ablations.rows if "image" not in agent)
    lost = numbers.per_goal("final_score")["focus_lcp"] - numbers.per_goal("final_score")["focus_lcp, image goals"]
    radius = numbers.goals.norm(dim=-1)
    at = {r: float(lost[(100 * radius).round() == r].mean()) for r in (5, 8, 22)}
    assert abs(at[5]) < 0.005
    assert at[8] == max(float(lost[(100 * radius).round() == r].mean()) for r in (100 * radius).round().unique())
    times = [line.split()[1] for line in (RESULTS / "reacher" / "wall_time.txt").read_text().splitlines()]
    minutes = sorted(int(seconds) / 60 for seconds in times)
    frames = goals["position, frame"], goals["image, frame"]
    assert [one["median_rank"] for one in frames] == [1, 1]
    first, apart = [one["ranked_first"] for one in frames], [1000 * one["distance"] for one in frames]
    seen = after["filtered"]["median"]
    sentences = [
        f"With PCP both stop {pcp[0]:.0f} to {pcp[1]:.0f} mm from their goals on average",
        f"both know where it is to {known[0]:.0f} to {known[1]:.0f} mm",
        f"{lcp:.0f} mm from its goals on average, and within 5 cm of all of them",
        f"it stayed {before[0]:.0f} to {before[-1]:.0f} cm off",
        f"Image goals cost LCP {lost.mean():.2f}**",
        f"A goal costs most, {at[8]:.2f}, at 8 cm from the origin, nothing at 5 cm, and {at[22]:.2f} at 22 cm",
        f"{float(lost[radius > 0.16].sum() / lost.sum()):.0%} of the loss is beyond 16 cm",
        f"for {first[0]:.0%} of the positions and {first[1]:.0%} of the images, median rank 1",
        f"{apart[0]:.1f} mm from the goal for positions, {apart[1]:.0f} mm for images",
        f"it is {frames[0]['cosine']:.3f}, and the decoder has lost nothing by it: {seen:.0f} mm",
        f"After 15 imagined steps the decoded position is {after['imagined']['median']:.0f} mm off",
        f"a guess that nothing moves is {after['unmoved']['median']:.0f} mm off",
        f"{minutes[0]:.0f} to {minutes[-1]:.0f} minutes",
    ]
    rows = {
        "| cosine | 1 | {} | 1 |": (ablations, "focus_lcp (lambda_positional=1.0, reward=latent_similarity)"),
        "| distance of the directions | 1 | {} | 2 |": (ablations, "focus_lcp (lambda_positional=1.0)"),
        "| distance of the directions | 100 | {} | 2 |": (numbers, "focus_lcp"),
    }
    for row, (source, agent) in rows.items():
        for kind, suffix in (("positions", ""), ("images", ", image goals")):
            cells = [cell(source, agent + suffix, metric) for metric in ("final_score", "success", "final_distance")]
            sentences.append(f"{row.format(kind)} {' | '.join(cells)} |")
    return sentences


def cube_move_sentences() -> list[str]:
    numbers = report("cube_move")
    goals, after = diagnosis("cube_move")
    scores = {name: curve(RESULTS / "cube_move" / f"focus_{name}_seed_0.csv") for name in ("pcp", "lcp")}
    rounds = {
        name: ", ".join(f"{values[step]:.2f}" for step in (7500, 10000, 12500, 15000))
        for name, values in scores.items()
    }
    score = {agent: mean(numbers, agent, "final_score") for agent in numbers.rows}
    missed = [int((numbers.rows[f"focus_{name}"].seeds[0]["success"] == 0).sum()) for name in ("pcp", "lcp")]
    imagined, real = (
        [mean(numbers, f"focus_{name}", metric, 100) for name in ("pcp", "lcp")]
        for metric in ("imagined_distance", "final_distance")
    )
    for name in ("pcp", "lcp"):
        returns = curve(RESULTS / "cube_move" / f"focus_{name}_seed_0_imagined_return.csv")
        assert min(returns, key=lambda step: returns[step]) == pytest.approx(600, abs=100)
    frames = goals["position, frame"], goals["image, frame"]
    apart = [1000 * one["distance"] for one in frames]
    metrics = ("imagined_distance", "goal_error", "entity_error")
    expected, goal, known = (mean(numbers, "dreamer", metric, 100) for metric in metrics)
    return [
        f"within 5 cm of {mean(numbers, 'focus_pcp', 'success'):.0%} of its goals",
        f"expects to end {expected:.0f} cm from the goal, and does",
        f"of its goal is {goal:.0f} cm off, while it knows the cube to {known:.1f} cm",
        f"{scores['pcp'][5000]:.2f} for PCP and {scores['lcp'][5000]:.2f} for LCP. After the four rounds",
        f"{rounds['pcp']} for [PCP]",
        f"{rounds['lcp']} for [LCP]",
        f"more than 5 cm off for {missed[0]} of 36 goals with PCP and {missed[1]} with LCP",
        f"expect to end {imagined[0]:.1f} and {imagined[1]:.1f} cm off on average",
        f"where it is {real[0]:.1f} and {real[1]:.1f}",
        f"LCP is behind PCP by {score['focus_pcp'] - score['focus_lcp']:.2f}, "
        f"image goals by {score['focus_lcp'] - score['focus_lcp, image goals']:.2f} more",
        f"Seen frames give the position to {after['filtered']['median']:.0f} mm in the median, "
        f"and imagined ones to {after['imagined']['median']:.0f} mm after 15 steps",
        f"better in the median ({after['unmoved']['median']:.0f} mm)",
        f"({after['unmoved']['upper']:.0f} mm against {after['imagined']['upper']:.0f} mm)",
        f"{apart[0]:.1f} mm beside it on average ({apart[1]:.1f} mm for an image)",
        f"for {frames[0]['ranked_first']:.0%} of positions",
    ]


@pytest.mark.parametrize(
    ("name", "sentence"),
    [("reacher", one) for one in reacher_sentences()] + [("cube_move", one) for one in cube_move_sentences()],
)
def test_sentence(name: str, sentence: str) -> None:
    assert sentence in page(name)


def test_goals_of_one_length() -> None:
    """The table, cell by cell."""
    text = page("reacher")
    scores = {}
    for when, commit in (("before", "8937f01"), ("after", "2978348")):
        numbers = json.loads((RESULTS / "reacher" / "goal_length" / f"{when}.json").read_text())["agents"]
        for row, goals in (("focus_lcp", "positions"), ("focus_lcp, image goals", "images")):
            means = {name: metric["mean"] for name, metric in numbers[row]["metrics"].items() if metric is not None}
            scores[when, goals] = round(means["final_score"], 2)
            cells = (f"{means['final_score']:.2f}", f"{means['success']:.2f}", f"{means['final_distance']:.3f}")
            label = f"{commit}, {when}" if goals == "positions" else ""
            assert f"| {label} | {goals} | {' | '.join(cells)} |".replace("|  |", "| |") in text
    lost = {when: scores[when, "positions"] - scores[when, "images"] for when in ("before", "after")}
    assert f"Images lost {lost['before']:.2f} to positions before, and lose {lost['after']:.2f} after" in text
    assert f"positions have {scores['before', 'positions'] - scores['after', 'positions']:.2f} less" in text
