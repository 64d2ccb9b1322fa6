"""The report's first line: whether the agents win, and where they do not."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cz_gym.evaluation.protocol import Row
from cz_gym.evaluation.report import tables
from cz_gym.evaluation.report.tables import FEWEST, headline
from cz_gym.evaluation.results import Result, Sample
from cz_gym.evaluation.statistics import Estimate
from tests.samples import contender

BETTER, WORSE, EITHER = Estimate(-1.0, (-2.0, -0.5), 9), Estimate(1.0, (0.5, 2.0), 9), Estimate(0.1, (-1.0, 1.0), 9)


def made(**scenarios: Any) -> list[Result]:
    """Results of agents a, b, ...; each scenario gives their differences, "single" stands for one crystal."""
    results = []
    for name, differences in scenarios.items():
        verdicts = dict(zip("abc", differences, strict=False))
        seeds = (0,) if name.startswith("single") else tuple(range(FEWEST))
        who = [contender("lqg"), *(contender(agent, training_seeds=(0,)) for agent in verdicts)]
        samples = tuple(Sample(each, seeds, np.zeros((1, 1, 1)), 0.0) for each in who)
        row = Row(name, "randomized", "")
        results.append(Result(row, samples, {}, {}, {}, {}, {}, "lqg", verdicts))
    return results


def test_agents_and_scenarios_are_compared_in_one_line() -> None:
    assert headline(made(one=[BETTER])) == "a wins on every scenario. one: a better than lqg."
    assert headline(made(one=[WORSE], two=[EITHER])) == (
        "No agent wins. one: lqg better than a; two: no clear difference between lqg and a."
    )
    assert headline(made(one=[WORSE] * 3, two=[WORSE] * 3)) == (
        "No agent wins. one: lqg better than all 3 agents; two: lqg better than all 3 agents."
    )
    assert headline(made(one=[BETTER, WORSE, EITHER], two=[BETTER, WORSE, BETTER])) == (
        "a wins on every scenario. one: a better than lqg, lqg better than b, no clear difference between lqg and c; "
        "two: a, c better than lqg, lqg better than b."
    )
    assert headline(made(one=[WORSE, WORSE], two=[BETTER, WORSE])).startswith("No agent wins on every scenario.")


def test_a_single_crystal_does_not_count_beside_others() -> None:
    assert "single" not in headline(made(one=[WORSE, WORSE], single=[BETTER, BETTER]))
    assert headline(made(single=[Estimate(-1.0, None, 1)])).startswith("a wins")


def test_a_few_crystals_give_no_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    few = made(one=[BETTER])
    monkeypatch.setattr(tables, "FEWEST", FEWEST + 1)
    assert headline(few) == "No verdict: 20 crystals, and a verdict needs at least 21."


def test_the_headline_says_that_no_agent_or_rival_took_part() -> None:
    (nobody,) = made(one=[])
    assert headline([nobody]) == "No learned agent took part in this run."
    seer = replace(nobody.samples[0], contender=contender("a", training_seeds=(0,), privileged=True))
    assert headline([replace(nobody, samples=(seer,))]) == "No learned agent took part in this run."
    agent = replace(seer, contender=contender("b", training_seeds=(0,)))
    alone = replace(nobody, samples=(agent,), rival=None)
    assert headline([alone]).startswith("No classical controller took part")
