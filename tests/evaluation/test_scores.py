from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.evaluation import Report, mean_and_error, measure, normalized_score


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
            "| dreamer | 2 | 0.75 ± 0.10 | 0.020 ± 0.000 |",
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
