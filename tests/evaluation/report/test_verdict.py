"""The verdict: one sentence on who holds the radius best where, and a table, a row a scenario."""

from dataclasses import replace
from types import SimpleNamespace

import pandas as pd

from cz_gym.crystal.process import CRYSTAL
from cz_gym.evaluation.protocol import Case
from cz_gym.evaluation.statistics import Estimate
from cz_gym.tools.episodes import ESTIMATES
from cz_gym.tools.report import tables, task_records
from cz_gym.tools.report.tables import FEWEST, best_of_each_kind
from cz_gym.tools.report.task_records import body_verdict as verdict
from cz_gym.tools.report.task_records import crystal_verdict
from tests import samples
from tests.samples import contender, joined

BETTER, WORSE, EITHER = Estimate(-1.0, (-2.0, -0.5), 9), Estimate(1.0, (0.5, 2.0), 9), Estimate(0.1, (-1.0, 1.0), 9)


def line(case, name, kind, estimate, against="", metric="rmse_mm"):
    low, high = estimate.ci95 or (float("nan"),) * 2
    return case, name, metric, kind, against, estimate.mean, low, high, estimate.n


def made(**scenarios):
    """Results of agents a, b, ...; each scenario gives their differences, "single" a scenario of one crystal.

    The rival has an RMSE of 5 mm; b knew the plant in training.
    """
    parts, lines = [], []
    who = [contender("lqg"), *(contender(agent, training_seeds=(0,)) for agent in "abc")]
    who[2].trained[0].contract.learned_from = "plant"
    most = max(map(len, scenarios.values()))
    for name, differences in scenarios.items():
        crystals = 1 if name.startswith("single") else FEWEST
        case = Case(name, "nominal" if crystals == 1 else "randomized", "")
        parts.append(samples.made(case, *((each, {"rmse_mm": [0.0] * crystals}) for each in who[: most + 1])))
        lines.append(line(name, "lqg", "mean", Estimate(5.0, (4.0, 6.0), 9)))
        for agent, each in zip("abc", differences, strict=False):
            lines.append(line(name, agent, "mean", Estimate(5.0 + each.mean, None, 9)))
            lines.append(line(name, agent, "verdict", each, "lqg"))
        for agent in "abc"[len(differences) : most]:  # the last difference is that of the others
            lines.append(line(name, agent, "mean", Estimate(5.0 + differences[-1].mean, None, 9)))
            lines.append(line(name, agent, "verdict", differences[-1], "lqg"))
    return replace(joined(parts), estimates=pd.DataFrame(lines, columns=[*ESTIMATES]))


def test_the_sentence_says_which_kind_holds_the_radius_best_and_where():
    def said(**scenarios):
        return verdict(made(**scenarios)).sentence

    assert said(one=[BETTER]) == "The radius is held best by a learned agent on one."
    classical = "The radius is held best by a classical controller on all 2 scenarios."
    assert said(one=[WORSE] * 3, two=[WORSE] * 3) == classical
    assert said(one=[WORSE], two=[WORSE, BETTER], three=[WORSE], four=[EITHER]) == (
        "The radius is held best by a classical controller on one and three, by a learned agent on two; "
        "on four no difference is shown."
    )
    neither = "No difference is shown between classical controllers and learned agents on all 2 scenarios."
    assert said(one=[EITHER, WORSE], two=[WORSE, EITHER]) == neither


def test_the_table_has_a_row_a_scenario_with_the_best_of_each_kind():
    results = made(one=[WORSE, BETTER, WORSE], two=[EITHER, WORSE, BETTER], three=[WORSE, EITHER, WORSE])
    heads, rows = verdict(results)[1:]
    assert heads[2::2] == (
        "best learned from the reward [mm]",
        "best learned, plant known in training [mm]",
        "lowest error",
    )
    better, either, worse = "-1.000 [-2.000, -0.500]", "0.100 [-1.000, 1.000]", "1.000 [0.500, 2.000]"
    rival = "lqg 5.000 [4.000, 6.000]"
    assert rows == (
        ("one", rival, "a 6.000", worse, "b 4.000", better, "b"),
        ("two", rival, "c 4.000", better, "b 6.000", worse, "c"),
        ("three", rival, "a 6.000", worse, "b 5.100", either, "no difference shown"),
    )
    assert [each.name for each in best_of_each_kind(results)] == ["lqg", "b", "c"]


def test_a_single_crystal_does_not_count_beside_others():
    assert [row[0] for row in verdict(made(one=[WORSE], single=[BETTER])).rows] == ["one"]
    assert verdict(made(single=[Estimate(-1.0, None, 1)])).rows[0][-1] == "a"


def test_there_is_no_verdict_on_a_few_crystals_or_of_one_kind_alone(monkeypatch):
    nobody, case = made(one=[]), Case("one", "randomized", "")
    alone = "No learned agent took part in this run."
    assert verdict(nobody) == (alone, (), ())
    seer = contender("a", training_seeds=(0,), privileged=True)
    assert verdict(samples.made(case, (seer, {"rmse_mm": [0.0] * FEWEST}))) == (alone, (), ())
    agent = contender("b", training_seeds=(0,))
    only = samples.made(case, (agent, {"rmse_mm": [0.0] * FEWEST}))
    assert verdict(only).sentence.startswith("No classical controller took part")
    monkeypatch.setattr(tables, "FEWEST", FEWEST + 1)
    assert verdict(made(one=[BETTER])) == ("No verdict: 20 crystals, and a verdict needs at least 21.", (), ())
    one = samples.made(case, (contender("lqg"), {"rmse_mm": [0.0]}), (agent, {"rmse_mm": [0.0]}))
    assert verdict(one).sentence.startswith("No verdict: 1 crystal, ")


def test_controllers_that_lose_equally_few_crystals_are_named_together(monkeypatch):
    case = Case("crown", "randomized", "", process=CRYSTAL, stage="crown")
    losses = zip("abcd", (0.1, 0.0, 0.0, 0.0), (1.0, 3.0, 2.0, 4.0), strict=True)
    figures = [
        (contender(name), {"failure_rate": [lost] * FEWEST, "rmse_mm": [rmse] * FEWEST}) for name, lost, rmse in losses
    ]
    monkeypatch.setattr(task_records, "_plain", lambda column, benchmark, case, name: f"{name}'s")
    assert crystal_verdict(samples.made(case, *figures)).sentence.startswith(
        "b, c and d lose the fewest crystals; of them c, which loses c's % of crown, has the least error in the crown; "
    )
    few = [(who, {name: each[:1] for name, each in values.items()}) for who, values in figures]
    assert crystal_verdict(samples.made(case, *few)).sentence.startswith("No verdict: 1 crystal, ")


def test_an_agent_stands_with_those_that_were_told_as_much_as_the_most_told_of_its_training_seeds():
    made_from = ["reward", "state", "plant"]
    told = [SimpleNamespace(contract=SimpleNamespace(learned_from=source)) for source in made_from]
    agent = contender("a", training_seeds=(0,))
    groups = [replace(agent, trained=tuple(told[:n])).knows for n in (1, 2, 3)]
    assert groups == [
        "learned from the reward",
        "learned from the reward, state told in training",
        "learned, plant known in training",
    ]
