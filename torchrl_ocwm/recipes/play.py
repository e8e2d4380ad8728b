"""Look and click: ``ocwm play reacher/focus_lcp`` opens a page in the browser, on which an agent is at work."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from threading import Event

from torchrl_ocwm.recipes.config import recipe
from torchrl_ocwm.settings import Settings, setting
from torchrl_ocwm.signals import ended_by_signals


@dataclass(frozen=True, kw_only=True)
class Play(Settings):
    """Settings of the recipe.

    Args:
        agent: Who acts: a checkpoint, a folder with one, the name of an agent that comes with this package, such as
            ``reacher/focus_lcp``, or an environment with ``/scripted`` for its scripted policy.
        behaviour: Which of the agent's behaviours acts; ``null``: that which acts unless another is asked for.
        others: More of them, to choose from on the page. Those that come with this package, and the scripted policies,
            are there anyway.
        host: Address to listen at: this machine only, or ``0.0.0.0`` for all who reach it; they can steer too.
        port: Port; ``null``: the first free one from 7860.
        browser: Open the page in the browser of this machine.
        rate: Steps per second, if the machine is fast enough.
        seed: Seeds the episodes.
    """

    agent: str = "reacher/focus_lcp"
    behaviour: str | None = None
    others: tuple[str, ...] = ()
    host: str = "127.0.0.1"
    port: int | None = setting(None, at_least=1, at_most=65535)
    browser: bool = True
    rate: float = setting(10.0, at_least=0.1, at_most=100)
    seed: int = setting(0, at_least=0, at_most=2**31 - 1)


@recipe("play")
@ended_by_signals()
def main(config: Play) -> None:
    """Serve the page until Ctrl-C."""
    from torchrl_ocwm.play import Page, Stage, find_players  # Gradio takes seconds: not for --help

    with Stage(find_players([config.agent, *config.others], config.behaviour), seed=config.seed) as stage:
        page = Page(stage, rate=config.rate)
        address = page.launch(host=config.host, port=config.port, browser=config.browser)
        sys.stdout.write(f"The page is at {address} until Ctrl-C.\n")
        sys.stdout.flush()
        try:
            Event().wait()
        finally:
            page.close()
