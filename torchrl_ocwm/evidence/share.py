"""A trained agent for others: its weights, and a card that says how it was made and how well it does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl_ocwm.agents import agent_name, load_agent, save_agent
from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.agents.sources import AGENT_FILE
from torchrl_ocwm.evaluation.output import writing
from torchrl_ocwm.evaluation.report import Report
from torchrl_ocwm.evidence.estimate import in_words
from torchrl_ocwm.evidence.records import RECORD, Record, RecordError
from torchrl_ocwm.training import CHECKPOINT

CARD = "README.md"


def share(evaluation: Path, folder: Path, *, name: str | None = None) -> Path:
    """Put the agent of an evaluation of ``reproduce`` into a folder, for :func:`~torchrl_ocwm.load_agent`.

    Args:
        evaluation: Folder of the evaluation, among those of all runs.
        folder: Where ``agent.zip``, without the optimiser's state, and its card ``README.md`` go. It can be uploaded to
            the Hugging Face Hub as it is.
        name: What others load it by; by default the folder's path.

    Returns:
        The folder.

    Raises:
        RecordError: if the evaluation is not done, or its training is not beside it.
        CheckpointError: if the checkpoint cannot be read, or the agent cannot be written.
        ReportError: if the results cannot be read.
        OutputError: if the card cannot be written.
    """
    record = Record.read(evaluation / RECORD)
    if not record.done or "trained" not in record.content:
        raise RecordError(f"{evaluation}: not an evaluation that is done")
    training = _training(evaluation, record)
    agent = load_agent(training / CHECKPOINT).agent
    report = Report.load(evaluation / "results.json")
    save_agent(agent, folder / AGENT_FILE)
    with writing(folder / CARD) as file:
        file.write_text(_card(name or str(folder), agent, record, Record.read(training / RECORD), report))
    return folder


def _training(evaluation: Path, record: Record) -> Path:
    """The training of the same content, wherever all runs have been moved to."""
    for folder in sorted((evaluation.parents[1] / "trainings").glob("*")):
        if (folder / RECORD).exists() and Record.read(folder / RECORD).content == record.content["trained"]:
            return folder
    raise RecordError(f"{evaluation}: its training is not in {evaluation.parents[1] / 'trainings'}")


def _card(name: str, agent: Agent, evaluated: Record, trained: Record, report: Report) -> str:
    task, data, training = agent.task, trained.content["data"], trained.content["training"]
    row = agent_name(agent.config)
    steps = (
        " and ".join(f"{count:,} {policy} steps" for policy, count in data.get("policies", [])) or "an explorer's steps"
    )
    facts = {
        "agent": f"`{row}`",
        "environment": f"`{task.name}`, {_written(task.options)}",
        "parameters": f"{sum(one.numel() for one in agent.model.parameters()):,} in the world model",
        "data": f"{steps}, seed {data['seed']}",
        "training": f"{training['updates']:,} updates, seed {training['seed']}, {in_words(trained.seconds)}",
        "machine": trained.machine,
        "commit": trained.commit,
    }
    settings = report.settings
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
            f"that no training saw, evaluated at commit {evaluated.commit}:",
            "",
            report.markdown(),
            "",
        ]
    )


def _written(options: Any) -> str:
    return ", ".join(f"{name}={value}" for name, value in options.items()) or "default options"
