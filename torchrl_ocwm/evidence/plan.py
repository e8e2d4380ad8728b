"""What a figure is made of, as runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from torchrl_ocwm.evidence.datasets import Collected, Data, Drawn, Explored
from torchrl_ocwm.evidence.figures import FIGURES, Row
from torchrl_ocwm.evidence.options import all_options
from torchrl_ocwm.evidence.settings import Evidence
from torchrl_ocwm.evidence.setups import BUDGETS, SETUPS, Budget, Setup
from torchrl_ocwm.evidence.trainings import Evaluated, Trained
from torchrl_ocwm.settings import SettingsError

#: An acting agent: updates per step of others and of its own, and rounds.
_LEARNING, _ROUNDS = (0.2, 0.4), 4


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a row of a figure is, in one environment and with one seed."""

    row: Row
    env: str
    evaluated: Evaluated


def results(wanted: Evidence) -> list[Result]:
    """All that a figure needs, seed by seed, so that a whole one is there early.

    Raises:
        SettingsError: for a size or an environment whose steps and updates are not known, or an agent or row that
            the figure does not have.
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
    names = dict.fromkeys(row.agent for row in rows) | dict.fromkeys(row.name for row in rows)
    if odd := [name for name in wanted.agents if name not in names]:
        known = "; ".join(names)
        raise SettingsError(f"agents must be agents or rows of figure={wanted.figure}: {known}. Got {odd[0]!r}")
    return [row for row in rows if not wanted.agents or {row.agent, row.name} & set(wanted.agents)]


def _evaluated(row: Row, env: str, seed: int, wanted: Evidence) -> Evaluated:
    budget, setup = _known(BUDGETS, "size", wanted.size), _known(SETUPS, "env", env)
    data = _data(row, env, wanted.steps or budget.steps, setup, budget, wanted.size)
    updates = wanted.updates or min(round(budget.updates * setup.updates), BUDGETS["paper"].updates)
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


def _data(row: Row, env: str, steps: int, setup: Setup, budget: Budget, size: str) -> Data:
    if setup.acting and "virtual_target" in row.options:
        # Who acts would act otherwise if it saw the target, and rows would differ by their episodes too.
        others = {name: value for name, value in row.options.items() if name != "virtual_target"}
        plain = _data(replace(row, options=others), env, steps, setup, budget, size)
        return Drawn(env=env, options={**plain.options, **row.options}, plain=plain)
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
