from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.evaluation import Report, mean_and_error, measure, normalized_score
from torchrl_ocwm.evaluation.scores import bootstrap_interval, interquartile_mean


def test_normalized_score_by_hand() -> None:
    goal = torch.tensor([[0.3, 0.4], [0.3, 0.4], [0.3, 0.4], [0.0, -0.1]])
    position = torch.tensor([[0.3, 0.4], [0.0, 0.0], [-0.3, -0.4], [0.1, -0.1]])
    expected = torch.tensor([1.0, math.exp(-1), math.exp(-2), math.exp(-1)])
    torch.testing.assert_close(normalized_score(position, goal), expected)


def test_standard_error_by_hand() -> None:
    mean, error = mean_and_error(torch.tensor([0.6, 0.7, 0.8]))
    assert mean == pytest.approx(0.7)
    assert error == pytest.approx(0.1 / math.sqrt(3))
    assert mean_and_error(torch.tensor([0.5])) == (0.5, None)


def test_measure_by_hand() -> None:
    """Judged by the true position, not by the estimated one, after the last step."""
    goal = torch.tensor([0.1, 0.0]).expand(2, 3, 2)
    true = torch.zeros(2, 3, 1, 2)
    true[0, 2, 0] = torch.tensor([0.1, 0.04])
    true[1, :, 0] = torch.tensor([0.1, 0.06])
    episodes = TensorDict(
        {"object_position_true": true, "object_position": goal.unsqueeze(2), "goal_position": goal}, [2, 3]
    )
    scores = measure(episodes)
    torch.testing.assert_close(scores["final_distance"], torch.tensor([0.04, 0.06]))
    torch.testing.assert_close(scores["success"], torch.tensor([1.0, 0.0]))
    torch.testing.assert_close(scores["final_score"], torch.tensor([-0.4, -0.6]).exp())
    first = (2 * math.exp(-1) + math.exp(-0.4)) / 3
    torch.testing.assert_close(scores["mean_score"], torch.tensor([first, math.exp(-0.6)]))


def test_goals_at_the_start_have_no_score() -> None:
    """The mean leaves them out, whatever the policy did there; distances are still distances."""
    goals = torch.tensor([[0.0, 0.0], [0.1, 0.0], [0.0, 0.2]])
    reached = (goals + torch.tensor([0.01, 0.0]))[:, None, None].expand(-1, 3, 1, -1)
    scores = measure(
        TensorDict({"object_position_true": reached, "goal_position": goals[:, None].expand(-1, 3, -1)}, [3, 3])
    )
    assert scores["final_score"].isnan().tolist() == [True, False, False]
    report = Report(goals)
    report.add("agent", scores, source="x")
    expected = (math.exp(-0.1) + math.exp(-0.05)) / 2
    assert report.summary("agent", "final_score") == (pytest.approx(expected), None)
    assert report.summary("agent", "final_distance") == (pytest.approx(0.01), None)
    assert report.markdown().splitlines()[-1] == "Without a score, as they lie at the start: 1 of 3 goals."


class TestReport:
    @pytest.fixture
    def report(self) -> Report:
        report = Report(torch.tensor([[0.1, 0.0], [0.2, 0.0]]), {"episode_steps": 5})
        report.add("random", {"final_score": torch.tensor([0.2, 0.4])}, source="random")
        for seed, base in enumerate((0.6, 0.8)):
            scores = {"final_score": torch.tensor([base, base + 0.1]), "goal_error": torch.tensor([0.01, 0.03])}
            report.add("dreamer", scores, source=f"seed_{seed}")
        return report

    def test_table(self, report: Report) -> None:
        assert report.markdown().splitlines() == [
            "| agent | seeds | final score | goal reconstruction error, m |",
            "|---|---|---|---|",
            "| random | 1 | 0.30 | – |",
            "| dreamer | 2 | 0.75 ± 0.10 | 0.020 ± 0.000 |",  # the same to the last digit
        ]

    def test_files(self, report: Report, tmp_path: Path) -> None:
        report.save(tmp_path / "new")
        numbers = json.loads((tmp_path / "new" / "results.json").read_text())
        dreamer = numbers["agents"]["dreamer"]
        assert dreamer["metrics"]["final_score"] == {"mean": pytest.approx(0.75), "standard_error": pytest.approx(0.1)}
        assert dreamer["metrics"]["entity_error"] is None
        assert dreamer["sources"] == ["seed_0", "seed_1"]
        assert dreamer["per_goal"][1]["final_score"] == pytest.approx([0.8, 0.9])
        assert (tmp_path / "new" / "results.md").read_text() == report.markdown() + "\n"
        assert not list((tmp_path / "new").glob(".*"))

    def test_rows_of_an_earlier_report(self, report: Report, tmp_path: Path) -> None:
        report.save(tmp_path)
        again = Report.load(tmp_path / "results.json")
        assert again.to_dict() == report.to_dict()
        more = Report(report.goals, report.settings)
        more.add("new", {"final_score": torch.zeros(len(report.goals))}, source="x")
        more.include(again)
        assert more.markdown().splitlines()[3:] == report.markdown().splitlines()[2:]
        with pytest.raises(ValueError, match="other goals"):
            Report(report.goals + 0.1, report.settings).include(again)
        with pytest.raises(ValueError, match="other settings"):
            Report(report.goals, {"seed": 7}).include(again)

    def test_not_a_report(self, tmp_path: Path) -> None:
        (tmp_path / "results.json").write_text('{"goals": [[0.0, 0.0]]}')
        for file in (tmp_path / "results.json", tmp_path / "nothing.json"):
            with pytest.raises(ValueError, match=r"json: not the results\.json of an evaluation"):
                Report.load(file)

    def test_heatmap_is_the_mean_over_seeds(self, report: Report) -> None:
        torch.testing.assert_close(report.per_goal("final_score")["dreamer"], torch.tensor([0.7, 0.8]))

    def test_small_errors_are_shown(self) -> None:
        report = Report(torch.tensor([[0.1, 0.0]]))
        for seed, score in enumerate((0.902, 0.908)):
            report.add("dreamer", {"final_score": torch.tensor([score])}, source=str(seed))
        assert report.markdown().splitlines()[-1] == "| dreamer | 2 | 0.905 ± 0.003 |"

    def test_a_run_counts_once(self, report: Report, tmp_path: Path) -> None:
        scores = {"final_score": torch.zeros(2)}
        report.add("new", scores, source="a/checkpoint.zip", run="its contents")
        message = r"b/checkpoint\.zip: the same run as a/checkpoint\.zip, which counts as a seed of new already"
        with pytest.raises(ValueError, match=message):
            report.add("new", scores, source="b/checkpoint.zip", run="its contents")
        report.save(tmp_path)
        with pytest.raises(ValueError, match="counts as a seed of random already"):
            report.include(Report.load(tmp_path / "results.json"))  # itself

    def test_agents_of_another_kind_are_another_row(self, report: Report, tmp_path: Path) -> None:
        for seed, kind in enumerate(("small", "large", "small")):
            report.add("new", {"final_score": torch.full((2,), seed / 10)}, source=str(seed), kind=kind)
        assert report.markdown().splitlines()[-2:] == ["| new | 2 | 0.10 ± 0.10 | – |", "| new #2 | 1 | 0.10 | – |"]
        report.save(tmp_path)
        again = Report.load(tmp_path / "results.json")
        again.add("new", {"final_score": torch.tensor([0.3, 0.3])}, source="3", kind="large")
        assert [len(row.seeds) for row in again.rows.values()] == [1, 2, 2, 2]

    def test_json_is_strict(self, report: Report, tmp_path: Path) -> None:
        report.add(
            "odd", {"final_score": torch.tensor([math.nan, 0.5]), "goal_error": torch.full((2,), math.inf)}, source="x"
        )
        report.save(tmp_path)

        def refuse(name: str) -> None:
            raise AssertionError(name)

        numbers = json.loads((tmp_path / "results.json").read_text(), parse_constant=refuse)
        assert numbers["agents"]["odd"]["per_goal"] == [{"final_score": [None, 0.5], "goal_error": [None, None]}]
        assert Report.load(tmp_path / "results.json").summary("odd", "final_score") == (0.5, None)

    def test_goals_without_a_score_are_not_in_the_interval(self) -> None:
        report, whole = (Report(goals=torch.rand(number, 2)) for number in (5, 4))
        for seed in range(2):
            scores = torch.rand(4)
            whole.add("new", {"final_score": scores}, source=str(seed))
            report.add("new", {"final_score": torch.cat([torch.tensor([math.nan]), scores])}, source=str(seed))
        assert report.interval("new", "final_score") == whole.interval("new", "final_score")

    def test_older_files(self, tmp_path: Path) -> None:
        """Without what a run is known by: their sources stand for it."""
        row = {"sources": ["a", "b"], "per_goal": [{"final_score": [0.5]}, {"final_score": [0.7]}], "metrics": {}}
        (tmp_path / "results.json").write_text(
            json.dumps({"settings": {}, "goals": [[0.1, 0.1]], "agents": {"dreamer": row}})
        )
        report = Report.load(tmp_path / "results.json")
        assert report.rows["dreamer"].runs == ["a", "b"]
        assert report.summary("dreamer", "final_score") == (pytest.approx(0.6), pytest.approx(0.1))


class TestIntervals:
    @pytest.mark.parametrize("number", [1, 3, 4, 5, 10, 299])
    def test_interquartile_mean(self, number: int) -> None:
        """As `scipy.stats.trim_mean(values, 0.25)` has it."""
        values = torch.randn(number)
        cut = int(0.25 * number)
        expected = sum(sorted(values.tolist())[cut : number - cut]) / (number - 2 * cut)
        assert interquartile_mean(values).item() == pytest.approx(expected, abs=1e-6)
        torch.testing.assert_close(interquartile_mean(values.expand(3, -1)), torch.full((3,), expected))

    def test_a_single_seed_has_no_interval(self) -> None:
        assert bootstrap_interval(torch.rand(1, 100)) is None

    def test_closed_form(self) -> None:
        """One goal, two seeds, 0 and 1: resamples have the means 0, 0.5 and 1 in the shares 1 : 2 : 1."""
        values = torch.tensor([[0.0], [1.0]])
        assert bootstrap_interval(values, share=0.95) == (0, 1)
        assert bootstrap_interval(values, share=0.4) == (0.5, 0.5)

    def test_many_goals(self) -> None:
        """Means of many goals are normal: those of 400 goals, 0.5 +- 1.96 * 0.5 / sqrt(2 * 400) after trimming."""
        values = torch.stack([torch.zeros(400), torch.ones(400)])
        shares = torch.distributions.Binomial(800, torch.tensor(0.5)).sample((20_000,)) / 800
        # With zeros and ones alone, the middle half is that of the share of ones, stretched twice around one half.
        expected = (2 * (shares - 0.5) + 0.5).clamp(0, 1).quantile(torch.tensor([0.025, 0.975])).tolist()
        assert bootstrap_interval(values) == pytest.approx(expected, abs=0.01)

    def test_a_slow_version(self) -> None:
        values = torch.rand(3, 7)
        rows = [
            [column[int(index)] for column in values.T.tolist() for index in torch.randint(3, (3,))]
            for _ in range(4000)
        ]
        means = torch.tensor([sum(sorted(row)[5:16]) / 11 for row in rows])
        expected = means.quantile(torch.tensor([0.025, 0.975])).tolist()
        assert bootstrap_interval(values) == pytest.approx(expected, abs=0.02)

    def test_goals_are_strata(self) -> None:
        """Where seeds agree on each goal, the interval has no width, however much goals differ."""
        low, high = bootstrap_interval(torch.rand(5).repeat(4, 1)) or (0.0, 1.0)
        assert low == pytest.approx(high)
