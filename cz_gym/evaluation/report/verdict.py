"""Whether the agents win, in one plain line: the first of the report."""

from __future__ import annotations

from collections.abc import Sequence

from cz_gym.evaluation.results import Benchmark, ScenarioResult, Verdict


def headline(benchmark: Benchmark) -> str:
    """One plain line: whether the agents win, and where they don't.

    Scenarios of a single crystal decide nothing, unless there are no others. An agent that reads the true state is a
    bound and takes part in no contest.
    """
    agents = [controller.name for controller in benchmark.controllers if controller.learned and not controller.bound]
    if not agents:
        return "No learned agent took part in this run."
    if not benchmark.scenarios[0].verdicts:
        return "No classical controller took part in this run, so there is nobody to win against."
    deciding = [scenario for scenario in benchmark.scenarios if len(scenario.seeds) > 1] or list(benchmark.scenarios)
    return _agent_line(deciding, agents[0]) if len(agents) == 1 else _agents_line(deciding, len(agents))


def _agent_line(scenarios: Sequence[ScenarioResult], agent: str) -> str:
    verdicts = [(scenario.row.name, verdict) for scenario in scenarios for verdict in scenario.verdicts]
    won = [name for name, verdict in verdicts if verdict.wins]
    rest = [f"{name} ({_not_won(verdict)})" for name, verdict in verdicts if not verdict.wins]
    if not rest:
        return f"The agent {agent} wins: lowest mean RMSE on {_all_of(len(won), 'scenario')} of this run."
    if not won:
        return f"The agent {agent} does not win: {', '.join(rest)}."
    return f"The agent {agent} does not win everywhere: not on {', '.join(rest)}; it wins on {', '.join(won)}."


def _agents_line(scenarios: Sequence[ScenarioResult], agents: int) -> str:
    always = [each.agent for each in scenarios[0].verdicts]
    ever: list[str] = []
    for scenario in scenarios:
        winners = [verdict.agent for verdict in scenario.verdicts if verdict.wins]
        always, ever = [agent for agent in always if agent in winners], ever + winners
    if always:
        first = f"{', '.join(always)} win{'s' if len(always) == 1 else ''} on every scenario."
    else:
        first = "No agent wins on every scenario." if ever else "No agent wins."
    return f"{first} {'; '.join(_among(scenario, agents) for scenario in scenarios)}."


def _among(scenario: ScenarioResult, agents: int) -> str:
    """Who is better than whom on one scenario, the best classical controller or each agent."""
    rival, verdicts = scenario.verdicts[0].rival, scenario.verdicts

    def named(some: Sequence[Verdict]) -> str:
        return f"all {agents} agents" if len(some) == agents else ", ".join(each.agent for each in some)

    won, lost = [each for each in verdicts if each.wins], [each for each in verdicts if each.loses]
    rest = [each for each in verdicts if not (each.wins or each.loses)]
    said = [f"{named(won)} better than {rival}"] if won else []
    said += [f"{rival} better than {named(lost)}"] if lost else []
    said += [f"no clear difference between {rival} and {named(rest)}"] if rest else []
    return f"{scenario.row.name}: {', '.join(said)}"


def _not_won(verdict: Verdict) -> str:
    return f"{verdict.rival} is better" if verdict.loses else f"no clear difference from {verdict.rival}"


def _all_of(count: int, what: str) -> str:
    return f"the only {what}" if count == 1 else f"all {count} {what}s"
