"""The verdict, whether the agents win, in one plain line: the first of the report."""

from __future__ import annotations

from collections.abc import Sequence

from cz_gym.evaluation.results import Result

FEWEST = 20
"""Crystals that a verdict on a scenario with randomness needs."""


def headline(results: Sequence[Result]) -> str:
    """Return one line: whether the agents win, and where they do not.

    Scenarios of a single crystal do not count, unless there are no others; nor does an agent that is a bound. A few
    crystals of a random scenario give no verdict.
    """
    contenders = [sample.contender for sample in results[0].samples]
    agents = [each.name for each in contenders if each.learned and not each.bound]
    if not agents:
        return "No learned agent took part in this run."
    if results[0].rival is None:
        return "No classical controller took part in this run to compare the agents with."
    deciding = [result for result in results if len(result.seeds) > 1] or list(results)
    if 1 < len(deciding[0].seeds) < FEWEST:
        return f"No verdict: {len(deciding[0].seeds)} crystals, and a verdict needs at least {FEWEST}."
    if always := [agent for agent in agents if all(result.wins(agent) for result in deciding)]:
        first = f"{', '.join(always)} win{'s' if len(always) == 1 else ''} on every scenario."
    else:
        some = any(result.wins(agent) for result in deciding for agent in agents)
        first = "No agent wins on every scenario." if some else "No agent wins."
    return f"{first} {'; '.join(_among(result) for result in deciding)}."


def _among(result: Result) -> str:
    """Who is better than whom on one scenario, the best classical controller or each agent."""
    agents, rival = list(result.verdicts), result.rival

    def named(some: Sequence[str]) -> str:
        return f"all {len(agents)} agents" if len(some) == len(agents) > 1 else ", ".join(some)

    won, lost = list(filter(result.wins, agents)), list(filter(result.loses, agents))
    rest = [agent for agent in agents if agent not in won + lost]
    parts = [f"{named(won)} better than {rival}"] if won else []
    parts += [f"{rival} better than {named(lost)}"] if lost else []
    parts += [f"no clear difference between {rival} and {named(rest)}"] if rest else []
    return f"{result.row.name}: {', '.join(parts)}"
