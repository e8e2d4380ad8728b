"""The simulation behind the page: goals by click and by image, steps, disturbances, what is shown."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointError

from torchrl_ocwm.agents import AGENTS, Agent, AgentConfig, build_agent, save_agent, shipped_agents
from torchrl_ocwm.envs import PositioningEnv, make_task, register_environment
from torchrl_ocwm.evaluation import normalized_score
from torchrl_ocwm.play import Player, PlayError, Session, Stage, find_players
from torchrl_ocwm.play.beliefs import decoded_position
from torchrl_ocwm.settings import change


@pytest.fixture
def session() -> Iterator[Session]:
    with Session("reacher", size=96) as session:
        yield session


@pytest.fixture
def play(make_agent: Callable[..., Agent]) -> Iterator[Callable[..., Session]]:
    opened: list[Session] = []

    def make(row: str = "focus_lcp", changes: Mapping[str, Any] = MappingProxyType({})) -> Session:
        opened.append(Session("reacher", make_agent(row, changes).policy(), size=96))
        return opened[-1]

    yield make
    for one in opened:
        one.close()


def run(session: Session, steps: int) -> None:
    for _ in range(steps):
        session.step()


# Goals.


def test_a_click_is_a_position_in_metres(session: Session) -> None:
    """The camera looks straight down from the middle: 31 cm from there to the edge of the picture."""
    camera = session.env.camera.camera_id
    half = 0.74 * np.tan(np.deg2rad(session.env.model.cam_fovy[camera]) / 2)
    assert session.places.position((0.75, 0.5)) == pytest.approx(np.array([half / 2, 0]), abs=1e-6)
    assert session.places.position((0.5, 0.25)) == pytest.approx(np.array([0, half / 2]), abs=1e-6)
    session.set_goal(session.places.position((0.75, 0.5)))
    assert session.goal == pytest.approx(np.array([half / 2, 0]), abs=1e-6)
    assert session.view().goal == pytest.approx((0.75, 0.5), abs=1e-5)


def test_a_click_beside_the_workspace_means_its_edge(session: Session) -> None:
    inside, outside = session.places.point(np.array([0.1, 0.26])), session.places.point(np.array([0.1, 0.30]))
    assert session.places.position(inside) == pytest.approx(np.array([0.1, 0.24]), abs=1e-5)
    with pytest.raises(PlayError, match=r"^\(10, 30\) cm is outside the workspace, from \(-24, -24\) cm to \(24, 24\)"):
        session.places.position(outside)


def test_distance_and_scores_are_those_of_the_true_position(session: Session) -> None:
    session.set_goal((0.1, -0.15))
    places = [session.env.true_position()[0]]
    for _ in range(5):
        session.step()
        places.append(session.env.true_position()[0])
    view, goal = session.view(), torch.tensor([0.1, -0.15])
    scores = normalized_score(torch.tensor(np.array(places)), goal)
    assert view.distance == pytest.approx(np.linalg.norm(places[-1] - goal.numpy()))
    assert (view.score, view.mean_score) == pytest.approx((float(scores[-1]), float(scores.mean())))
    assert view.steps == 5
    session.set_goal((0.1, -0.15))
    assert session.view().steps == 0


def test_a_goal_at_the_start_has_no_score(session: Session) -> None:
    session.set_goal((0.0, 0.0))
    session.step()
    view = session.view()
    assert (view.score, view.mean_score) == (None, None)
    assert view.distance == pytest.approx(np.linalg.norm(session.env.true_position()[0]))


@pytest.mark.parametrize("goal", [(0.1, 0.18), (-0.11, 0.07)])
def test_the_scripted_policy_reaches_the_goal(session: Session, goal: tuple[float, float]) -> None:
    session.set_goal(goal)
    run(session, 60)
    assert session.distance is not None
    assert session.distance < 0.02


def test_the_agent_is_told_the_goal_at_once(play: Callable[..., Session]) -> None:
    """What the policy is conditioned on is what its own encoder makes of the goal."""
    session = play()
    session.set_goal((0.1, -0.12))
    assert session.policy is not None
    encoded = session.policy.behaviour.goal.position(session.policy.agent.model.units(torch.tensor([[0.1, -0.12]])))
    torch.testing.assert_close(session._now["latent", "goal"], encoded)
    session.step()
    torch.testing.assert_close(session._now["latent", "goal"], encoded)


def given(session: Session) -> np.ndarray:
    """The goal image that the policy gets."""
    return session._now["goal", "pixels"][0].numpy()


def test_a_goal_as_an_image_is_the_object_there(play: Callable[..., Session]) -> None:
    session = play()
    of_position = session._now["latent", "goal"].clone()
    session.set_goal(session.goal, as_image=True)
    image = session.env.goal_observation(session.goal)["pixels"]
    assert (given(session) == image).all()
    assert not torch.allclose(session._now["latent", "goal"], of_position)
    assert session.distance == pytest.approx(np.linalg.norm(session.env.true_position()[0] - session.goal))
    session.step()
    assert (given(session) == image).all()
    session.set_goal(session.goal)
    torch.testing.assert_close(session._now["latent", "goal"], of_position)


def test_an_image_of_somebody_elses(play: Callable[..., Session]) -> None:
    session = play()
    image = session.env.goal_observation(np.array([0.1, -0.12]))["pixels"]
    session.set_goal_image(image.transpose(1, 2, 0))
    assert (given(session) == image).all()
    view = session.view()
    assert (view.goal, view.distance, view.score, view.mean_score) == (None, None, None, None)
    session.set_goal_image(image.transpose(1, 2, 0).repeat(4, 0).repeat(4, 1))  # larger
    assert abs(given(session).astype(int) - image).mean() < 2
    run(session, 2)
    assert session.view().distance is None


@pytest.mark.parametrize(
    ("image", "found"),
    [
        (np.zeros((64, 48, 3), np.uint8), "64 × 48 × 3, uint8"),
        (np.zeros((64, 64), np.uint8), "64 × 64, uint8"),
        (np.zeros((64, 64, 4), np.uint8), "64 × 64 × 4, uint8"),
        (np.zeros((64, 64, 3), np.float32), "64 × 64 × 3, float32"),
    ],
)
def test_what_is_no_goal_image(play: Callable[..., Session], image: np.ndarray, found: str) -> None:
    with pytest.raises(PlayError, match=f"a goal image is a square picture in colour.* this is {found}"):
        play().set_goal_image(image)


@pytest.mark.parametrize("row", ["dreamer", "dreamer_pcp"])
def test_agents_that_take_no_images_say_so(play: Callable[..., Session], row: str) -> None:
    session = play(row)
    before = session.goal
    for ask in (
        lambda: session.set_goal((0.1, 0.1), as_image=True),
        lambda: session.set_goal_image(np.zeros((64, 64, 3), np.uint8)),
    ):
        with pytest.raises(PlayError, match="this agent takes goals as positions, not as images"):
            ask()
    assert session.goal is before


def test_an_agent_that_takes_images_only_gets_clicks_as_images(play: Callable[..., Session]) -> None:
    session = play("lexa_cosine")
    assert (session.takes_positions, session.takes_images) == (False, True)
    session.set_goal((0.1, -0.12))
    assert session._now["goal", "pixels"].shape == (1, 3, 64, 64)
    first = session._now["latent", "goal"].clone()
    session.set_goal((-0.1, -0.12))
    assert not torch.allclose(session._now["latent", "goal"], first)


def test_a_goal_in_the_observation_is_the_new_one(play: Callable[..., Session]) -> None:
    session = play("dreamer")
    session.set_goal((0.1, -0.12))
    assert session._now["goal_position"][0].tolist() == pytest.approx([0.1, -0.12])


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ((0.1, 0.9), "outside the workspace"),
        ((0.1,), "has 2 coordinates"),
        ((0.1, float("nan")), "must be finite"),
    ],
)
def test_goals_that_are_none(session: Session, goal: tuple[float, ...], message: str) -> None:
    before = session.goal
    with pytest.raises(PlayError, match=message):
        session.set_goal(goal)
    with pytest.raises(PlayError, match=message):
        session.move_object(goal)
    assert session.goal is before


def test_a_picture_of_each_landmark(play: Callable[..., Session]) -> None:
    session = play()
    before = session.env.true_position().copy()
    pictures = session.goal_pictures()
    assert len(pictures) == len(session.env.workspace.landmarks) == 10
    assert pictures[0].shape == (64, 64, 3)
    assert (pictures[0] != pictures[1]).any()
    assert (session.env.true_position() == before).all()


# Steps.


def test_an_agent_remembers_and_sees_what_it_did(play: Callable[..., Session], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each call of its policy gets the latent of the call before, and what its action led to."""
    session = play("dreamer_pcp")
    policy, step = session.policy, session.env.step
    assert policy is not None
    forward = policy.forward
    calls: list[tuple[Any, Any]] = [(None, session._now)]
    actions: list[torch.Tensor] = []

    def watched(now: Any) -> Any:
        calls.append((now.clone(), forward(now)))
        return calls[-1][1]

    monkeypatch.setattr(policy, "forward", watched)
    monkeypatch.setattr(session.env, "step", lambda action: actions.append(torch.tensor(action)) or step(action))
    run(session, 4)
    for (_, before), (now, _), action in zip(calls, calls[1:], actions, strict=False):
        torch.testing.assert_close(before["action"][0], action)
        assert (now["latent"] == before["latent"].select(*now["latent"].keys())).all()
        assert not now["is_init"].any()
        assert not torch.equal(now["proprio"], before["proprio"])
    assert len(actions) == len(calls) - 1 == 4


def test_an_agent_acts_without_exploration(play: Callable[..., Session]) -> None:
    session = play()
    assert session.policy is not None
    latent = session._now["latent"].select("state", "belief", "goal")
    mean = session.policy.behaviour.actor[0](TensorDict({"latent": latent}, [1]))["loc"]
    torch.testing.assert_close(session._now["action"], mean)


def test_an_episode_begins_without_memory(play: Callable[..., Session]) -> None:
    session = play("dreamer_pcp")
    session.step()
    assert "latent" in session._before.keys()
    session.reset()
    assert list(session._before.keys()) == ["is_init"]
    assert session._before["is_init"].all()


def test_what_is_imagined_begins_at_the_goal_and_goes_on_alone(play: Callable[..., Session]) -> None:
    session = play("focus_pcp")
    run(session, 3)
    session.set_goal((0.1, 0.1))
    assert session._imagined is not None
    torch.testing.assert_close(session._imagined["belief"], session._now["latent", "belief"])
    begin = session._imagined.clone()
    session.step()
    with torch.no_grad():
        action = session.policy.behaviour.actor(begin_of(begin))["action"]
        next_belief = session.policy.agent.model.transition()(begin_of(begin, action=action))["latent", "belief"]
    torch.testing.assert_close(session._imagined["belief"], next_belief)
    torch.testing.assert_close(session._imagined["goal"], begin["goal"])
    session.env.move_object((-0.2, 0.1))  # behind its back
    session.step()
    assert session.view().believed != session.view().expected


def begin_of(latent: Any, **more: Any) -> Any:
    return TensorDict({"latent": latent.clone(), **more}, [1])


def test_a_simulation_that_breaks_down_begins_anew(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    session.step()
    session.env.data.qvel[:] = np.nan
    with pytest.raises(PlayError, match=r"broke down.*; a new episode begins"):
        session.step()
    run(session, 2)
    assert session.steps == 2
    assert np.isfinite(session.env.true_position()).all()


def test_a_new_episode_begins_somewhere_else(session: Session) -> None:
    first, goal = session.env.true_position().copy(), session.goal
    run(session, 2)
    session.reset()
    assert session.steps == 0
    assert not np.allclose(session.env.true_position(), first)
    assert not np.allclose(session.goal, goal)


def test_the_seed_chooses_the_episodes() -> None:
    starts = []
    for seed in (3, 3, 4):
        with Session("reacher", seed=seed, size=16) as session:
            starts.append(session.env.true_position().tolist())
    assert starts[0] == starts[1] != starts[2]


# Disturbances.


def test_a_moved_object_is_there_and_the_goal_stays(play: Callable[..., Session]) -> None:
    session = play()
    session.set_goal((0.1, 0.1))
    run(session, 3)
    session.move_object((-0.1, -0.15))
    assert session.env.true_position()[0] == pytest.approx(np.array([-0.1, -0.15]), abs=1e-5)
    assert session.goal == pytest.approx(np.array([0.1, 0.1]))
    assert session.steps == 0
    assert session._now["object_position"][0, 0].tolist() == pytest.approx([-0.1, -0.15], abs=0.01)
    assert not session._now["is_init"].any()  # the same episode


def test_a_moved_object_does_not_take_the_goal_image_away(play: Callable[..., Session]) -> None:
    session = play()
    session.set_goal((0.1, 0.1), as_image=True)
    image = given(session).copy()
    session.move_object((-0.1, -0.15))
    assert (given(session) == image).all()


def test_an_object_that_is_moved_at_random_stays_in_the_workspace(session: Session) -> None:
    places = set()
    for _ in range(3):
        session.move_object_at_random()
        position = session.env.true_position()[0]
        assert session.env.workspace.contains(position, tolerance=1e-5)
        places.add(tuple(position))
    assert len(places) == 3


def test_an_object_that_there_is_not(session: Session) -> None:
    with pytest.raises(PlayError, match="there is no object 'cube' here, only finger"):
        session.move_object((0.1, 0.1), "cube")


# What is shown.


def test_the_camera_shows_the_scene_larger_than_the_agent_sees_it(session: Session) -> None:
    view = session.view()
    assert view.camera.shape == (96, 96, 3)
    small = view.camera.reshape(32, 3, 32, 3, 3).mean((1, 3))
    seen = view.seen.reshape(32, 2, 32, 2, 3).mean((1, 3))
    assert abs(small - seen).mean() < 4
    session.env.move_object((-0.1, 0.1) if session.env.true_position()[0, 0] > 0 else (0.1, 0.1))
    assert abs(session.view().camera.astype(int) - view.camera).mean() > 0.5


def test_the_workspace_is_where_it_is(session: Session) -> None:
    corners = [session.places.position(corner) for corner in session.view().workspace]
    expected = np.array([(-0.24, -0.24), (0.24, -0.24), (0.24, 0.24), (-0.24, 0.24)])
    assert np.array(corners) == pytest.approx(expected, abs=1e-5)


def test_what_the_world_model_believes(play: Callable[..., Session]) -> None:
    session = play("focus_pcp")
    run(session, 2)
    view, model = session.view(), session.policy.agent.model
    position = decoded_position(model, session._now["latent"], 0)
    assert position is not None
    assert view.believed == pytest.approx(session.places.point(position))
    units = model.object_position()(begin_of(session._now["latent"]))["object_units"]
    assert position == pytest.approx(0.24 * units[0].detach().numpy(), abs=1e-6)
    assert view.imagined is not None
    assert (view.imagined.shape, view.imagined.dtype) == ((64, 64, 3), np.uint8)
    assert view.masks is not None
    assert view.masks.shape == (1, 64, 64)
    assert 0 <= view.masks.min() < view.masks.max() <= 1


@pytest.mark.parametrize(("row", "masks", "position"), [("dreamer_pcp", False, True), ("lexa_cosine", False, True)])
def test_what_an_agent_does_not_have_is_left_out(
    play: Callable[..., Session], row: str, masks: bool, position: bool
) -> None:
    view = play(row).view()
    assert (view.masks is not None, view.believed is not None) == (masks, position)
    assert view.imagined is not None


def test_an_agent_that_decodes_no_positions(play: Callable[..., Session]) -> None:
    view = play("lexa_cosine", {"world_model.observed": ("proprio",)}).view()
    assert (view.believed, view.expected) == (None, None)


def test_the_scripted_policy_believes_nothing(session: Session) -> None:
    view = session.view()
    assert (view.imagined, view.masks, view.believed, view.expected) == (None, None, None, None)


# Goals with a height.


@pytest.fixture(scope="module")
def lift() -> Iterator[Session]:
    with Session("cube_lift", options={"image_size": 32}, size=64) as session:
        yield session


def test_a_click_keeps_the_height_of_the_goal(lift: Session) -> None:
    lift.set_goal((0.0, 0.1, 0.15))
    place = lift.places.point(np.array([0.1, -0.05, 0.15]))
    lift.set_goal(lift.places.position(place, lift.env.goal_position))
    assert lift.goal == pytest.approx(np.array([0.1, -0.05, 0.15]), abs=1e-5)
    assert lift.view().goal == pytest.approx(place, abs=1e-5)
    on_the_table = lift.places.position(lift.places.point(np.array([0.1, -0.05, 0.0])))
    assert on_the_table == pytest.approx(np.array([0.1, -0.05, 0.0]), abs=1e-5)


def test_the_line_around_the_workspace_is_as_high_as_the_goal(lift: Session) -> None:
    low, high = lift.env.workspace.low, lift.env.workspace.high
    for height in (0.0, 0.12):
        lift.set_goal((0.0, 0.1, height))
        expected = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        for corner, (x, y) in zip(lift.view().workspace, expected, strict=True):
            assert corner == pytest.approx(lift.places.point(np.array([x, y, height])), abs=1e-5)


def test_an_object_is_put_into_the_air(lift: Session) -> None:
    lift.move_object((0.1, -0.1, 0.15))
    assert lift.env.true_position()[0] == pytest.approx(np.array([0.1, -0.1, 0.15]), abs=1e-5)


# Two objects.


@pytest.fixture(scope="module")
def cubes() -> Iterator[Session]:
    task = make_task("cube_move", objects=["cube", "distractor"])
    row = change(AGENTS["dreamer_pcp"], {"behaviours.reach.object": "distractor"})
    policy = build_agent(row, task, "debug").policy()
    with Session("cube_move", policy, options=dict(task.options), size=32) as session:
        yield session


@pytest.mark.slow
def test_the_object_that_a_behaviour_is_about(cubes: Session) -> None:
    cubes.set_goal((0.1, -0.2))
    position = cubes.env.true_position()
    assert cubes.distance == pytest.approx(np.linalg.norm(position[1] - (0.1, -0.2)))
    cubes.move_object((0.15, 0.15))
    assert cubes.env.true_position()[1] == pytest.approx(np.array([0.15, 0.15]), abs=1e-5)
    assert cubes.env.true_position()[0] == pytest.approx(position[0], abs=1e-5)


@pytest.mark.slow
def test_a_drag_moves_the_object_where_it_begins(cubes: Session) -> None:
    for name, place in (("cube", (0.2, -0.2)), ("distractor", (-0.2, 0.2))):
        cubes.move_object(place, name)
    assert cubes.places.nearest_object(cubes.places.point(np.array([0.19, -0.18]))) == "cube"
    assert cubes.places.nearest_object(cubes.places.point(np.array([-0.2, 0.15]))) == "distractor"


# Who acts.


def test_who_can_act(make_agent: Callable[..., Agent], tmp_path: Path) -> None:
    file = str(save_agent(make_agent(), tmp_path / "agent.zip"))
    players = find_players([file, "cube_move/scripted", file])
    scripted = [f"{name}/scripted" for name in ("cube_move", "reacher", "cube_lift", "shelf_place", "pick_place")]
    names = [file, scripted[0], *shipped_agents(), *scripted[1:]]
    assert [player.name for player in players] == names
    assert [player.environment for player in players][:2] == ["reacher", "cube_move"]
    assert players[0].behaviours() == [("reach (finger)", "reach")]
    with players[0].session() as session:
        assert session.policy is not None
        assert session.policy.agent is players[0].agent


def test_an_agent_acts_in_its_task() -> None:
    agent = build_agent("dreamer_pcp", make_task("reacher", image_size=32), "debug")
    with Player("mine", "reacher", agent).session() as session:
        assert session.env.image_size == 32
        session.step()


def test_who_cannot() -> None:
    with pytest.raises(CheckpointError, match=r"no_such\.zip: no such checkpoint"):
        find_players(["no_such.zip"])


def two_behaviours() -> Agent:
    reach = AGENTS["dreamer_pcp"].behaviours["reach"]
    row = AgentConfig(AGENTS["dreamer_pcp"].world_model, {"reach": reach, "again": reach})
    return build_agent(row, make_task("reacher"), "debug")


def test_another_behaviour(tmp_path: Path) -> None:
    file = str(save_agent(two_behaviours(), tmp_path / "agent.zip"))
    (player, *_) = find_players([file], "again")
    assert [name for _, name in player.behaviours()] == ["reach", "again"]
    for behaviour, acts in ((None, "again"), ("reach", "reach")):
        with player.session(behaviour) as session:
            assert session.policy is not None
            assert session.policy.behaviour is session.policy.agent.behaviour(acts)


def test_the_stage_changes_who_acts(make_agent: Callable[..., Agent]) -> None:
    players = [Player("reacher/scripted", "reacher"), Player("ours", "reacher", make_agent("focus_pcp"))]
    with Stage(players, seed=5) as stage:
        first = stage.do(lambda session: session)
        assert first.policy is None
        stage.do(Session.step)
        stage.choose("ours")
        second = stage.do(lambda session: session)
        assert second.policy is not None
        assert second.seed == first.seed == 6
        with pytest.raises(RuntimeError, match="closed"):
            stage.do(lambda session: first.env.render() or first.env.step(np.zeros(2)))
        with pytest.raises(PlayError, match="there is no agent 'theirs' here"):
            stage.choose("theirs")
        assert stage.do(lambda session: session) is second


def test_if_somebody_cannot_act_all_stays_as_it_was(make_agent: Callable[..., Agent]) -> None:
    players = [Player("reacher/scripted", "reacher"), Player("odd", "no_such_environment")]
    with Stage(players) as stage:
        before = stage.do(lambda session: session)
        with pytest.raises(ValueError, match="no_such_environment"):
            stage.choose("odd")
        stage.do(Session.step)
        assert stage.do(lambda session: session) is before
        assert stage.player.name == "reacher/scripted"


class Plain(gymnasium.Env):
    """An environment of somebody else's, without MuJoCo."""

    action_space = observation_space = gymnasium.spaces.Box(-1, 1)


@pytest.mark.usefixtures("registries")
def test_an_environment_that_is_not_ours() -> None:
    register_environment("plain", Plain)
    with pytest.raises(PlayError, match="environment 'plain' is no PositioningEnv; only those can be played with"):
        Session("plain")


def test_closing_twice_does_nothing() -> None:
    session = Session("reacher", size=16)
    assert isinstance(session.env, PositioningEnv)
    session.close()
    session.close()
    with pytest.raises(RuntimeError, match="closed"):
        session.env.step(np.zeros(2))
