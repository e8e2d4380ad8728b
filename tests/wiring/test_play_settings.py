"""What the settings of the page do, in the recipe; nothing is served."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from rows import shows

pytest.importorskip("gradio")

from torchrl_ocwm import play
from torchrl_ocwm.play import page
from torchrl_ocwm.recipes.play import main


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., SimpleNamespace]:
    """What the recipe would serve, and what it says of a value that it refuses."""

    def go(*arguments: str) -> SimpleNamespace:
        seen = SimpleNamespace()

        def players(agents: list[str], behaviour: str | None) -> list[Any]:
            seen.agents, seen.behaviour = agents, behaviour
            return [play.Player("reacher/scripted", "reacher")]

        def launch(self: page.Page, **options: Any) -> str:
            seen.__dict__.update(options, rate=self.rate, seed=self.stage.seed)
            raise KeyboardInterrupt

        monkeypatch.setattr(play, "find_players", players)
        monkeypatch.setattr(page.Page, "launch", launch)
        monkeypatch.setattr(sys, "argv", ["play.py", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        seen.said = f"{stop.value.code}{capsys.readouterr().err}"
        return seen

    return go


@shows("Play.agent", "Play.others", "Play.behaviour")
def test_who_acts(serve: Callable[..., SimpleNamespace]) -> None:
    assert serve().agents == ["reacher/focus_lcp"]
    seen = serve("agent=a.zip", "others=[b.zip,cube_move/scripted]", "behaviour=explore")
    assert (seen.agents, seen.behaviour) == (["a.zip", "b.zip", "cube_move/scripted"], "explore")


@shows("Play.host", "Play.port", "Play.browser")
def test_where_it_is_served(serve: Callable[..., SimpleNamespace]) -> None:
    plain = serve()
    assert (plain.host, plain.port, plain.browser) == ("127.0.0.1", None, True)
    seen = serve("host=0.0.0.0", "port=8000", "browser=false")
    assert (seen.host, seen.port, seen.browser) == ("0.0.0.0", 8000, False)
    assert "port must be" in serve("port=70000").said


@shows("Play.rate", "Play.seed")
def test_pace_and_episodes(serve: Callable[..., SimpleNamespace]) -> None:
    seen = serve("rate=25", "seed=4")
    assert (seen.rate, seen.seed) == (25, 4)
    assert "rate must be" in serve("rate=0").said
