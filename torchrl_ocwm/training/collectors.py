"""TorchRL's collectors, to play whole episodes while an agent learns."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib.util import find_spec
from itertools import count
from threading import Thread, Timer
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.data.seeds import episode_seed
from torchrl_ocwm.errors import MissingPackageError
from torchrl_ocwm.modules.acting import LATENT
from torchrl_ocwm.processes import end_with_parent, interrupts_ignored
from torchrl_ocwm.training.settings import Online

#: Key of an episode's number, ``[1]`` int64, in all of its steps.
NUMBER = "episode"


class NumberedEnv(TransformedEnv):
    """An environment whose episodes have numbers, from which their starts come.

    Args:
        env: The environment, of batch size ``[]``.
        seed: Seed of the run.
        first: Number of the first episode.
        every: From one number to the next; as many workers share the numbers.
    """

    def __init__(self, env: EnvBase, *, seed: int, first: int, every: int) -> None:
        super().__init__(env)
        self.run_seed, self.numbers = seed, count(first, every)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        number = next(self.numbers)
        start = super()._reset(tensordict, **{"seed": episode_seed("train", self.run_seed, number), **kwargs})
        return start.set(NUMBER, torch.tensor([number]))


class Turns(TensorDictModuleBase):
    """Behaviours of an agent that act in turn, one episode each; what one draws comes from the episode's number.

    Args:
        agent: The agent.
        behaviours: Their names.
        seed: Seed of the run.

    Raises:
        ValueError: for a behaviour that the agent does not have.
    """

    def __init__(self, agent: Agent, behaviours: Sequence[str], *, seed: int) -> None:
        super().__init__()
        # Without the agent that a policy knows: all of this is sent to other processes.
        policies = [TensorDictSequential(*agent.policy(name).module) for name in behaviours]
        self.policies, self.seed = nn.ModuleList(policies), seed
        self.in_keys = list(dict.fromkeys(key for policy in policies for key in policy.in_keys))
        self.out_keys = ["action", *LATENT]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next action, and what the policy remembers."""
        number = int(tensordict[NUMBER])
        if tensordict["is_init"].all():
            torch.manual_seed(episode_seed("train", self.seed, number))
        acted = self.policies[number % len(self.policies)](tensordict.copy())
        return tensordict.update(acted.select(*self.out_keys))


def make_collector(
    make: Callable[[], EnvBase], policy: Turns, online: Online, *, first: int, chunk: int
) -> BaseCollector:
    """A collector of TorchRL's, each of whose batches holds the steps of whole episodes, one after the other.

    Args:
        make: Makes an environment.
        policy: Acts; its weights reach other processes by :func:`send_weights`.
        online: Which collector, and how many processes.
        first: Number of the first episode.
        chunk: Steps after which a worker reports.

    Raises:
        MissingPackageError: if Ray is asked for and missing, with the extra to install.
    """
    every = max(online.workers, 1)
    envs = [partial(_numbered, make, policy.seed, first + worker, every) for worker in range(every)]
    whole: dict[str, Any] = {"trajs_per_batch": 1, "traj_format": "cat", "use_buffers": False, "trust_policy": True}
    if not online.workers:
        return Collector(envs[0], policy, frames_per_batch=chunk, total_frames=-1, **whole)
    if online.collector == "ray":
        return _ray_collector(envs, policy, chunk, whole)
    sync = online.collector == "sync"
    if sync:
        chunk, whole = chunk * every, {**whole, "trajs_per_batch": every}
    with interrupts_ignored():
        return Collector(
            [partial(_in_worker, one) for one in envs],
            policy,
            num_collectors=every,
            sync=sync,
            frames_per_batch=chunk,
            total_frames=-1,
            num_threads=torch.get_num_threads(),  # of this process, which updates
            **whole,
        )


def send_weights(collector: BaseCollector, timeout: float) -> None:
    """Let a collector's processes act with the weights that its policy has now.

    Raises:
        RuntimeError: if a process has ended or hangs.
    """
    failed: list[Exception] = []

    def send() -> None:
        try:
            collector.update_policy_weights_()
        except Exception as error:  # raised below
            failed.append(error)

    # TorchRL waits without end for the answer of a process that has ended.
    sending = Thread(target=send, daemon=True)
    sending.start()
    until = time.monotonic() + timeout
    while sending.is_alive():
        sending.join(0.1)
        if time.monotonic() > until or not all(process.is_alive() for process in getattr(collector, "procs", ())):
            raise RuntimeError("a process that plays has ended, or does not take new weights")
    if failed:
        raise RuntimeError(f"new weights have not reached the processes that play ({failed[0]})") from failed[0]


def next_episodes(batches: Iterator[TensorDictBase], collector: BaseCollector, timeout: float) -> list[TensorDictBase]:
    """The episodes ``[T]`` of a collector's next batch, by their numbers.

    Raises:
        RuntimeError: if a simulator fails, or a process has ended or hangs.
    """
    try:
        with _ended_after(timeout, collector):
            batch = next(batches)
    except _ray_errors() as error:
        raise RuntimeError(str(error)) from error
    ends = batch["next", "done"].flatten().nonzero().flatten() + 1
    episodes = batch.split(ends.diff(prepend=ends.new_zeros(1)).tolist())
    return sorted(episodes, key=lambda episode: int(episode[NUMBER][0]))


def end(collector: BaseCollector) -> None:
    """End a collector and its processes at once. They keep nothing that would have to be written, and may hang."""
    _kill(collector)
    collector.shutdown()


def _kill(collector: BaseCollector) -> None:
    for process in getattr(collector, "procs", ()):
        with suppress(ValueError):  # it has ended, and TorchRL has noticed
            process.kill()
    getattr(collector, "stop_remote_collectors", lambda: None)()


@contextmanager
def _ended_after(seconds: float, collector: BaseCollector) -> Iterator[None]:
    """Kill what hangs: TorchRL's collectors notice a process that has ended, but wait for one that hangs."""
    timer = Timer(seconds, _kill, [collector])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _ray_errors() -> tuple[type[Exception], ...]:
    ray = sys.modules.get("ray.exceptions")
    return () if ray is None else (ray.RayError,)


def _numbered(make: Callable[[], EnvBase], seed: int, first: int, every: int) -> EnvBase:
    return NumberedEnv(make(), seed=seed, first=first, every=every)


def _in_worker(make: Callable[[], EnvBase]) -> EnvBase:
    end_with_parent()
    return make()


def _ray_collector(
    envs: Sequence[Callable[[], EnvBase]], policy: Turns, chunk: int, whole: dict[str, Any]
) -> BaseCollector:
    if find_spec("ray") is None:
        raise MissingPackageError("collector=ray needs Ray: pip install 'torchrl-ocwm[ray]'", name="ray")
    from torchrl.collectors.distributed.ray import DEFAULT_RAY_INIT_CONFIG, RayCollector

    return RayCollector(
        list(envs),
        policy,
        frames_per_batch=chunk,
        total_frames=sys.maxsize,
        collector_kwargs=[dict(whole) for _ in envs],
        ray_init_config={**DEFAULT_RAY_INIT_CONFIG, "log_to_driver": False, "logging_level": "warning"},
    )
