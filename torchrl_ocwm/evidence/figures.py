"""The paper's tables and figures as data: which rows each compares, and what it draws of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal


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
_SMALL_IMAGES = {"image_size": 32, "mask_scale": 2}  # with masks as fine as those of 64 × 64
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
        title="What departures from the paper do",
        rows=(
            _PCP,
            Row(name="dreamer_pcp, position not observed", agent="dreamer_pcp", changes=_UNSEEN),
            Row(name="dreamer_pcp, goals that the data shows", agent="dreamer_pcp", changes=_SHOWN),
            Row(name="dreamer_pcp, reward in workspace units", agent="dreamer_pcp", changes=_IN_UNITS),
            _LCP,
            Row(name="focus_lcp, cosine and weight 1", agent="focus_lcp", changes=_PAPERS_LCP, image_goals=True),
            Row(name="focus_lcp, centred latents", agent="focus_lcp", changes=_CENTRED, image_goals=True),
            Row(name="focus_lcp, goals that the data shows", agent="focus_lcp", changes=_SHOWN, image_goals=True),
            *(
                Row(name=f"{agent}, weights 1{images}", agent=agent, changes=_weights(1, 1), options=options)
                for agent in ("dreamer", "focus")
                for images, options in (("", {}), (", images of 32 × 32", _SMALL_IMAGES))
            ),
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
