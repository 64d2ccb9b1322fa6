"""The verdict: one sentence on who holds the radius best where, and a table, a row a scenario."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from cz_gym.crystal.process import CRYSTAL
from cz_gym.evaluation.protocol import Case
from cz_gym.evaluation.results import Result, Sample
from cz_gym.evaluation.statistics import Estimate
from cz_gym.tools.report import crystals, tables
from cz_gym.tools.report.tables import FEWEST, best_of_each_kind, verdict
from tests.samples import contender

BETTER, WORSE, EITHER = Estimate(-1.0, (-2.0, -0.5), 9), Estimate(1.0, (0.5, 2.0), 9), Estimate(0.1, (-1.0, 1.0), 9)


def made(**scenarios):
    """Results of agents a, b, ...; each scenario gives their differences, "single" a scenario of one crystal.

    The rival has an RMSE of 5 mm; b knew the plant in training.
    """
    results = []
    for name, differences in scenarios.items():
        verdicts = dict(zip("abc", differences, strict=False))
        seeds = (0,) if name.startswith("single") else tuple(range(FEWEST))
        who = [contender("lqg"), *(contender(agent, training_seeds=(0,)) for agent in verdicts)]
        for each in who[2:3]:
            each.trained[0].contract.learned_from = "plant"
        samples = tuple(Sample(each, seeds, np.zeros((1, 1, 1)), 0.0) for each in who)
        means = {"lqg": {"rmse_mm": Estimate(5.0, (4.0, 6.0), 9)}}
        means |= {agent: {"rmse_mm": Estimate(5.0 + each.mean, None, 9)} for agent, each in verdicts.items()}
        case = Case(name, "nominal" if len(seeds) == 1 else "randomized", "")
        results.append(Result(case, samples, means, {}, {}, {}, {}, "lqg", verdicts))
    return results


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
    assert [sample.name for sample in best_of_each_kind(results)] == ["lqg", "b", "c"]


def test_a_single_crystal_does_not_count_beside_others():
    assert [row[0] for row in verdict(made(one=[WORSE], single=[BETTER])).rows] == ["one"]
    assert verdict(made(single=[Estimate(-1.0, None, 1)])).rows[0][-1] == "a"


def test_there_is_no_verdict_on_a_few_crystals_or_of_one_kind_alone(monkeypatch):
    (nobody,) = made(one=[])
    alone = "No learned agent took part in this run."
    assert verdict([nobody]) == (alone, (), ())
    seer = replace(nobody.samples[0], contender=contender("a", training_seeds=(0,), privileged=True))
    assert verdict([replace(nobody, samples=(seer,))]) == (alone, (), ())
    agent = replace(seer, contender=contender("b", training_seeds=(0,)))
    only = replace(nobody, samples=(agent,), rival=None)
    assert verdict([only]).sentence.startswith("No classical controller took part")
    monkeypatch.setattr(tables, "FEWEST", FEWEST + 1)
    assert verdict(made(one=[BETTER])) == ("No verdict: 20 crystals, and a verdict needs at least 21.", (), ())
    one = replace(made(single=[BETTER])[0], case=Case("one", "randomized", ""))
    assert verdict([one]).sentence.startswith("No verdict: 1 crystal, ")


def test_controllers_that_lose_equally_few_crystals_are_named_together(monkeypatch):
    case, names = Case("crown", "randomized", "", process=CRYSTAL, stage="crown"), ("a", "b", "c", "d")
    samples = tuple(Sample(contender(name), tuple(range(FEWEST)), np.zeros((1, 1, 1)), 0.0) for name in names)
    losses = zip(names, (0.1, 0.0, 0.0, 0.0), (1.0, 3.0, 2.0, 4.0), strict=True)
    means = {
        name: {"failure_rate": Estimate(lost, None, 9), "rmse_mm": Estimate(rmse, None, 9)}
        for name, lost, rmse in losses
    }
    result = Result(case, samples, means, {}, {}, {}, {}, None, {})
    monkeypatch.setattr(crystals, "_plain", lambda column, result, name: f"{name}'s")
    assert crystals.verdict([result]).sentence.startswith(
        "b, c and d lose the fewest crystals; of them c, which loses c's % of crown, has the least error in the crown; "
    )
    few = replace(result, samples=tuple(replace(each, seeds=each.seeds[:1]) for each in samples))
    assert crystals.verdict([few]).sentence.startswith("No verdict: 1 crystal, ")


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
