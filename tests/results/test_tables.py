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


SAME_DATA, IMAGES = "figures/table-cube_move-cpu/cube_move", "figures/visual_goals-cube_move-cpu/cube_move"


def test_tables_of_the_readme() -> None:
    text = (ROOT / "README.md").read_text()
    for name in ("reacher", SAME_DATA, IMAGES):
        rows = [agent for agent in report(name).rows if name != IMAGES or agent.startswith("lexa")]
        assert rows
        for agent in rows:
            row, _, how = agent.partition(", ")
            kind = f", {how.replace('image goals', 'goals as images')}" if how else ""
            shown = "random actions" if row == "random" else f"`{row}`{kind}"
            score = cell(report(name), agent, "final_score")
            assert re.search(rf"^\| {shown} \| {score} \|$", text, re.MULTILINE), (name, agent)


def test_the_stronger_baselines_in_the_readme() -> None:
    found = report("figures/table-reacher-cpu/reacher")
    scores = [cell(found, name, "final_score") for name in ("dreamer, weights 200", "focus, weights 200")]
    means = [cell(found, name, "final_score").split(" ")[0] for name in ("dreamer_pcp", "focus_lcp")]
    said = f"{scores[0]} and {scores[1]} after 1,500 updates, where `dreamer_pcp` has {float(means[0]):.2f} and"
    text = " ".join((ROOT / "README.md").read_text().split())
    assert f"{said} `focus_lcp` {float(means[1]):.2f} ([three seeds]" in text
    assert len(found.rows["focus_lcp"].runs) == 3


def test_how_the_agents_of_cube_move_were_scored() -> None:
    found, images = report(SAME_DATA), report(IMAGES)
    text = " ".join((ROOT / "README.md").read_text().split())
    assert f"{len(found.goals)} goals, two seeds, 15,000 updates, LEXA with one seed." in text
    assert {len(row.seeds) for row in found.rows.values()} == {2}
    assert {len(images.rows[f"lexa_{kind}, image goals"].seeds) for kind in ("cosine", "temporal")} == {1}
    assert set(images.rows["focus_lcp"].runs) < set(found.rows["focus_lcp"].runs)  # of the same data


def test_cube_move_in_turns_in_the_readme() -> None:
    found = report("cube_move")
    pcp, lcp, images = (cell(found, row, "final_score") for row in ("focus_pcp", "focus_lcp", "focus_lcp, image goals"))
    text = " ".join((ROOT / "README.md").read_text().split())
    assert f"on {len(found.goals)} goals and with one seed. In turns with acting, " in text
    assert f"acting, `focus_pcp` scores {pcp}, `focus_lcp` {lcp}, with images {images} ([how" in text
