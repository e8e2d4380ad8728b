"""A trained agent for others: its weights, and a card that says how it was made and how well it does."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from torchrl_ocwm.agents import agent_name, load_agent, save_agent
from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.agents.sources import AGENT_FILE, is_name
from torchrl_ocwm.data import DatasetError, EpisodeDataset
from torchrl_ocwm.evaluation.output import writing
from torchrl_ocwm.evaluation.report import Report
from torchrl_ocwm.evidence.estimate import in_words
from torchrl_ocwm.evidence.records import RECORD, Record, RecordError
from torchrl_ocwm.origin import MADE
from torchrl_ocwm.settings import flat
from torchrl_ocwm.training import CHECKPOINT

CARD = "README.md"


def share(evaluation: Path, folder: Path, *, name: str | None = None) -> Path:
    """Put the agent of an evaluation into a folder, for :func:`~torchrl_ocwm.load_agent`.

    Args:
        evaluation: Folder of the evaluation of one agent: one of ``reproduce``, or what ``evaluate`` wrote.
        folder: Where ``agent.zip``, without the optimiser's state, and its card ``README.md`` go. It can be uploaded to
            the Hugging Face Hub as it is.
        name: What others load it by; by default the folder's path.

    Returns:
        The folder.

    Raises:
        RecordError: if the evaluation is not done, or its training is not where it was.
        CheckpointError: if the checkpoint cannot be read, or the agent cannot be written.
        ReportError: if the results cannot be read.
        OutputError: if the card cannot be written.
    """
    checkpoint, facts = _of_reproduce(evaluation) if (evaluation / RECORD).exists() else _of_evaluate(evaluation)
    agent, report = load_agent(checkpoint).agent, Report.load(evaluation / "results.json")
    card = _card(name or str(folder), agent, facts, report)
    save_agent(agent, folder / AGENT_FILE)
    with writing(folder / CARD) as file:
        file.write_text(card, encoding="utf-8")
    return folder


def _of_reproduce(evaluation: Path) -> tuple[Path, dict[str, str]]:
    """The checkpoint, and what is known of its training, which lies beside, wherever all runs have been moved to."""
    record = Record.read(evaluation / RECORD)
    if not record.done or "trained" not in record.content:
        raise RecordError(f"{evaluation}: not an evaluation that is done")
    for folder in sorted((evaluation.parents[1] / "trainings").glob("*")):
        if (folder / RECORD).exists() and _agree((trained := Record.read(folder / RECORD)).content, record.content):
            break
    else:
        raise RecordError(f"{evaluation}: its training is not in {evaluation.parents[1] / 'trainings'}")
    data, training = trained.content["data"], trained.content["training"]
    seed = data.get("plain", data)["seed"]
    return folder / CHECKPOINT, {
        "data": f"{_steps(data)}, seed {seed}",
        "training": f"{training['updates']:,} updates, seed {training['seed']}, {in_words(trained.seconds)}",
        "machine": trained.machine,
        "commit": f"{trained.commit}, evaluated at {record.commit}",
    }


def _steps(data: dict[str, Any]) -> str:
    """Whose the steps of a dataset are: of policies, and of an agent that learnt meanwhile."""
    if "plain" in data:
        return f"{_steps(data['plain'])}, with goals of {data['virtual_target']} pixels in the images"
    if "policies" in data:
        return _in_words(data["policies"])
    online = data["online"]
    own = online["steps"] - sum(online["seed_steps"])
    return f"{_first(online)}, and {own:,} of an agent that learnt meanwhile"


def _first(online: Mapping[str, Any]) -> str:
    return _in_words(zip(online["seed_policy"], online["seed_steps"], strict=True))


def _in_words(steps: Iterable[tuple[str, int]]) -> str:
    return " and ".join(f"{count:,} {policy} steps" for policy, count in steps)


def _agree(trained: dict[str, Any], evaluated: dict[str, Any]) -> bool:
    """Whether an evaluation is of that training; a setting that only one of them has came with a release between."""
    one, other = flat(trained), flat(evaluated["trained"])
    return all(one[name] == other[name] for name in one.keys() & other.keys())


def _of_evaluate(evaluation: Path) -> tuple[Path, dict[str, str]]:
    """The checkpoint, and what the settings beside it say."""
    sources = [one for row in Report.load(evaluation / "results.json").rows.values() for one in row.sources]
    files = list(dict.fromkeys(one for one in sources if isinstance(one, Path)))
    names = [one for one in sources if is_name(one)]
    if names and not files:
        raise RecordError(
            f"{evaluation}: is of {names[0]}, which others have by that name; there is no checkpoint of yours to share"
        )
    if len(files) != 1:
        raise RecordError(f"{evaluation}: is of {len(files)} checkpoints; evaluate the one to share alone")
    settings = files[0].parent / "config.yaml"
    if not settings.exists():
        raise RecordError(f"{settings}: no such file; the card says what it has of the training")
    config: Any = OmegaConf.to_container(OmegaConf.load(settings))
    training = config["training"]
    return files[0], {
        "data": _data(config, settings.parent),
        "training": f"{training['updates']:,} updates, seed {training['seed']}",
        **_made(settings.parent / MADE),
    }


def _made(file: Path) -> dict[str, str]:
    """What a run says of its commit and machine; those of releases before say nothing."""
    if not file.exists():
        return {}
    try:
        said = json.loads(file.read_text(encoding="utf-8"))
        return {name: str(said[name]) for name in ("machine", "commit")}
    except (ValueError, KeyError, TypeError) as error:
        raise RecordError(f"{file}: cannot be read ({error!r}); without it the card names no commit") from error


def _data(config: Mapping[str, Any], folder: Path) -> str:
    """Who collected what a run in a folder learnt from, as far as its settings and its dataset say."""
    if (online := config.get("online")) is not None:
        return f"{_first(online)}, and then its own, {online['update_ratio']} updates per step"
    try:
        with EpisodeDataset.open(folder / config["dataset"]) as dataset:
            policies = dataset.metadata.get("policies", {})
            episodes = " and ".join(f"{count:,} {policy} episodes" for policy, count in policies.items())
            return f"{dataset.num_steps:,} steps, {episodes or 'recordings'}"
    except DatasetError:
        return "not where it was"


def _card(name: str, agent: Agent, more: dict[str, str], report: Report) -> str:
    task, settings = agent.task, report.settings
    facts = {
        "agent": f"`{agent_name(agent.config)}`",
        "environment": f"`{task.name}`, {_written(task.options)}",
        "parameters": f"{sum(one.numel() for one in agent.model.parameters()):,} in the world model",
        **more,
    }
    return "\n".join(
        [
            "---",
            "library_name: torchrl_ocwm",
            "pipeline_tag: robotics",
            "license: mit",
            "tags: [reinforcement-learning, robotics, world-model, torchrl]",
            "---",
            "",
            f"# {name}",
            "",
            f"An agent of torchrl_ocwm that positions an object in `{task.name}`.",
            "",
            "```python",
            "from torchrl_ocwm import load_agent",
            "",
            f'policy = load_agent("{name}")  # a TensorDictModule for any rollout of its task; no simulator is needed',
            "```",
            "",
            "| | |",
            "|---|---|",
            *(f"| {what} | {value} |" for what, value in facts.items()),
            "",
            f"{settings['goals']} goals on a grid over the workspace, {settings['episode_steps']} steps each, starts "
            "that no training saw:",
            "",
            report.markdown(),
            "",
        ]
    )


def _written(options: Any) -> str:
    return ", ".join(f"{name}={value}" for name, value in options.items()) or "default options"
