"""The paper's tables and figures as data: which rows each compares, and what it draws of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from torchrl_ocwm.evidence.runs import Collected, Evaluated, Explored, Trained, all_options
from torchrl_ocwm.evidence.settings import Evidence
from torchrl_ocwm.settings import SettingsError


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row of a figure, trained with each seed.

    Args:
        name: What it is called.
        agent: A row of agents.
        changes: Settings of the agent that are otherwise, by dotted names.
        options: Options of the environment that are otherwise.
        data: Who collects: a policy or an explorer; none: those of the environment.
        image_goals: Whether it is evaluated with images as goals too.
        random: Whether random actions are evaluated beside it.
        line: The line of the drawing that it belongs to.
        at: Its place on that line.
    """

    name: str
    agent: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    data: str = ""
    image_goals: bool = False
    random: bool = False
    line: str = ""
    at: str = ""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A table or figure of the paper.

    Args:
        title: What it shows, in a line.
        rows: What it compares.
        draws: What is drawn of it: scores over the workspace, scores over updates, metrics over the rows' places.
        metrics: The metrics of the last.
        places: What the places are.
    """

    title: str
    rows: tuple[Row, ...]
    draws: tuple[Literal["heatmap", "curves", "lines"], ...]
    metrics: tuple[str, ...] = ()
    places: str = ""


@dataclass(frozen=True, kw_only=True)
class Setup:
    """How an environment is used.

    Args:
        policies: Who collects, and what share of the steps.
        acting: An agent, a row, whose own steps are the other half; none: policies collect all.
        options: Options of the environment.
        small: Further options at the sizes for a CPU.
        episode_steps: Steps of each evaluated episode.
        updates: How many times as many updates as Reacher it needs.
    """

    policies: Mapping[str, float]
    acting: str = ""
    options: Mapping[str, Any]
    small: Mapping[str, Any] = field(default_factory=dict)
    episode_steps: int
    updates: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Budget:
    """How much of everything goes with a size.

    Args:
        steps: Environment steps of a dataset.
        updates: Updates of a run on Reacher.
        goals: Goals of an evaluation.
        small: Whether environments have their smaller images.
        options: Options of the environment, above all others.
        episode_steps: Steps of each evaluated episode; none: those of the environment.
    """

    steps: int
    updates: int
    goals: int = 100
    small: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)
    episode_steps: int | None = None


def _weights(entity: float, goal: float) -> dict[str, float]:
    return {"world_model.lambda_object_position": entity, "world_model.lambda_goal_position": goal}


def _both(agent: str, **more: Any) -> tuple[Row, ...]:
    """A baseline with the paper's weights, and with those that position our other rows' entity."""
    return tuple(
        Row(name=f"{agent}, weights {weight}", agent=agent, changes=_weights(weight, weight), **more)
        for weight in (1, 200)
    )


#: Also where random actions are measured, so that figures share that too.
_LCP = Row(name="focus_lcp", agent="focus_lcp", image_goals=True, random=True)
_PCP = Row(name="dreamer_pcp", agent="dreamer_pcp")
_GOALS = "behaviours.reach.goals"
_UNSEEN = {"world_model.observed": ["proprio"], "world_model.predicted": ["object_position"]}
_IN_UNITS = {"behaviours.reach.reward.unit": "workspace"}
_PAPERS_LCP = {"behaviours.reach.goal.weight": 1, "behaviours.reach.reward": "latent_similarity"}
_CENTRED = {"behaviours.reach.reward.centred": True}
_SHOWN = {_GOALS: "frames"}
_LIGHT = {"behaviours.reach.goal.weight": 1}
_ANNEALED = {"behaviours.reach.goal.final_weight": 1, "behaviours.reach.goal.annealing_updates": 1500}
_ENCODER = {"behaviours.reach.goal.gradient": "encoder"}
_TABLE = (
    *_both("dreamer"),
    _PCP,
    *_both("focus"),
    Row(name="focus_pcp", agent="focus_pcp"),
    _LCP,
)
#: An acting agent: updates per step of others and of its own, and rounds.
_LEARNING, _ROUNDS = (0.2, 0.4), 4
#: Pixels of the disc at the goal, where only with or without it is compared.
_TARGET = 5

FIGURES = {
    "table": Figure(
        title="Dreamer, FOCUS, PCP and LCP (the paper's main table)", rows=_TABLE, draws=("heatmap", "curves")
    ),
    "limits": Figure(
        title="What Dreamer and FOCUS lack: the goal in the image, or in their latent",
        rows=tuple(
            Row(
                name=f"{agent}, weights {weight}, {place}",
                agent=agent,
                changes=_weights(weight, weight),
                options=options,
                line=f"{agent}, weights {weight}",
                at=place,
            )
            for agent in ("dreamer", "focus")
            for weight in (1, 200)
            for place, options in (("no target", {}), ("virtual target", {"virtual_target": _TARGET}))
        ),
        draws=("lines", "heatmap"),
        metrics=("success", "entity_error", "goal_error"),
        places="in the image",
    ),
    "target_size": Figure(
        title="How large the goal has to be in the image for Dreamer",
        rows=tuple(
            Row(
                name=f"dreamer, target of {pixels} pixels",
                agent="dreamer",
                changes=_weights(1, 1),
                options={"virtual_target": pixels},
                line="dreamer",
                at=str(pixels),
            )
            for pixels in (1, 2, 3, 5, 8, 12)
        ),
        draws=("lines",),
        metrics=("goal_error", "final_score", "predicted_return", "obtained_return"),
        places="diameter of the target, pixels",
    ),
    "loss_scale": Figure(
        title="How much the goal has to weigh in Dreamer's reconstruction",
        rows=tuple(
            Row(
                name=f"dreamer, goal weight {weight}",
                agent="dreamer",
                changes=_weights(1, weight),
                line="dreamer",
                at=str(weight),
            )
            for weight in (1, 10, 100, 1000)
        ),
        draws=("lines", "heatmap"),
        metrics=("goal_error", "entity_error", "final_score", "success"),
        places="weight of the goal position",
    ),
    "visual_goals": Figure(
        title="Goals given as images: LEXA, and FOCUS + LCP with images and positions",
        rows=(
            Row(name="lexa_cosine", agent="lexa_cosine"),
            Row(name="lexa_temporal", agent="lexa_temporal"),
            _LCP,
        ),
        draws=("heatmap", "curves"),
    ),
    "fairness": Figure(
        title="What departures from the paper do for PCP and LCP",
        rows=(
            _PCP,
            Row(name="dreamer_pcp, position not observed", agent="dreamer_pcp", changes=_UNSEEN),
            Row(name="dreamer_pcp, goals that the data shows", agent="dreamer_pcp", changes=_SHOWN),
            Row(name="dreamer_pcp, reward in workspace units", agent="dreamer_pcp", changes=_IN_UNITS),
            _LCP,
            Row(name="focus_lcp, cosine and weight 1", agent="focus_lcp", changes=_PAPERS_LCP, image_goals=True),
            Row(name="focus_lcp, centred latents", agent="focus_lcp", changes=_CENTRED, image_goals=True),
            Row(name="focus_lcp, goals that the data shows", agent="focus_lcp", changes=_SHOWN, image_goals=True),
        ),
        draws=("heatmap", "curves"),
    ),
    "goal_latents": Figure(
        title="How the latents of objects and of goals are made alike",
        rows=(
            _LCP,
            Row(name="focus_lcp, weight 1", agent="focus_lcp", changes=_LIGHT, image_goals=True),
            Row(name="focus_lcp, weight from 100 to 1", agent="focus_lcp", changes=_ANNEALED, image_goals=True),
            Row(name="focus_lcp, centred latents", agent="focus_lcp", changes=_CENTRED, image_goals=True),
            Row(name="focus_lcp, only the encoder learns", agent="focus_lcp", changes=_ENCODER, image_goals=True),
            Row(
                name="focus_lcp, only the encoder learns, centred latents",
                agent="focus_lcp",
                changes=_ENCODER | _CENTRED,
                image_goals=True,
            ),
        ),
        draws=("heatmap", "curves"),
    ),
    "curves": Figure(title="Scores while agents learn, on five of the landmark goals", rows=_TABLE, draws=("curves",)),
    "exploration": Figure(
        title="FOCUS + LCP on data of different explorers",
        rows=tuple(
            Row(name=f"focus_lcp on {data}", agent="focus_lcp", data=data, image_goals=True, random=True)
            for data in ("focus_explore", "plan2explore", "random", "scripted")
        ),
        draws=("heatmap", "curves"),
    ),
}

_BOTH, _MOSTLY_SCRIPTED = {"scripted": 0.5, "random": 0.5}, {"scripted": 0.75, "random": 0.25}
# On scripted and random steps alone agents believe that they are at the goal, and are not.
_ACTING = "focus_pcp"
_CUBE = Setup(
    policies=_MOSTLY_SCRIPTED,
    acting=_ACTING,
    options={"horizon": 100},
    small={"image_size": 32, "mask_scale": 5},
    episode_steps=100,
    updates=5.0,
)
# The hand starts high above the object: with one control step per action, imagination does not look that far ahead.
_META_WORLD = Setup(
    policies=_MOSTLY_SCRIPTED,
    acting=_ACTING,
    options={"horizon": 60, "action_repeat": 4},
    small={"image_size": 32, "mask_scale": 5},
    episode_steps=60,
    updates=5.0,
)
SETUPS = {
    "reacher": Setup(policies=_BOTH, options={"horizon": 100}, episode_steps=150),
    "cube_move": _CUBE,
    "cube_lift": _CUBE,
    "shelf_place": _META_WORLD,
    "pick_place": _META_WORLD,
}
_TINY = {"image_size": 16, "horizon": 20}
BUDGETS = {
    "debug": Budget(steps=80, updates=4, goals=4, small=True, options=_TINY, episode_steps=3),
    "cpu": Budget(steps=50_000, updates=1_500, small=True),
    "small": Budget(steps=200_000, updates=20_000),
    "paper": Budget(steps=1_000_000, updates=250_000),
    "large": Budget(steps=1_000_000, updates=250_000),
}


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a row of a figure is, in one environment and with one seed."""

    row: Row
    env: str
    evaluated: Evaluated


def results(wanted: Evidence) -> list[Result]:
    """All that a figure needs, seed by seed, so that a whole one is there early.

    Raises:
        SettingsError: for a size or an environment whose steps and updates are not known, or an agent that the figure
            does not have.
    """
    rows = _rows(wanted)
    return [
        Result(row=row, env=env, evaluated=_evaluated(row, env, seed, wanted))
        for seed in range(wanted.seeds)
        for env in wanted.environments
        for row in rows
    ]


def _rows(wanted: Evidence) -> list[Row]:
    rows = FIGURES[wanted.figure].rows
    known = dict.fromkeys(row.agent for row in rows)
    if odd := [name for name in wanted.agents if name not in known]:
        raise SettingsError(f"agents must be of those of figure={wanted.figure}, {', '.join(known)}; got {odd[0]!r}")
    return [row for row in rows if row.agent in (wanted.agents or known)]


def _evaluated(row: Row, env: str, seed: int, wanted: Evidence) -> Evaluated:
    budget, setup = _known(BUDGETS, "size", wanted.size), _known(SETUPS, "env", env)
    data = _data(row, env, wanted.steps or budget.steps, setup, budget, wanted.size)
    updates = wanted.updates or round(budget.updates * setup.updates)
    episode_steps = budget.episode_steps or setup.episode_steps
    trained = Trained(
        data=data,
        agent=row.agent,
        changes=row.changes,
        size=wanted.size,
        seed=seed,
        updates=updates,
        episode_steps=episode_steps,
    )
    return Evaluated(
        trained=trained,
        goals=wanted.goals or budget.goals,
        episode_steps=episode_steps,
        image_goals=row.image_goals,
        random=row.random,
    )


def _data(row: Row, env: str, steps: int, setup: Setup, budget: Budget, size: str) -> Collected | Explored:
    small = setup.small if budget.small else {}
    options = {**setup.options, **small, **budget.options, **row.options}
    if row.data in ("random", "scripted"):
        return Collected(env=env, options=options, policies={row.data: steps})
    if row.data:
        return Explored(env=env, options=options, explorer=row.data, size=size, steps=steps)
    if not setup.acting:
        return Collected(env=env, options=options, policies=dict(_shared_out(steps, setup.policies)))
    own = steps // 2
    return Explored(
        env=env,
        options=options,
        explorer=setup.acting,
        size=size,
        steps=steps,
        policies=dict(_shared_out(steps - own, setup.policies)),
        update_ratios=_LEARNING,
        round_episodes=max(1, own // (_ROUNDS * all_options(env, options).horizon)),
    )


def _shared_out(steps: int, shares: Mapping[str, float]) -> Iterator[tuple[str, int]]:
    done, until = 0, 0.0
    for policy, share in shares.items():
        until += share
        yield policy, round(steps * until) - done
        done = round(steps * until)


def _known(table: Mapping[str, Any], setting: str, name: str) -> Any:
    if name not in table:
        raise SettingsError(f"{setting} must be one of {', '.join(table)}, whose figures are known, got {name!r}")
    return table[name]
