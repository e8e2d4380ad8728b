"""The page without a browser: what is on it, what its handlers do, where it is served, and that it asks nobody."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable, Iterator
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest

from torchrl_ocwm.agents import Agent
from torchrl_ocwm.play import Player, PlayError, Session, Stage

gr = pytest.importorskip("gradio")

from torchrl_ocwm.play import page as pages  # noqa: E402
from torchrl_ocwm.play.page import Page  # noqa: E402


@pytest.fixture
def page(make_agent: Callable[..., Agent]) -> Iterator[Page]:
    players = [
        Player("reacher/scripted", "reacher"),
        Player("ours", "reacher", make_agent("focus_lcp")),
        Player("cube_move/scripted", "cube_move"),
    ]
    with Stage(players) as stage:
        yield Page(stage)


@pytest.fixture
def warnings(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    told: list[str] = []
    monkeypatch.setattr(pages.gr, "Warning", lambda message, **options: told.append(message))
    return told


def event(**data: Any) -> Any:
    return gr.EventData(None, data)


def session_of(page: Page) -> Session:
    return page.stage.do(lambda session: session)


def test_what_is_on_it(page: Page) -> None:
    there = {one.elem_id for one in page.blocks.blocks.values()} - {None}
    assert there >= {"camera", "numbers", "imagined", "masks", "pause", "episode", "push", "environment", "agent"}
    assert there >= {"behaviour", "goal-x", "goal-y", "goal-z", "as-image", "gallery"}
    assert page.environment.choices == [("reacher", "reacher"), ("cube_move", "cube_move")]
    assert [name for name, _ in page.agent.choices] == ["reacher/scripted", "ours"]


def test_a_click_sets_the_goal_and_the_sliders(page: Page) -> None:
    place = page.stage.do(lambda session: session.places.point(np.array([0.1, -0.15])))
    camera, shown, *_, x, y, z = page.click(False, event(begin=place, to=place))
    assert session_of(page).goal == pytest.approx(np.array([0.1, -0.15]), abs=1e-5)
    assert 'class="goal"' in camera
    assert '<dd id="steps">0</dd>' in shown
    assert (x.value, y.value, z.visible) == (pytest.approx(10), pytest.approx(-15), False)
    assert (x.minimum, x.maximum, x.label, y.label) == (-24, 24, "Goal x, cm", "Goal y, cm")


def test_a_click_can_give_an_image(page: Page) -> None:
    page.choose("ours")
    place = page.stage.do(lambda session: session.places.point(np.array([0.1, -0.15])))
    for as_image in (True, False):
        page.click(as_image, event(begin=place, to=place))
        assert ("goal" in session_of(page)._now.keys()) is as_image


def test_a_click_that_is_no_goal_is_explained(page: Page, warnings: list[str]) -> None:
    before = session_of(page).goal
    page.click(False, event(begin=(0.01, 0.01), to=(0.01, 0.01)))
    (told,) = warnings
    assert "is outside the workspace" in told
    assert session_of(page).goal is before


def test_an_error_of_ours_is_no_warning(page: Page, warnings: list[str]) -> None:
    def broken(session: Session) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        page.steer(broken)
    assert warnings == []


def test_messages_are_no_html(page: Page, warnings: list[str]) -> None:
    page.choose("<b>")
    assert "&lt;b&gt;" in warnings[0]


def test_sliders_set_the_goal(page: Page) -> None:
    page.slide(False, 12.0, -7.5, 0.0)
    assert session_of(page).goal == pytest.approx(np.array([0.12, -0.075]))


def test_a_drag_moves_the_object(page: Page) -> None:
    place = page.stage.do(lambda session: session.places.point(np.array([-0.1, 0.15])))
    page.drag(event(begin=(0.5, 0.5), to=place))
    assert session_of(page).env.true_position()[0] == pytest.approx(np.array([-0.1, 0.15]), abs=1e-5)


@pytest.mark.slow
def test_clicks_and_drags_keep_heights() -> None:
    with Stage([Player("cube_lift/scripted", "cube_lift")]) as stage:
        page = Page(stage)
        page.slide(False, 5.0, -5.0, 12.5)
        session, scene = session_of(page), session_of(page).env
        assert session.goal == pytest.approx(np.array([0.05, -0.05, 0.125]))
        place = stage.do(lambda session: session.places.point(np.array([0.1, 0.1, 0.125])))
        *_, z = page.click(False, event(begin=place, to=place))
        assert session.goal == pytest.approx(np.array([0.1, 0.1, 0.125]), abs=1e-5)
        assert (z.value, z.visible, z.minimum, z.maximum, z.label) == (12.5, True, 0, 20, "Goal z, cm")
        stage.do(lambda session: session.move_object((0.0, 0.1, 0.1)))
        begin, end = (
            stage.do(lambda session, y=y: session.places.point(np.array([0.0, y, 0.1]))) for y in (0.1, -0.15)
        )
        page.drag(event(begin=begin, to=end))
        assert scene.true_position()[0] == pytest.approx(np.array([0.0, -0.15, 0.1]), abs=1e-5)


def test_a_tick_is_a_step_unless_it_stands_still(page: Page) -> None:
    for running, steps in ((True, 1), (False, 1), (True, 2)):
        page.running = running
        page.tick()
        assert session_of(page).steps == steps


def test_the_pause_button_says_what_it_will_do(page: Page) -> None:
    assert (page.toggle(), page.running) == ("Go on", False)
    assert (page.toggle(), page.running) == ("Pause", True)


def test_a_goal_image_is_picked(page: Page) -> None:
    page.choose("ours")
    page.pick(event(index=3))
    session = session_of(page)
    assert session.goal == pytest.approx(np.array(session.env.workspace.landmarks[3]))
    assert "goal" in session._now.keys()


def test_a_goal_image_is_dropped(page: Page, warnings: list[str]) -> None:
    page.choose("ours")
    page.drop(np.zeros((64, 64, 3), np.uint8))
    assert session_of(page).goal is None
    page.drop(np.zeros((64, 32, 3), np.uint8))
    assert "square" in warnings[0]


def test_another_agent(page: Page) -> None:
    *_, environment, agent, behaviour, images, gallery = page.choose("ours")
    assert session_of(page).policy is not None
    assert (environment, agent.value, behaviour.value) == ("reacher", "ours", "reach")
    assert (images.visible, len(gallery.value)) == (True, 10)
    *_, images, _ = page.choose("reacher/scripted")
    assert images.visible is False


@pytest.mark.slow
def test_another_environment(page: Page) -> None:
    *_, x, y, _, _, environment, agent, _, _, _ = page.choose_environment("cube_move")
    assert (environment, agent.value) == ("cube_move", "cube_move/scripted")
    assert (x.minimum, y.maximum) == (-25, 25)
    assert type(session_of(page).env).__name__ == "CubeMove"


# Offline.


@pytest.fixture
def local_only(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Whom else this process tries to reach; nobody is."""
    elsewhere: list[Any] = []
    connect = socket.socket.connect

    def only_here(self: socket.socket, address: Any) -> None:
        if self.family in (socket.AF_INET, socket.AF_INET6) and address[0] not in ("127.0.0.1", "localhost", "::1"):
            elsewhere.append(address)
            raise OSError("no network")
        connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", only_here)
    return elsewhere


def test_it_is_served_to_this_machine_and_asks_nobody(page: Page, local_only: list[Any]) -> None:
    address = page.launch()
    try:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", address)
        html = urlopen(address).read().decode()
        theme = urlopen(f"{address}theme.css").read().decode()
        assert page.blocks.server_name == "127.0.0.1"
    finally:
        page.close()
    assert page.blocks.stylesheets == []  # of fonts
    assert page.blocks.analytics_enabled is False
    assert page.blocks.share is False
    assert not re.findall(r"<(?:script|link|img)[^>]*(?:src|href)=.?https?:", html)
    assert not re.findall(r"url\(.?https?:|@import", theme)
    assert local_only == []


def test_a_machine_that_is_slow_to_answer_itself(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gradio.networking.url_ok", lambda address: False)
    try:
        assert urlopen(page.launch()).status == 200
    finally:
        page.close()


def test_a_port_that_is_taken(page: Page) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(PlayError, match=f"cannot serve at 127.0.0.1, port {port}"):
            page.launch(port=port)


def test_the_rate_is_that_of_its_timer(page: Page) -> None:
    assert page.timer.value == pytest.approx(0.1)
    assert Page(page.stage, rate=4).timer.value == pytest.approx(0.25)
