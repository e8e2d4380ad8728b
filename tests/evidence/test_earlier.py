"""What a page knows of its runs stands for them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchrl_ocwm.evaluation import Report
from torchrl_ocwm.evidence import (
    LAUNCHERS,
    Evidence,
    Machine,
    Record,
    RecordError,
    Result,
    in_order,
    include,
    queue,
    results,
    to_do,
    work_off,
    write_page,
)
from torchrl_ocwm.settings import to_dict

WANTED = {"figure": "exploration", "size": "debug", "goals": 4}


def give(root: Path, found: list[Result]) -> None:
    """What evaluations and trainings leave, with scores of their own; of datasets only the record."""
    for number, one in enumerate(found):
        report = Report(torch.arange(1, 5).unsqueeze(-1) * torch.tensor([0.01, 0.01]), {"episode_steps": 3, "seed": 0})
        shifts = {"focus_lcp (changed)": 0.0, "focus_lcp, image goals": 0.01, "random": -0.2}
        for name, shift in list(shifts.items())[: 3 if one.evaluated.random else 1]:
            value = 0.2 + 0.02 * (number if name != "random" else one.evaluated.trained.seed) + shift
            report.add(name, {"final_score": torch.linspace(0, value, 4)}, source=name, run=f"{name} {number}")
        report.save(root / one.evaluated.name)
        log = root / one.evaluated.trained.name / "log" / "scalars" / "evaluation"
        log.mkdir(parents=True)
        (log / "final_score.csv").write_text(f"2,0.{number}000\n4,0.{number}500\n")
        for run in in_order([one.evaluated]):
            Record(
                content=to_dict(run.content),
                pace=run.pace,
                work=run.work,
                seconds=60.0 + number,
                done=True,
                commands=(("train", f"x={number}"),),
                commit=f"abc{number}",
                machine="another machine",
                episodes="those there" if run.kind == "trainings" else "",
                coverage={"finger": {"moves": 0.5, "visited": 0.25}} if run.kind == "datasets" else {},
            ).write(root / run.name)


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """Of one seed, made elsewhere."""
    wanted = Evidence(**WANTED, seeds=1)
    give(tmp_path / "there", results(wanted))
    return write_page(wanted, results(wanted), tmp_path / "there").parent


def test_a_page_is_made_again_from_a_page(page: Path, tmp_path: Path) -> None:
    wanted = Evidence(**WANTED, seeds=1)
    found, here = results(wanted), tmp_path / "here"
    assert include(page, found, here) == [one.evaluated.name for one in found]
    again = write_page(wanted, found, here).parent
    names = ["README.md", "runs.json", "reacher/results.md", "reacher/curves.csv"]
    for name in names:
        assert (again / name).read_text() == (page / name).read_text(), name
    assert (again / "runs.json").read_text(encoding="utf-8").count('"those there"') == len(found)
    assert (again / "README.md").read_text(encoding="utf-8").count("| finger | 50.0% | 25% |") == len(found)
    before, after = (Report.load(folder / "reacher" / "results.json") for folder in (page, again))
    assert list(before.rows) == list(after.rows)
    for name, row in before.rows.items():
        torch.testing.assert_close(after.rows[name].seeds, row.seeds)
    assert to_do(in_order(one.evaluated for one in found), here) == set()


def test_random_actions_go_to_their_seeds_and_to_those_who_played_them(tmp_path: Path) -> None:
    """In this figure one row of three measures them."""
    wanted = Evidence(figure="visual_goals", size="debug", goals=4, seeds=2)
    found, there, here = results(wanted), tmp_path / "there", tmp_path / "here"
    give(there, found)
    include(write_page(wanted, found, there).parent, found, here)
    before, after = (write_page(wanted, found, root).parent / "reacher" / "results.md" for root in (there, here))
    assert after.read_text() == before.read_text()
    for one in found:
        rows = Report.load(here / one.evaluated.name / "results.json").rows
        assert ("random" in rows) == one.evaluated.random
        if one.evaluated.random:
            there_too = Report.load(there / one.evaluated.name / "results.json").rows["random"]
            torch.testing.assert_close(rows["random"].seeds, there_too.seeds)


def test_what_is_not_done_is_on_no_page(page: Path, tmp_path: Path) -> None:
    found, there = results(Evidence(**WANTED, seeds=2)), tmp_path / "there"
    run = found[-1].evaluated
    Record(content=to_dict(run.content), pace=run.pace, work=run.work).write(there / run.name)
    folder = write_page(Evidence(**WANTED, seeds=2), found, there).parent
    assert run.name not in (folder / "runs.json").read_text()
    assert found[0].evaluated.name in (folder / "runs.json").read_text()


def test_only_the_rest_is_done(page: Path, tmp_path: Path) -> None:
    """Two seeds are wanted, the page has one: its datasets are not here, which the other seed needs."""
    found = results(Evidence(**WANTED, seeds=2))
    first, second = found[: len(found) // 2], found[len(found) // 2 :]
    assert include(page, found, tmp_path) == [one.evaluated.name for one in first]
    expected = in_order(one.evaluated for one in second)
    assert {run.kind for run in expected} == {"datasets", "trainings", "evaluations"}
    assert to_do(in_order(one.evaluated for one in found), tmp_path) == {run.name for run in expected}


def test_what_is_needed_and_only_known_is_done_anew(page: Path, tmp_path: Path) -> None:
    """The agents of the page are to be evaluated on more goals."""
    include(page, results(Evidence(**WANTED, seeds=1)), tmp_path)
    runs = in_order(one.evaluated for one in results(Evidence(**{**WANTED, "goals": 9}, seeds=1)))
    assert all(Record.of(run, tmp_path).done for run in runs if run.kind != "evaluations")
    assert to_do(runs, tmp_path) == {run.name for run in runs}


def test_time_that_was_spent_elsewhere_does_not_count(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = results(Evidence(**WANTED, seeds=2))
    include(page, found, tmp_path)
    runs = in_order([found[-1].evaluated])
    monkeypatch.setattr(queue, "_run", lambda *_: None)
    monkeypatch.setattr(queue, "_check_end", lambda job: None)
    how = Machine(workers=1)
    work_off(runs, tmp_path, how, LAUNCHERS["local"](how))
    for run in runs:
        record = Record.of(run, tmp_path)
        assert record.done
        assert record.machine != "another machine"
        assert record.seconds < 50


def test_what_is_here_stays(page: Path, tmp_path: Path) -> None:
    found = results(Evidence(**WANTED, seeds=1))
    run = found[1].evaluated
    Record(content=to_dict(run.content), pace=run.pace, work=run.work, seconds=7.0).write(tmp_path / run.name)
    assert include(page, found, tmp_path) == [one.evaluated.name for one in found if one.evaluated != run]
    assert Record.of(run, tmp_path).seconds == 7.0
    assert not (tmp_path / run.name / "results.json").exists()


def test_a_default_that_has_changed_since_is_noticed(page: Path, tmp_path: Path) -> None:
    file = page / "runs.json"
    text = file.read_text()
    assert '"horizon": 20' in text
    file.write_text(text.replace('"horizon": 20', '"horizon": 21'))
    found = results(Evidence(**WANTED, seeds=1))
    include(page, found, tmp_path)
    with pytest.raises(RecordError, match=r"horizon=21, whose default is 20 now"):
        to_do(in_order(one.evaluated for one in found), tmp_path)


def test_a_page_of_one_environment_of_two(page: Path, tmp_path: Path) -> None:
    found = results(Evidence(**WANTED, seeds=1, env=("cube_move", "reacher")))
    assert include(page, found, tmp_path) == [one.evaluated.name for one in found if one.env == "reacher"]


def test_a_page_that_has_lost_scores(page: Path, tmp_path: Path) -> None:
    found = results(Evidence(**WANTED, seeds=1))
    emptied = Report(torch.zeros(4, 2))
    emptied.save(page / "reacher")
    with pytest.raises(RecordError, match=rf"results\.json: has no scores of {found[0].evaluated.name}"):
        include(page, found, tmp_path)
    assert not list(tmp_path.glob("evaluations/*/run.json"))


@pytest.mark.parametrize("text", ["nothing", "[]", '{"evaluations/x": {"pace": 1}}', '{"evaluations/x": 3}'])
def test_what_is_no_page_is_refused(page: Path, tmp_path: Path, text: str) -> None:
    found = results(Evidence(**WANTED, seeds=1))
    (page / "runs.json").write_text(text)
    with pytest.raises(RecordError, match=r"runs\.json: not the records of a page's runs"):
        include(page, found, tmp_path)
    with pytest.raises(RecordError, match=r"runs\.json: not there; include names the folder of a page"):
        include(tmp_path, found, tmp_path)
