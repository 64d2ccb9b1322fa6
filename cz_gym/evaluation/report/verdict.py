"""Whether the agents win, in one plain line: the first of the report."""

from __future__ import annotations

from collections.abc import Sequence

from cz_gym.evaluation.results import Benchmark, ScenarioResult, Verdict

FEWEST = 20
"""Crystals that a verdict on a scenario with randomness needs."""


def headline(benchmark: Benchmark) -> str:
    """One line: whether the agents win, and where they do not.

    Scenarios of a single crystal do not count, unless there are no others; nor does an agent that is a bound. A few
    crystals of a random scenario give no verdict.
    """
    agents = [controller.name for controller in benchmark.controllers if controller.learned and not controller.bound]
    if not agents:
        return "No learned agent took part in this run."
    if not benchmark.scenarios[0].verdicts:
        return "No classical controller took part in this run to compare the agents with."
    deciding = [scenario for scenario in benchmark.scenarios if len(scenario.seeds) > 1] or list(benchmark.scenarios)
    if 1 < len(deciding[0].seeds) < FEWEST:
        return f"No verdict: {len(deciding[0].seeds)} crystals, and a verdict needs at least {FEWEST}."
    winners = [[verdict.agent for verdict in scenario.verdicts if verdict.wins] for scenario in deciding]
    if always := [agent for agent in agents if all(agent in some for some in winners)]:
        first = f"{', '.join(always)} win{'s' if len(always) == 1 else ''} on every scenario."
    else:
        first = "No agent wins on every scenario." if any(winners) else "No agent wins."
    return f"{first} {'; '.join(_among(scenario, len(agents)) for scenario in deciding)}."


def _among(scenario: ScenarioResult, agents: int) -> str:
    """Who is better than whom on one scenario, the best classical controller or each agent."""
    rival, verdicts = scenario.verdicts[0].rival, scenario.verdicts

    def named(some: Sequence[Verdict]) -> str:
        return f"all {agents} agents" if len(some) == agents > 1 else ", ".join(each.agent for each in some)

    won, lost = [each for each in verdicts if each.wins], [each for each in verdicts if each.loses]
    rest = [each for each in verdicts if not (each.wins or each.loses)]
    said = [f"{named(won)} better than {rival}"] if won else []
    said += [f"{rival} better than {named(lost)}"] if lost else []
    said += [f"no clear difference between {rival} and {named(rest)}"] if rest else []
    return f"{scenario.row.name}: {', '.join(said)}"
