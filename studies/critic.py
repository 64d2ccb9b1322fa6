"""Why SAC learns slowly: ``python -m studies.critic`` trains the recipe ``sac``, changed by FIELD=VALUE.

SAC follows its critic's slope by the action. After training this slope is compared with the true one: from each of many
crystals the first action is changed by a little, up and down, and the agent goes on; both runs meet the same
disturbances, so half the difference of their discounted rewards is the slope. A critic can only know the mean over
what noise is still to come: the true slope is the mean over several such futures, and the ceiling says how well that
mean is known.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode

from cz_gym import CzVectorEnv
from cz_gym.agents.training.recipes import SAC
from cz_gym.agents.training.validation import JUDGING, validate
from cz_gym.env import EnvState
from cz_gym.errors import CzError
from cz_gym.evaluation.report.tables import markdown
from cz_gym.support.atomic_files import write_files
from cz_gym.support.command_line import OneLineParser

Floats = npt.NDArray[np.float64]
CRYSTALS, FIRST_SEED = 512, 777_000
"""Crystals whose slopes are taken, and the first of their training seeds."""
BEFORE, AFTER = 150, 240
"""Actions before the changed one, and those whose rewards count."""
CHANGE = 0.02
"""Change of the action [-]."""
FUTURES = 8
"""Continuations of each crystal with other noise, over which the true slope is a mean; even."""
RESAMPLES = 1000
"""Resamples of the crystals for the intervals."""
TAIL = 0.98
"""Share of the crystals that count: a crystal that is nearly lost has slopes a thousand times as large [-]."""
SCENARIOS = ("randomized", "hard", "puller")
TITLE = "# What SAC's critics know of an action"
DRIVES = "pull", "heater"
COSINES = tuple(text.format(drive) for drive in DRIVES for text in ("cosine, {}", "ceiling, {}"))
HEADS = ("changed", "updates", *COSINES, *(f"cost, {name}" for name in SCENARIOS), "lost [%]")


def slopes(model: Any, recipe: SAC) -> tuple[Floats, Floats]:
    """True slopes of the discounted rewards by the action, and the critics'.

    The true ones have shape (futures, crystals, 2), the critics' (crystals, 2).
    """
    import torch

    from cz_gym.sb3 import CzVecEnv

    settings = recipe.config, CRYSTALS, AutoresetMode.SAME_STEP
    env = CzVecEnv(CzVectorEnv.from_config(*settings, info="all"), critic_state=True)
    env.seed(FIRST_SEED)
    observation: Any = env.reset()
    for _ in range(BEFORE):
        action = model.predict(observation, deterministic=True)[0]
        for _ in range(recipe.action_repeat):
            observation, *_ = env.step(action)
    action, states = model.predict(observation, deterministic=True)[0], env.env.get_state()
    ahead = CzVectorEnv.from_config(*settings)
    ahead.reset(seed=FIRST_SEED)
    true, grows = np.zeros((FUTURES, *action.shape)), np.ones(CRYSTALS, np.bool_)
    for future in range(FUTURES):
        begin = with_noise_of(states, future)
        for drive in range(action.shape[1]):
            change = CHANGE * np.eye(action.shape[1])[drive]
            ahead.set_state(begin)
            more, one = earned(model, recipe, ahead, action + change)
            ahead.set_state(begin)
            less, other = earned(model, recipe, ahead, action - change)
            true[future, :, drive], grows = (more - less) / (2.0 * CHANGE), grows & one & other
    at = torch.as_tensor(action).requires_grad_(True)
    torch.autograd.backward(torch.cat(model.critic(torch.as_tensor(observation), at), 1).mean(1).sum())
    return true[:, grows], np.asarray(at.grad, np.float64)[grows]


def with_noise_of(states: Sequence[EnvState], shift: int) -> tuple[EnvState, ...]:
    """The states with the random streams of the crystals ``shift`` places on: other fluctuations and readings follow,
    while the disturbances that were drawn for a crystal at its beginning stay.
    """
    changed = []
    for i, state in enumerate(states):
        slot = state.slot.slot.copy()
        slot["streams"] = states[(i + shift) % len(states)].slot.slot["streams"]
        changed.append(replace(state, slot=replace(state.slot, slot=slot)))
    return tuple(changed)


def earned(model: Any, recipe: SAC, env: CzVectorEnv, action: Floats) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Discounted rewards of that action and the model's next ones, and whether crystals grow to the last of them."""
    total, weight, first = np.zeros(CRYSTALS), np.ones(CRYSTALS), np.clip(action, -1.0, 1.0).astype(np.float32)
    for _ in range(AFTER):
        for _ in range(recipe.action_repeat):
            observation, reward, ended, cut, _ = env.step(first)
            total += weight * reward
            weight[ended | cut] = 0.0
        weight *= recipe.gamma
        first = model.predict(observation, deterministic=True)[0]
    return total, weight > 0.0


def cosines(true: Floats, learned: Floats) -> Floats:
    """Cosine between two slopes over all crystals, of each drive [-]; NaN without any."""
    if not len(true):
        return np.full(true.shape[1], np.nan)
    usual = (np.abs(true) <= np.quantile(np.abs(true), TAIL, axis=0)).all(axis=1)
    true, learned = true[usual], learned[usual]
    cosine: Floats = (true * learned).sum(0) / np.sqrt((true**2).sum(0) * (learned**2).sum(0))
    return cosine


def ceilings(true: Floats) -> Floats:
    """Largest cosine that a critic can have with the mean of these futures, of each drive [-]: that of the mean over
    all futures, as one half of them and the other say (Spearman and Brown's formula).
    """
    halves = cosines(true[::2].mean(0), true[1::2].mean(0)).clip(0.0, None)
    return np.asarray(np.sqrt(2.0 * halves / (1.0 + halves)))


def cells(true: Floats, learned: Floats) -> list[str]:
    """Cosine with its 95 % interval over crystals, and ceiling, of each drive."""
    mean, random, n = true.mean(0), np.random.default_rng(0), len(learned)
    draws = [random.integers(0, n, n) for _ in range(RESAMPLES)] if n else []
    spread = np.array([cosines(mean[draw], learned[draw]) for draw in draws] or [cosines(mean, learned)])
    ends, texts = np.percentile(spread, (2.5, 97.5), axis=0), list[str]()
    for cosine, low, high, ceiling in zip(cosines(mean, learned), *ends, ceilings(true), strict=True):
        texts += [f"{cosine:.2f} [{low:.2f}, {high:.2f}]", f"{ceiling:.2f}"]
    return texts


def row(changes: Sequence[str], seed: int) -> tuple[str, ...]:
    """Train the changed recipe, and a row of the table."""
    from cz_gym.agents.asymmetric import LearnState
    from cz_gym.agents.training.algorithms import make_algorithm

    recipe = changed(changes)
    model = make_algorithm(recipe, seed)
    model.learn(recipe.steps // recipe.action_repeat, LearnState())
    judged = [validate(model, recipe.config.with_scenario(name), JUDGING) for name in SCENARIOS]
    return (
        " ".join(changes) or "nothing",
        str(model._n_updates),
        *cells(*slopes(model, recipe)),
        *(f"{each.cost:.4f}" for each in judged),
        " / ".join(f"{100.0 * each.failure_rate:.1f}" for each in judged),
    )


def changed(changes: Sequence[str]) -> SAC:
    """The recipe with fields of other values, as ``train.py --steps`` changes it for other steps; CzError for a field
    that it does not have."""
    recipe, numbers = SAC(), {each.name for each in fields(SAC) if isinstance(each.default, int | float)}
    given = dict[str, Any]()
    for change in changes:
        name, _, value = change.partition("=")
        if name not in numbers:
            raise CzError(f"{change!r} is no FIELD=NUMBER; fields: {', '.join(sorted(numbers))}")
        try:
            given[name] = type(getattr(recipe, name))(float(value))
        except (ValueError, OverflowError):
            raise CzError(f"{name}={value!r}: not a number that it can be") from None
    return replace(recipe.with_steps(given.pop("steps", recipe.steps)), **given)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m studies.critic", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("changes", nargs="*", metavar="FIELD=VALUE", help="fields of the recipe with another value")
    parser.add_argument("--seed", type=int, default=0, help="training seed (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("runs/critic.md"), help="table that the row is added to")
    return parser.run(_main, arguments, "agents")


def _main(given: argparse.Namespace) -> None:
    lines = given.out.read_text().splitlines() if given.out.exists() else []
    before = [line for line in lines if line.startswith("|")][2:]
    head = markdown(HEADS, [row(given.changes, given.seed)]).splitlines()
    text = "\n".join([TITLE, "", *head[:2], *before, *head[2:]])
    print(text)
    write_files({given.out: f"{text}\n".encode()})


if __name__ == "__main__":
    sys.exit(main())
