"""Verdict and figures: who ranks first where, who is shown when there are many; colours for every reader."""

import io
import re
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from cz_gym.agents import shipped_names
from cz_gym.baselines import OpenLoop
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.evaluation import plots
from cz_gym.evaluation.metrics import Metrics, names_of
from cz_gym.evaluation.plots import COLOURS, COLUMNS, DPI, STYLES, lighter
from cz_gym.evaluation.protocol import Case, find_case
from cz_gym.evaluation.rollout import rollout
from cz_gym.evaluation.statistics import Estimate
from cz_gym.rendering import canvas
from cz_gym.tools.episodes import ESTIMATES
from cz_gym.tools.registry import CONTROLLERS, CRYSTAL_CONTROLLERS
from cz_gym.tools.report import tables, task_records, vector
from cz_gym.tools.report.figures import draw_figures
from cz_gym.tools.report.markdown import brief, finding, terminal
from cz_gym.tools.report.tables import FEWEST, NAMED, PIDS, best_of_each_kind, chosen, looks_of
from cz_gym.tools.report.task_records import body_verdict as verdict
from cz_gym.tools.report.task_records import crystal_verdict
from cz_gym.tools.run import typical_tasks
from tests.observed import PLAIN
from tests.samples import contender, joined, made, rolled_out

SVG = "{http://www.w3.org/2000/svg}"
BETTER, WORSE, EITHER = Estimate(-1.0, (-2.0, -0.5), 9), Estimate(1.0, (0.5, 2.0), 9), Estimate(0.1, (-1.0, 1.0), 9)


def line(case, name, kind, estimate, against="", metric="cost"):
    low, high = estimate.ci95 or (float("nan"),) * 2
    return case, name, metric, kind, against, estimate.mean, low, high, estimate.n


def differing(**scenarios):
    """Results of agents a, b, ...; each scenario gives their differences, "single" a scenario of one crystal.

    The rival has a cost of 5; b knew the plant in training.
    """
    parts, lines = [], []
    who = [contender("lqg"), *(contender(agent, training_seeds=(0,)) for agent in "abc")]
    who[2].trained[0].contract.learned_from = "plant"
    most = max(map(len, scenarios.values()))
    for name, differences in scenarios.items():
        crystals = 1 if name.startswith("single") else FEWEST
        case = Case(name, "nominal" if crystals == 1 else "randomized", "")
        parts.append(made(case, *((each, {"rmse_mm": [0.0] * crystals}) for each in who[: most + 1])))
        none = Estimate(0.0, (0.0, 0.0), 9)
        lines += [line(name, each.name, "mean", none, metric="failure_rate") for each in who[: most + 1]]
        lines.append(line(name, "lqg", "mean", Estimate(5.0, (4.0, 6.0), 9)))
        for agent, each in zip("abc", differences, strict=False):
            lines.append(line(name, agent, "mean", Estimate(5.0 + each.mean, None, 9)))
            lines.append(line(name, agent, "verdict", each, "lqg"))
        for agent in "abc"[len(differences) : most]:  # the last difference is that of the others
            lines.append(line(name, agent, "mean", Estimate(5.0 + differences[-1].mean, None, 9)))
            lines.append(line(name, agent, "verdict", differences[-1], "lqg"))
    return replace(joined(parts), estimates=pd.DataFrame(lines, columns=[*ESTIMATES]))


def test_the_sentence_says_which_kind_ranks_first_and_where():
    def said(**scenarios):
        return verdict(differing(**scenarios)).sentence

    first = "By crystals lost, then by cost, the first is"
    assert said(one=[BETTER]) == f"{first} a learned agent on one."
    classical = f"{first} a classical controller on all 2 scenarios."
    assert said(one=[WORSE] * 3, two=[WORSE] * 3) == classical
    assert said(one=[WORSE], two=[WORSE, BETTER], three=[WORSE], four=[EITHER]) == (
        f"{first} a classical controller on one and three, a learned agent on two; on four no difference is shown."
    )
    neither = "No difference is shown between classical controllers and learned agents on all 2 scenarios."
    assert said(one=[EITHER, WORSE], two=[WORSE, EITHER]) == neither


def test_the_table_has_a_row_a_scenario_with_the_best_of_each_kind():
    results = differing(one=[WORSE, BETTER, WORSE], two=[EITHER, WORSE, BETTER], three=[WORSE, EITHER, WORSE])
    heads, rows = verdict(results)[1:]
    assert heads[2::2] == (
        "best learned from the reward",
        "best learned, plant known in training",
        "ranks first",
    )
    better, either, worse = "-1.0000 [-2.0000, -0.5000]", "0.1000 [-1.0000, 1.0000]", "1.0000 [0.5000, 2.0000]"
    rival = "lqg 5.0000 [4.0000, 6.0000]"
    assert rows == (
        ("one", rival, "a 6.0000", worse, "b 4.0000", better, "b"),
        ("two", rival, "c 4.0000", better, "b 6.0000", worse, "c"),
        ("three", rival, "a 6.0000", worse, "b 5.1000", either, "no difference shown"),
    )
    assert [each.name for each in best_of_each_kind(results)] == ["lqg", "b", "c"]


def test_crystals_lost_rank_before_cost_and_a_few_of_them_decide_nothing():
    """The lower end of the interval counts: one lost crystal of a hundred might have been none."""

    def said(**lost):
        rows = [(contender("lqg"), {"cost": [2.0] * 100, "failure_rate": share(lost.get("lqg", 0))})]
        agent = contender("a", training_seeds=(0,))
        rows += [(agent, {"cost": [1.0] * 100, "failure_rate": share(lost.get("a", 0))})]
        found = made(Case("one", "randomized", ""), *rows)
        return verdict(found).rows[0][-1], found.outranks(found.cases[0], "a")

    def share(lost):
        return [1.0] * lost + [0.0] * (100 - lost)

    assert said() == said(a=1) == said(a=10, lqg=20) == ("a", True)
    assert said(a=10) == ("lqg", False)


def test_a_single_crystal_does_not_count_beside_others():
    assert [row[0] for row in verdict(differing(one=[WORSE], single=[BETTER])).rows] == ["one"]
    assert verdict(differing(single=[Estimate(-1.0, None, 1)])).rows[0][-1] == "a"


def test_there_is_no_verdict_on_a_few_crystals_or_of_one_kind_alone(monkeypatch):
    nobody, case = differing(one=[]), Case("one", "randomized", "")
    alone = "No learned agent took part in this run."
    assert verdict(nobody) == (alone, (), ())
    seer = contender("a", training_seeds=(0,), privileged=True)
    assert verdict(made(case, (seer, {"rmse_mm": [0.0] * FEWEST}))) == (alone, (), ())
    agent = contender("b", training_seeds=(0,))
    only = made(case, (agent, {"rmse_mm": [0.0] * FEWEST}))
    assert verdict(only).sentence.startswith("No classical controller took part")
    monkeypatch.setattr(tables, "FEWEST", FEWEST + 1)
    assert verdict(differing(one=[BETTER])) == ("No verdict: 20 crystals, and a verdict needs at least 21.", (), ())
    one = made(case, (contender("lqg"), {"rmse_mm": [0.0]}), (agent, {"rmse_mm": [0.0]}))
    assert verdict(one).sentence.startswith("No verdict: 1 crystal, ")


def test_controllers_that_lose_equally_few_crystals_are_named_together(monkeypatch):
    case = Case("crown", "randomized", "", process=CRYSTAL, stage="crown")
    losses = zip("abcd", (0.1, 0.0, 0.0, 0.0), (1.0, 3.0, 2.0, 4.0), strict=True)
    figures = [
        (contender(name), {"failure_rate": [lost] * FEWEST, "cost": [cost] * FEWEST}) for name, lost, cost in losses
    ]
    monkeypatch.setattr(task_records, "_plain", lambda column, benchmark, case, name: f"{name}'s")
    assert crystal_verdict(made(case, *figures)).sentence.startswith(
        "b, c and d lose the fewest crystals, as far as the intervals tell; of them c, which loses c's % of crown, has "
        "the lowest cost; "
    )
    few = [(who, {name: each[:1] for name, each in values.items()}) for who, values in figures]
    assert crystal_verdict(made(case, *few)).sentence.startswith("No verdict: 1 crystal, ")


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


AGENTS = {"gradient": 0.05, "ppo": 0.06, "sac": 0.2, "ppo-plain": 0.3}
"""Shipped agents with made-up costs."""
NOMINAL = find_case("nominal")


def sample(name, cost, **facts):
    return contender(name, **facts), {"cost": [cost]}


def names(contenders):
    return [one.name for one in contenders]


def everyone():
    """The default table: classical controllers of the registry, and the shipped agents."""
    classical = [(each, {"cost": [0.1]}) for each in CONTROLLERS if each.default]
    return classical + [sample(*each, training_seeds=(0,)) for each in AGENTS.items()]


def test_many_controllers_are_chosen_by_a_rule():
    many = [sample("bound", 0.1, observation="state"), sample("paper", 9.0)]
    many += [*(sample(f"c{i}", 1.0 + i) for i in range(6)), sample("ppo", 99.0, training_seeds=(0,))]
    shown = names(chosen(made(NOMINAL, *many), NOMINAL, 4))
    assert shown == ["paper", "c0", "c1", "ppo"]
    assert names(chosen(made(NOMINAL, *many[::-1]), NOMINAL, 4)) == shown[::-1]
    assert names(chosen(made(NOMINAL, *many), NOMINAL, 99)) == [who.name for who, _ in many]


def test_figure_and_short_table_show_who_is_quoted_the_best_agents_and_one_s_own():
    usual = ["paper", "paper-tuned", "lqg-at-0.02", "lqg-one-design", "gradient", "ppo"]
    assert names(chosen(made(NOMINAL, *everyone()), NOMINAL, COLUMNS)) == usual
    mine = made(NOMINAL, *everyone(), sample("mine", 50.0, own=True))
    assert {"paper", "mine", "gradient"} < set(names(chosen(mine, NOMINAL, COLUMNS)))
    lines = brief(made(NOMINAL, *everyone())).split("\n\n")[0].splitlines()
    shown = [line.split(" | ")[0].strip("| ") for line in lines[2:]]
    assert [name for name in shown if "*" not in name] == [*usual, "sac", "ppo-plain"]
    assert [name for name in shown if "*" in name] == ["*classical*", "*learned from the reward*"]


def test_no_two_controllers_look_alike():
    """Controllers that share a figure differ in colour, mark and dashes; nobody has another's look."""
    for more in ([], [sample("mine", 50.0, own=True)]):
        benchmark = made(NOMINAL, *everyone(), *more)
        known = looks_of(benchmark)
        assert len({*known.values()}) == len(known) == len(everyone()) + len(more)
        shown = [known[each.name] for each in chosen(benchmark, NOMINAL, NAMED)]
        assert [len({*part}) for part in zip(*shown, strict=True)] == [NAMED] * 3


def test_controllers_of_one_colour_differ_in_mark_and_dashes():
    others = {*(each.name for each in CRYSTAL_CONTROLLERS), *shipped_names(CRYSTAL.name), "ppo-along"}
    for one, other in combinations([name for name in STYLES if name not in others], 2):
        look, its = STYLES[one], STYLES[other]
        assert look.colour != its.colour or (look.mark != its.mark and look.dashes != its.dashes), (one, other)


def test_a_controller_looks_the_same_whoever_takes_part():
    both = looks_of(made(NOMINAL, *everyone()))
    few = looks_of(made(NOMINAL, sample("gradient", 1.0, training_seeds=(0,)), sample("open-loop", 9.0)))
    assert few == {name: both[name] for name in few}


def test_the_finding_tells_those_who_are_told_apart_and_says_how_much_each_moves():
    def steps(cost, moves):
        costs = np.linspace(cost, 1.01 * cost, 20)
        return {"cost": costs, "rmse_mm": [1.0 - cost] * 20, "pull_step_rms_mm_per_min": [moves] * 20}

    cases = [replace(find_case(name)) for name in ("randomized", "hard")]
    who = [
        (contender("told", told=True), steps(0.1, 0.5)), (contender("free"), steps(0.4, 0.2)),
        (contender("bound", privileged=True), steps(0.01, 9.0)),
        (contender("agent", training_seeds=(0,)), steps(0.2, 0.3)),
    ]  # fmt: skip
    assert finding(made(cases, *who)) == (
        "**Not told which scenario it meets, the learned agent `agent` ranks first: its mean cost, of radius error and "
        "drive moves, is 0.2010 on `randomized` and 0.2010 on `hard`**; the best classical controller that is not "
        "told, `free`, has 0.4020 and 0.4020, and the best of those that are told, and tuned for each scenario, have "
        "0.1005 (`told`) and 0.1005 (`told`). The radius error alone (RMSE) is least on `randomized` with `free`, "
        "0.600 mm at pull steps of 0.2000 mm/min; `agent` has 0.800 mm at pull steps of 0.3000 mm/min, and no learned "
        "agent lost a crystal."
    )
    who[3][1]["failure_rate"] = [0.0] * 19 + [1.0]
    said = "learned agents lose at most 5.00 % of the crystals of a scenario (`agent` on `randomized`)."
    assert finding(made(cases, *who)).endswith(said)
    who[3][1].pop("failure_rate")
    assert finding(made(cases, *who[1:])) == ""
    close = finding(made(cases, *who[:3], (who[3][0], steps(0.399, 0.3))))
    assert "on `hard` (intervals overlap)**; the best classical" in close


def test_the_plot_shows_all_whom_the_finding_names():
    """Also where others have their places: quoted controllers and agents."""
    cases = [find_case(name) for name in ("randomized", "hard")]
    costs = np.linspace(1.0, 1.01, FEWEST)
    crowd = [(each, {"cost": 3.0 * costs}) for each, _ in everyone()]
    who = [*crowd, (contender("told", told=True), {"cost": costs}), (contender("free"), {"cost": 2.0 * costs})]
    benchmark = made(cases, *who)
    named = re.findall(r"`([^`]+)`", finding(benchmark))
    assert {"told", "free", "gradient"} <= {*named}
    assert not {"told", "free"} <= {*names(chosen(benchmark, cases[0], NAMED))}
    for draw in (vector.result, vector.pareto):
        words = [each.text for each in ElementTree.fromstring(draw(benchmark)).iter(f"{SVG}text")]
        assert {*named} - {each.name for each in cases} <= {*words}


def test_the_plot_shows_pids_as_such_and_the_share_that_one_loses():
    """They have places beside the others; one far off has its number."""
    names_of = ["paper", *PIDS, *"abcdefgh"]
    who = [(contender(name), {"rmse_mm": [0.1] * 4, "failure_rate": [0.0] * 4}) for name in names_of]
    who[1] = contender(PIDS[0]), {"rmse_mm": [9.0] * 4, "failure_rate": [0.0, 1.0, 1.0, 0.0]}
    benchmark = made(find_case("randomized"), *who)
    words = [each.text for each in ElementTree.fromstring(vector.result(benchmark)).iter(f"{SVG}text")]
    assert {"paper (PID)", *(vector.PLAIN.get(name, name) for name in PIDS), "50 % lost, 9 mm →"} <= {*words}


def test_the_crystal_that_pictures_show_is_usual_for_every_controller():
    """Not the first, where one was lucky, and not the last, which the agent lost."""
    paper, agent = contender("paper"), contender("a", training_seeds=(0, 1))
    errors = [0.1, 2.0, 1.8, 1.0, 4.0], [[0.4, 0.2, 0.55, 0.5, 8.0], [0.5, 9.0, 9.0, 9.0, 9.0]]
    benchmark = made(NOMINAL, (paper, {"rmse_mm": errors[0]}), (agent, {"rmse_mm": errors[1]}))
    assert tables.typical(benchmark, NOMINAL) == 2
    unknown = made(NOMINAL, (paper, {"rmse_mm": [np.nan] * 3}), (agent, {"rmse_mm": [1.0, 2.0, 4.0]}))
    assert tables.typical(unknown, NOMINAL) == 1


def test_every_benchmark_shows_the_typical_crystal_of_each_case(tmp_path):
    """Bodies and whole crystals, slow controllers too, an agent by its first training seed."""
    cases = [find_case("hard"), find_case("crown", task_records.TASKS[CRYSTAL.name].cases)]
    who = contender("paper", slow=True), contender("a", training_seeds=(3, 4))
    benchmark = made(cases, *((each, {"rmse_mm": [0.1, 9.0, 1.0, 1.1]}) for each in who))
    tasks = [
        (each.name, each.training_seeds, case.name, seeds)
        for each, case, seeds, _ in typical_tasks(benchmark, tmp_path)
    ]
    assert tasks == [(each.name, each.training_seeds[:1], case.name, [2]) for case in cases for each in who]


@pytest.mark.parametrize("columns", [80, 200])
def test_tables_and_sentences_fit_the_terminal(columns, monkeypatch):
    """Columns that do not fit follow below, and every controller has a line in each block."""
    monkeypatch.setenv("COLUMNS", str(columns))
    cases, many = [find_case(name) for name in ("randomized", "nominal")], np.linspace(0.1, 0.2, FEWEST)
    figures = [(who, dict.fromkeys(names_of(Metrics), many) | {"failure_rate": many > 0.19}) for who, _ in everyone()]
    text = terminal(made(cases, *figures))
    assert max(map(len, text.splitlines())) <= columns
    blocks = text.count("\n  lqg-at-0.02-adaptive ")
    assert blocks == text.count("\n  gradient ") == (4 if columns == 80 else 2)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_figures_of_a_crystal_that_nothing_disturbs_and_of_a_name_that_seems_a_formula():
    parts = []
    for name in ("nominal", "randomized"):
        row = find_case(name)
        run = rollout(OpenLoop(), make_config(name, horizon=600.0, **PLAIN), row.seeds(2))
        who = ["a $\\frac$ b", *(f"c{i}" for i in range(COLUMNS))]
        parts.append(rolled_out(row, [(contender(each, training_seeds=(1,)), run) for each in who]))
    figures = draw_figures(joined(parts))
    assert list(figures) == ["result.svg", "pareto.svg", "crystal.png"]
    assert figures["crystal.png"].startswith(b"\x89PNG")
    for name in ("result.svg", "pareto.svg"):
        words = [each.text for each in ElementTree.fromstring(figures[name]).iter(f"{SVG}text")]
        assert who[0] in words
    inches = Image.open(io.BytesIO(figures["crystal.png"])).width / DPI
    assert 830.0 / inches * 8.0 / 72.0 > 10.0, "8 point text is too small where a page shows the figure 830 pixels wide"


# Colours that share a figure stay apart for every reader

KINDS = {
    "none": np.eye(3),
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
"""Machado, Oliveira and Fernandes (2009): linear RGB as it is seen, at full severity."""
LEAST = 15.0
"""Least distance of two colours of a figure in CIELAB [-]; 2.3 is just seen."""
ON_DARK = [f"#{red:02X}{green:02X}{blue:02X}"
           for red, green, blue in (canvas.TRUE, canvas.CAMERA, canvas.REFERENCE, canvas.DRIVE)]  # fmt: skip


def linear(colours):
    """Linear RGB of colours such as "#D55E00", shape (colours, 3)."""
    c = np.array([[int(colour[place : place + 2], 16) for place in (1, 3, 5)] for colour in colours]) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    """CIELAB of linear RGB under D65."""
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    t = np.clip(rgb, 0.0, 1.0) @ np.transpose(to_xyz) / (0.9505, 1.0, 1.089)
    x, y, z = np.moveaxis(np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16.0 / 116.0), -1, 0)
    return np.stack((116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)), axis=-1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "colours",
    [COLOURS, [*map(lighter, COLOURS)], [plots.TRUE, plots.RING, plots.DRIVE, plots.INK], ON_DARK],
    ids=["controllers", "on a dark ground", "signals", "window"],
)
def test_colours_of_a_figure_stay_apart_for_colour_blind_readers(colours, kind):
    seen = lab(linear(colours) @ np.transpose(KINDS[kind]))
    apart = np.linalg.norm(seen[:, None] - seen, axis=-1)[np.triu_indices(len(colours), 1)]
    assert apart.min() >= LEAST


def test_true_radius_and_ring_have_one_hue_each_on_white_and_in_the_window():
    light, dark = lab(linear([plots.TRUE, plots.RING, plots.DRIVE])), lab(linear([ON_DARK[0], ON_DARK[1], ON_DARK[3]]))
    hues = [np.arctan2(each[:, 2], each[:, 1]) for each in (light, dark)]
    assert np.abs(np.angle(np.exp(1j * (hues[0] - hues[1])))).max() < np.deg2rad(35.0)


def test_colours_are_seen_on_their_ground():
    luminance = [linear(each) @ [0.2126, 0.7152, 0.0722] for each in (COLOURS, [*map(lighter, COLOURS)])]
    assert (1.05 / (luminance[0] + 0.05)).min() > 2.5
    assert ((luminance[1] + 0.05) / (linear(["#0d1117"]) @ [0.2126, 0.7152, 0.0722] + 0.05)).min() > 2.5


def test_a_look_differs_in_colour_mark_and_dashes_and_diamonds_are_learned():
    assert len(COLOURS) == len(plots.DASHES) == len({*plots.DASHES})
    body, whole = ([*STYLES.values()][:8], [*STYLES.values()][8:16])
    for looks in (body, whole):
        assert [len({*part}) for part in zip(*looks, strict=True)] == [8] * 3
    assert [name for name, look in STYLES.items() if look.mark in plots.LEARNED] == [
        "gradient", "ppo", "sac", "ppo-plain", "gradient-along", "ppo-along",
    ]  # fmt: skip


def test_many_unknown_names_have_looks_of_their_own():
    names = [f"c{number}" for number in range(48)]
    known = plots.styles([*names, "gradient", "mine"], learned=["mine"])
    assert len({*known.values()}) == 50
    assert known["gradient"] == STYLES["gradient"]
    assert known["mine"].mark in plots.LEARNED
    assert {len(corners) > 2 for corners in plots.MARKS.values()} == {True}
