"""How a training run goes."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal

from torchrl_ocwm.settings import Settings, SettingsError, setting

#: What a run that goes on may do with a setting: keep it as it was, change it when told so, change it freely.
Resume = Literal["same", "asked", "free"]


@dataclass(frozen=True)
class Training(Settings):
    """Settings of a training run.

    A run that goes on is held to the settings that decide what is learnt. ``seed`` stays as it was; ``goals``,
    ``mixed_precision``, ``final_lr``, ``target_rate`` and the dataset change only if ``changed`` names them. The others
    may change at any time.

    Args:
        updates: Updates of model, actor and critic in all.
        seed: Seeds weights and sampling.
        device: Where to train.
        threads: Threads of PyTorch on a CPU; 0 leaves PyTorch's own choice. ``None``: one where the networks are as
            small as those of the size ``cpu``, which leaves a core to evaluations, otherwise PyTorch's own choice.
        log_interval: Updates between two lines of the log, over which losses are averaged.
        checkpoint_interval: Updates between two checkpoints.
        eval_interval: Updates between two evaluations; 0 for none.
        eval_episodes: Episodes per evaluation, to as many of the task's landmark goals, drawn anew each time.
        eval_steps: Steps per episode.
        eval_beside: Evaluate a copy of the weights in a process of its own, while training goes on; ``None`` does so if
            the updates leave a core free. What is learnt does not depend on it.
        video_interval: Updates between two open-loop prediction videos; 0 for none.
        goals: Goals of the sampled sequences: ``"uniform"`` draws a fresh one for each, ``"stored"`` keeps those of the
            dataset, ``"auto"`` keeps them if the images show them (``virtual_target``), and draws them otherwise.
        compile: Compile the update. This takes minutes and needs PyTorch 2.12 or newer; ``None`` does not compile.
        cudagraph: Capture the update in a CUDA graph; ``None`` does so on a GPU.
        mixed_precision: Products and convolutions in bfloat16. Faster where the device has instructions for it, and the
            model is not small.
        final_lr: Share of the learning rates that is left at the last update; they fall linearly. A policy stops within
            millimetres of its goal only with a small one (docs/results/reacher).
        target_rate: Share of the critic that moves into the slow critic at each update.
        loggers: Where to log beside the CSV files.
        changed: What is meant to differ from what the folder's checkpoint was trained with: names of settings above,
            and ``"dataset"`` for one that has grown or is another.
    """

    updates: int = setting(10_000, at_least=1, at_most=10**9)
    seed: int = setting(0, at_least=0, at_most=2**32 - 1, resume="same")
    device: str = "cpu"
    threads: int | None = setting(None, at_least=0, at_most=1024)
    log_interval: int = setting(50, at_least=1)
    checkpoint_interval: int = setting(500, at_least=1)
    eval_interval: int = setting(500, at_least=0)
    eval_episodes: int = setting(10, at_least=1)
    eval_steps: int = setting(100, at_least=1)
    eval_beside: bool | None = None
    video_interval: int = setting(2000, at_least=0)
    goals: Literal["auto", "uniform", "stored"] = setting("auto", resume="asked")
    compile: bool | None = None
    cudagraph: bool | None = None
    mixed_precision: bool = setting(False, resume="asked")
    final_lr: float = setting(0.1, at_least=0, at_most=1, resume="asked")
    target_rate: float = setting(0.02, above=0, at_most=1, resume="asked")
    loggers: tuple[Literal["tensorboard", "wandb"], ...] = ()
    changed: tuple[str, ...] = ()

    def validate(self) -> None:
        """Only what may change can be said to."""
        for name in self.changed:
            if name not in self.changeable():
                raise SettingsError(f"changed must name {', '.join(self.changeable())}, got {name!r}")

    @classmethod
    def changeable(cls) -> list[str]:
        """What ``changed`` can name."""
        return ["dataset", *(one.name for one in fields(cls) if _resume(one) == "asked")]

    def deciding(self) -> dict[str, Any]:
        """The settings that decide what is learnt."""
        return {one.name: getattr(self, one.name) for one in fields(self) if _resume(one) != "free"}


@dataclass(frozen=True)
class Online(Settings):
    """How an agent collects while it learns. All of it may change when a run goes on.

    A run begins with the seed steps, makes ``seed_updates``, and then alternates: a round of episodes, played with the
    weights of that moment, and the updates that its steps are due.

    Args:
        steps: Environment steps, seed steps included, after which nothing more is collected; updates go on.
        seed_policy: Who collects the seed steps, one after the other: names or checkpoints, as ``policy`` of a
            collection (:class:`~torchrl_ocwm.data.settings.Collection`).
        seed_steps: Environment steps of each of them.
        seed_updates: Updates before the first round.
        update_ratio: Updates per environment step afterwards.
        round_episodes: Episodes of a round; with ``"sync"`` as many as all workers play at a time, or a multiple.
        behaviours: Behaviours of the agent that act in turn, one episode each; none: all that it has.
        collector: ``"sync"`` collects and updates in turn, ``"async"`` also collects during updates, with weights that
            are up to a round old; ``"ray"`` is ``"async"`` in the processes of a Ray cluster.
        workers: Processes that play, one environment each; 0 plays in this one, with ``"sync"`` only.
        timeout: Seconds without a whole episode of a worker after which all count as hanging and are replaced.

    Raises:
        SettingsError: for a setting out of its range, with its name.
    """

    steps: int = setting(100_000, at_least=1)
    seed_policy: tuple[str, ...] = ("random",)
    seed_steps: tuple[int, ...] = setting((5_000,), at_least=1)
    seed_updates: int = setting(100, at_least=1)
    update_ratio: float = setting(0.25, above=0)
    round_episodes: int = setting(2, at_least=1)
    behaviours: tuple[str, ...] = ()
    collector: Literal["sync", "async", "ray"] = "sync"
    workers: int = setting(2, at_least=0, at_most=1024)
    timeout: float = setting(600.0, above=0)

    def validate(self) -> None:
        """Each seed policy has its steps, and collectors have the processes that they need."""
        if not self.seed_policy or len(self.seed_policy) != len(self.seed_steps):
            raise SettingsError(
                f"seed_steps must have one number for each seed_policy, got {list(self.seed_steps)} for "
                f"{list(self.seed_policy)}"
            )
        if self.collector != "sync" and not self.workers:
            raise SettingsError(f"workers must be at least 1 with collector={self.collector}, got 0")


def _resume(one: Any) -> Resume:
    return one.metadata.get("resume", "free")
