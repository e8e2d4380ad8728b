"""The page in a headless Chromium: click, drag, keys, a phone. Skipped where there is no browser."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from torchrl.checkpoint import CheckpointError

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import Agent
from torchrl_ocwm.play import Player, Stage, find_players

pytest.importorskip("gradio")
playwright = pytest.importorskip("playwright.sync_api")

from torchrl_ocwm.play.page import Page  # noqa: E402

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SHIPPED = "reacher/focus_lcp"
PATIENCE = 60_000  # milliseconds, on a machine with other work
DISTANCE = "parseFloat(document.querySelector('#distance').textContent)"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


class Visit:
    """Somebody who has the page open.

    Args:
        tab: Playwright's page.
        stage: What is shown on it.
    """

    def __init__(self, tab: Any, stage: Stage) -> None:
        self.tab, self.stage = tab, stage
        self.elsewhere: list[str] = []
        self.errors: list[str] = []

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Where on the screen a position in metres is, in the camera's picture."""
        place = self.stage.do(lambda session: session.places.point(np.array([x, y])))
        self.tab.evaluate("document.querySelector('#camera').scrollIntoView()")
        box = self.tab.locator("#camera img").bounding_box()
        return box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"]

    def until_true(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition of the simulation."""
        deadline = time.monotonic() + PATIENCE / 1000
        while not condition():
            assert time.monotonic() < deadline
            self.tab.wait_for_timeout(50)

    def until_goal(self, x: float, y: float) -> None:
        """Wait until the goal is there, up to a pixel of the screen."""
        self.until_true(lambda: np.allclose(self.stage.do(lambda session: session.goal), (x, y), atol=0.003))

    def until_there(self) -> None:
        """Wait until the object is within 5 cm of the goal, and the page shows it."""
        self.until_true(lambda: self.stage.do(lambda session: session.distance) < 0.05)
        self.until(f"{DISTANCE} < 5")

    def until(self, condition: str) -> None:
        """Wait for a condition in JavaScript."""
        self.tab.wait_for_function(condition, timeout=PATIENCE)


@pytest.fixture(scope="module")
def visit(browser: Any) -> Callable[..., Any]:
    @contextmanager
    def visit(stage: Stage, **screen: Any) -> Iterator[Visit]:
        page = Page(stage)
        address = page.launch()
        context = browser.new_context(**screen)
        one = Visit(context.new_page(), stage)
        one.tab.on(
            "request",
            lambda asked: asked.url.startswith((address, "data:", "blob:")) or one.elsewhere.append(asked.url),
        )
        one.tab.on("pageerror", lambda error: one.errors.append(str(error)))
        try:
            one.tab.goto(address, timeout=PATIENCE)
            one.tab.wait_for_selector("#camera img", timeout=PATIENCE)
            yield one
            assert one.elsewhere == []
            assert one.errors == []
        finally:
            context.close()
            page.close()

    return visit


@pytest.fixture
def stage() -> Iterator[Stage]:
    with Stage([Player("reacher/scripted", "reacher")]) as stage:
        yield stage


#: What is around the element that gets the keys.
FOCUSED = "[...document.querySelectorAll('[id]')].filter(e => e.contains(document.activeElement)).map(e => e.id)"


def test_click_a_goal_and_see_the_distance_fall(stage: Stage, visit: Callable[..., Any]) -> None:
    with visit(stage) as one:
        one.tab.mouse.click(*one.at(-0.15, 0.05))
        one.until_goal(-0.15, 0.05)
        one.until_there()
        one.tab.mouse.click(*one.at(0.15, -0.05))  # the other side of the arm
        one.until(f"{DISTANCE} > 15")
        one.until_there()
        assert one.tab.evaluate(DISTANCE) < 5


def is_shipped() -> bool:
    try:
        load_agent(SHIPPED)
    except CheckpointError:
        return False
    return True


@pytest.mark.skipif(not is_shipped(), reason=f"{SHIPPED} is not shipped yet")
def test_the_shipped_agent_comes_within_five_centimetres(visit: Callable[..., Any]) -> None:
    with Stage(find_players([SHIPPED])) as stage, visit(stage) as one:
        for goal in ((-0.15, 0.05), (0.1, 0.1)):
            one.tab.mouse.click(*one.at(*goal))
            one.until_goal(*goal)
            one.until_there()
            assert one.tab.evaluate(DISTANCE) < 5


def test_drag_the_object(stage: Stage, visit: Callable[..., Any]) -> None:
    stage.do(lambda session: session.set_goal(session.env.true_position()[0]))
    with visit(stage) as one:
        one.until("document.querySelector('#steps').textContent > 2")
        one.tab.click("#pause")
        one.until("document.querySelector('#pause').textContent.includes('Go on')")
        one.tab.mouse.move(*one.at(*stage.do(lambda session: session.env.true_position()[0])))
        one.tab.mouse.down()
        one.tab.mouse.move(*one.at(0.1, -0.12), steps=3)
        one.tab.mouse.up()
        one.until("document.querySelector('#steps').textContent == 0")
        assert stage.do(lambda session: session.env.true_position()[0]) == pytest.approx(
            np.array([0.1, -0.12]), abs=0.003
        )


def test_all_can_be_done_with_keys(stage: Stage, visit: Callable[..., Any]) -> None:
    stage.do(lambda session: session.set_goal((0.1, 0.1)))
    with visit(stage) as one:
        slider = one.tab.locator("#goal-x input[type=range]")
        slider.focus()
        for _ in range(4):
            one.tab.keyboard.press("ArrowLeft")
        one.until("document.querySelector('#goal-x input[type=number]').value == 8")
        one.until_goal(0.08, 0.1)
        reached: set[str] = set()
        for _ in range(30):
            one.tab.keyboard.press("Tab")
            reached |= set(one.tab.evaluate(FOCUSED))
        assert reached >= {"pause", "episode", "push", "goal-x", "goal-y", "environment", "agent", "behaviour"}


def test_a_phone(stage: Stage, visit: Callable[..., Any]) -> None:
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    with visit(stage, **phone) as one:
        assert one.tab.evaluate("document.documentElement.scrollWidth") <= 390
        assert one.tab.locator("#camera img").bounding_box()["width"] > 280
        assert one.tab.locator("#distance").bounding_box()["y"] < 844
        one.tab.touchscreen.tap(*one.at(-0.15, 0.05))
        one.until_goal(-0.15, 0.05)
        one.until_there()


def test_a_click_outside_is_explained(stage: Stage, visit: Callable[..., Any]) -> None:
    with visit(stage) as one:
        box = one.tab.locator("#camera img").bounding_box()
        one.tab.mouse.click(box["x"] + 4, box["y"] + 4)
        said = one.tab.get_by_text("outside the workspace")
        said.wait_for(timeout=PATIENCE)
        assert said.is_visible()


def test_choose_an_agent_and_pick_a_goal_image(make_agent: Callable[..., Agent], visit: Callable[..., Any]) -> None:
    players = [Player("reacher/scripted", "reacher"), Player("ours", "reacher", make_agent("focus_lcp"))]
    with Stage(players) as stage, visit(stage) as one:
        assert "imagines nothing" in one.tab.inner_text("#imagined")
        one.tab.click("#agent input")
        one.tab.get_by_role("option", name="ours").click()
        one.tab.wait_for_selector("#imagined img", timeout=PATIENCE)
        one.tab.wait_for_selector("#masks img", timeout=PATIENCE)
        one.tab.get_by_text("Goal images").click()
        one.tab.locator("#gallery .thumbnail-item").nth(3).click(timeout=PATIENCE)
        one.until("document.querySelector('#goal-y input[type=number]').value == 24")
        one.until_goal(0.0, 0.24)
        assert stage.do(lambda session: "goal" in session._now.keys())
