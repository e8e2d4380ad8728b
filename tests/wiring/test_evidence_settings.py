"""What the settings of the paper's figures do, in the recipe; nothing is run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from rows import shows

from torchrl_ocwm.evidence import Collected, Evaluated, Explored, Machine, Run, Trained, estimate, launchers


@pytest.fixture
def reproduce(
    command: Callable[..., str], scripts: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., SimpleNamespace]:
    """What the recipe would run, on what, and what it prints."""
    module = scripts["reproduce"]

    def go(*arguments: str) -> SimpleNamespace:
        seen = SimpleNamespace(runs=[], how=None, launcher=None, root=None, page=None)

        def note(runs: list[Run], root: Path, how: Machine, launcher: Any, **rest: Any) -> None:
            seen.__dict__.update(runs=runs, root=root, how=how, launcher=launcher)

        def note_page(wanted: Any, found: Any, root: Path) -> Path:
            seen.page = (wanted, found, root)
            return root / "README.md"

        with monkeypatch.context() as patch:
            patch.setattr(module, "work_off", note)
            patch.setattr(module, "write_page", note_page)
            patch.setattr(estimate.Paces, "_measure", lambda self, run: 1.0)
            figure = [] if any(one.startswith("figure=") for one in arguments) else ["figure=loss_scale"]
            seen.said = command("reproduce", *figure, *arguments)
        return seen

    return go


def of_kind(seen: SimpleNamespace, kind: type | tuple[type, ...]) -> list[Any]:
    return [run for run in seen.runs if isinstance(run, kind)]


@shows("Evidence.figure")
def test_figure(reproduce: Callable[..., SimpleNamespace]) -> None:
    agents = [run.agent for run in of_kind(reproduce("figure=visual_goals", "seeds=1"), Trained)]
    assert agents == ["lexa_cosine", "lexa_temporal", "focus_lcp"]
    assert reproduce("figure=table").page[0].figure == "table"
    assert "figure must be one of 'table', 'limits'" in reproduce("figure=nothing").said


@shows("Evidence.env")
def test_environments(reproduce: Callable[..., SimpleNamespace]) -> None:
    assert [run.env for run in of_kind(reproduce("env=cube_move"), Explored)] == ["cube_move"]
    both = reproduce("env=[reacher,cube_move]")
    assert [run.env for run in of_kind(both, (Collected, Explored))] == ["reacher", "cube_move"]
    assert "unknown environment 'nowhere'" in reproduce("env=nowhere").said


@shows("Evidence.agents")
def test_rows_of_some_agents(reproduce: Callable[..., SimpleNamespace]) -> None:
    """In the figure's order, and with what all of them need; their page has no other rows."""
    seen = reproduce("figure=table", "agents=[focus_lcp,dreamer]", "seeds=1")
    assert [run.agent for run in of_kind(seen, Trained)] == ["dreamer", "dreamer", "focus_lcp"]
    assert len(of_kind(seen, Collected)) == 1
    wanted, found, _ = seen.page
    assert [one.row.name for one in found] == ["dreamer, weights 1", "dreamer, weights 200", "focus_lcp"]
    assert wanted.agents == ("focus_lcp", "dreamer")
    said = reproduce("agents=[focus]").said
    assert "agents must be agents or rows of figure=loss_scale: dreamer; dreamer, goal weight 1;" in said
    assert "Got 'focus'" in said


@shows("Evidence.agents")
def test_rows_by_name(reproduce: Callable[..., SimpleNamespace]) -> None:
    seen = reproduce("figure=table", 'agents=["dreamer, weights 200",focus_lcp]', "seeds=1")
    assert [one.row.name for one in seen.page[1]] == ["dreamer, weights 200", "focus_lcp"]


@shows("Evidence.size")
def test_size(reproduce: Callable[..., SimpleNamespace]) -> None:
    """Agents of that size, and as much of everything as goes with it."""
    for size, steps, updates, goals in (("cpu", 50_000, 1_500, 100), ("paper", 1_000_000, 250_000, 100)):
        seen = reproduce(f"size={size}")
        assert {run.size for run in of_kind(seen, Trained)} == {size}
        assert {run.work for run in of_kind(seen, Collected)} == {steps}
        assert {run.updates for run in of_kind(seen, Trained)} == {updates}
        assert {run.goals for run in of_kind(seen, Evaluated)} == {goals}
    assert "size must be one of debug" in reproduce("size=none").said


@shows("Evidence.seeds", "Evidence.steps", "Evidence.updates", "Evidence.goals")
def test_how_much(reproduce: Callable[..., SimpleNamespace]) -> None:
    seen = reproduce("seeds=2", "steps=70", "updates=9", "goals=16", "env=cube_move")
    assert [run.seed for run in of_kind(seen, Trained)] == [0] * 4 + [1] * 4
    assert [run.work for run in of_kind(seen, Explored)] == [70]
    assert {run.updates for run in of_kind(seen, Trained)} == {9}
    assert {run.goals for run in of_kind(seen, Evaluated)} == {16}


@shows("Machine.workers", "Machine.threads")
def test_room(reproduce: Callable[..., SimpleNamespace]) -> None:
    seen = reproduce("workers=7", "threads=3", "size=debug")
    assert seen.launcher.slots == 7
    [_, training, *_] = seen.runs
    assert "training.threads=3" in training.commands(seen.root, seen.how)[0]
    assert seen.how.threads == 3


@shows("Machine.device")
def test_device(reproduce: Callable[..., SimpleNamespace], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launchers.torch.cuda, "device_count", lambda: 5)
    seen = reproduce("device=cuda")
    assert seen.launcher.slots == 5
    assert "training.device=cuda" in seen.runs[1].commands(seen.root, seen.how)[0]


@shows("Machine.launcher")
def test_launcher(reproduce: Callable[..., SimpleNamespace], monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(reproduce().launcher, launchers.Local)
    made = SimpleNamespace(slots=4)
    monkeypatch.setitem(launchers.LAUNCHERS, "ray", lambda how: made)
    assert reproduce("launcher=ray").launcher is made


@shows("Reproduce.dry_run")
def test_dry_run(reproduce: Callable[..., SimpleNamespace], tmp_path: Path) -> None:
    seen = reproduce("dry_run=true", "workers=1")
    assert seen.how is seen.page is None
    assert "| trainings/reacher-dreamer-s0-" in seen.said
    assert "25 of 25 runs to do, 1 at a time: about " in seen.said
    assert not list(tmp_path.iterdir())
    said = reproduce("workers=1").said
    assert said.startswith(seen.said.strip())
    assert said.endswith("page: " + str(tmp_path / "outputs" / "evidence" / "README.md") + "\n")


@shows("Reproduce.include")
def test_include(
    reproduce: Callable[..., SimpleNamespace],
    scripts: dict[str, ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """Pages are taken over before it is said what there is to do."""
    asked: list[Any] = []
    monkeypatch.setattr(scripts["reproduce"], "include", lambda *given: asked.append(given) or ["x", "y"])
    seen = reproduce("include=[one,two]", "workers=1")
    wanted = seen.page[1]
    assert asked == [(folder, wanted, tmp_path / "outputs" / "evidence") for folder in ("one", "two")]
    assert seen.said.startswith("one: 2 evaluations taken over\ntwo: 2 evaluations taken over\n| run |")


@shows("Reproduce.output")
def test_output(reproduce: Callable[..., SimpleNamespace], tmp_path: Path) -> None:
    seen = reproduce("output=there")
    assert seen.root == seen.page[2] == tmp_path / "there"


@shows("Share.evaluation", "Share.output", "Share.name")
def test_share(command: Callable[..., str], scripts: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(scripts["share"], "share", lambda *where, **name: asked.append((*where, name)))
    command("share", "evaluation=/there", "output=here", "name=a/b")
    assert asked == [(Path("/there"), Path("here"), {"name": "a/b"})]
