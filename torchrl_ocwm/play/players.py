"""Who can act on the page: agents, and the scripted policies of the environments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torchrl_ocwm.agents import Agent, load_agent, shipped_agents
from torchrl_ocwm.envs import ENVIRONMENTS, environment_of
from torchrl_ocwm.envs.registry import not_installed
from torchrl_ocwm.play.session import Session

#: After the name of an environment, its scripted policy, which sees the simulator's true state.
SCRIPTED = "/scripted"


class Player(NamedTuple):
    """Who can act in an environment.

    Args:
        name: What it is called.
        environment: Name of its environment.
        agent: The agent; ``None`` for the scripted policy.
        acting: The behaviour that acts unless another is chosen.
    """

    name: str
    environment: str
    agent: Agent | None = None
    acting: str | None = None

    def behaviours(self) -> list[tuple[str, str]]:
        """What it can do, each as a text with the object that it is about and the name of the behaviour."""
        if self.agent is None:
            return [("scripted", "scripted")]
        names, objects = list(self.agent.config.behaviours), self.agent.task.objects
        return [(f"{name} ({objects[self.agent.behaviour(name).scene.object_index]})", name) for name in names]

    def session(self, behaviour: str | None = None, *, seed: int = 0) -> Session:
        """A session in which it acts."""
        if self.agent is None:
            return Session(self.environment, seed=seed)
        policy, task = self.agent.policy(behaviour or self.acting), self.agent.task
        return Session(environment_of(task).name, policy, options=dict(task.options), seed=seed)


def find_players(agents: Sequence[str], behaviour: str | None = None) -> list[Player]:
    """The agents, those that come with this package, and the scripted policies of the environments.

    Environments whose simulators are not installed are left out, but for those of the given agents.

    Args:
        agents: What :func:`~torchrl_ocwm.load_agent` takes, or the name of an environment and ``/scripted``.
        behaviour: Which behaviour of the first agent acts.

    Raises:
        CheckpointError: for one that cannot be loaded.

    Examples:
        >>> find_players(["cube_move/scripted"])[0]
        Player(name='cube_move/scripted', environment='cube_move', agent=None, acting=None)
    """
    installed = [name for name, one in ENVIRONMENTS.items() if not_installed(one) is None]
    scripted = [f"{name}{SCRIPTED}" for name in installed]
    shipped = [name for name in shipped_agents() if name.partition("/")[0] in installed]
    players = []
    for number, name in enumerate(dict.fromkeys([*agents, *shipped, *scripted])):
        if name in scripted:
            players.append(Player(name, name.removesuffix(SCRIPTED)))
        else:
            policy = load_agent(name, behaviour=None if number else behaviour)
            players.append(Player(name, policy.agent.task.name, policy.agent, None if number else behaviour))
    return players
