"""Tables on pages are those of the numbers beside them."""

from __future__ import annotations

import re

import pytest
from reading import RESULTS, ROOT, cell, report

REACHER = ["reacher", "reacher/ablations", "reacher/visual_goals", "reacher/planner"]


@pytest.mark.parametrize("name", [*REACHER, "cube_move", "cube_move/online", "cube_move/offline", "cube_move/colours"])
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


def test_the_stronger_baselines_in_the_readme() -> None:
    found = report("figures/table-reacher-cpu/reacher")
    scores = [cell(found, name, "final_score") for name in ("dreamer, weights 200", "focus, weights 200")]
    means = [cell(found, name, "final_score").split(" ")[0] for name in ("dreamer_pcp", "focus_lcp")]
    said = f"{scores[0]} and {scores[1]} after 1,500 updates, where `dreamer_pcp` has {float(means[0]):.2f} and"
    text = " ".join((ROOT / "README.md").read_text().split())
    assert f"{said} `focus_lcp` {float(means[1]):.2f} ([three seeds]" in text
    assert len(found.rows["focus_lcp"].runs) == 3


def test_cube_move_on_the_same_data_in_the_readme() -> None:
    found = report("figures/table-cube_move-cpu/cube_move")
    scores = {row: cell(found, row, "final_score") for row in found.rows}
    assert len(found.goals) == 100
    text = " ".join((ROOT / "README.md").read_text().split())
    seeds = {row: len(found.rows[row].seeds) for row in found.rows}
    assert f"`focus_lcp` scores {scores['focus_lcp']}, with images {scores['focus_lcp, image goals']}, " in text
    assert f"`focus_pcp` {scores['focus_pcp']}, `dreamer_pcp` {scores['dreamer_pcp']}, " in text
    for agent in ("focus", "dreamer"):
        light, heavy = (scores[f"{agent}, weights {weight}"] for weight in (1, 200))
        assert f"`{agent}` {light} with weights of 1 and {heavy} with 200, " in text
    assert f"random actions {scores['random']} ([all of it]" in text
    assert set(seeds.values()) == {2}


def test_goals_as_images_on_cube_move_in_the_readme() -> None:
    found = report("figures/visual_goals-cube_move-cpu/cube_move")
    cosine, temporal, lcp = (
        cell(found, f"{row}, image goals", "final_score") for row in ("lexa_cosine", "lexa_temporal", "focus_lcp")
    )
    text = " ".join((ROOT / "README.md").read_text().split())
    said = f"`lexa_cosine` has {cosine}, `lexa_temporal` {temporal} and `focus_lcp` {lcp} ([goals as images]"
    assert f"With goals as images and one of these seeds, {said}" in text
    in_the_table = report("figures/table-cube_move-cpu/cube_move").rows["focus_lcp"].runs
    assert set(found.rows["focus_lcp"].runs) < set(in_the_table)
