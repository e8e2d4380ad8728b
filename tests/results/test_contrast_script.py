"""The script that compares goal latents takes the rows that there are."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from reading import RESULTS

from torchrl_ocwm.evidence import Evidence, Record, results


def test_rows_that_are_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    main = runpy.run_path(str(RESULTS / "reacher/goal_latents/contrast.py"))["main"]
    plan = {one.row.name: one.evaluated.trained for one in results(Evidence(figure="goal_latents", seeds=1))}
    light = plan["focus_lcp, weight 1"]
    for run, done in ((light, True), (plan["focus_lcp, centred latents"], False)):
        replace(Record.of(run, tmp_path), done=done).write(tmp_path / run.name)
        (tmp_path / run.name / "checkpoint.zip").touch()
    seen = []

    def diagnose(name: str, data: Path, output: Path) -> dict[str, Any]:
        seen.append((name, data, output))
        numbers = ("cosine", "cosine_with_others", "contrast", "median_rank", "distance")
        return {key: len(seen) + place / 8 for place, key in enumerate(numbers)}

    monkeypatch.setitem(main.__globals__, "diagnose", diagnose)
    monkeypatch.setattr("sys.argv", ["contrast.py", "--evidence", str(tmp_path), "--output", str(tmp_path / "new")])
    main()
    data = tmp_path / light.data.name / "data"
    assert seen == [
        ("reacher/focus_lcp", data, tmp_path / "new" / plan["focus_lcp"].name),  # the one that comes with the package
        (str(tmp_path / light.name / "checkpoint.zip"), data, tmp_path / "new" / light.name),
    ]
    _, _, first, second = capsys.readouterr().out.splitlines()
    assert first == "| focus_lcp | 1.000 | 1.125 | 1.250 | 1.375 | 1500.000 |"
    assert second.startswith("| focus_lcp, weight 1 | 2.000 |")
