"""Figures: who is shown when there are many, colours, and a crystal that nothing disturbs."""

import io

import pytest
from PIL import Image

from cz_gym.baselines import OpenLoop
from cz_gym.config import make_config
from cz_gym.evaluation.plots import COLOURS, COLUMNS, DPI, styles_of
from cz_gym.evaluation.protocol import find_case
from cz_gym.evaluation.rollout import rollout
from cz_gym.tools.registry import CONTROLLERS
from cz_gym.tools.report.figures import NAMED, draw_figures
from cz_gym.tools.report.markdown import brief
from cz_gym.tools.report.tables import chosen
from tests.observed import PLAIN
from tests.samples import contender, joined, made, rolled_out

AGENTS = {"gradient": 0.05, "ppo": 0.06, "sac": 0.2, "ppo-plain": 0.3}
"""Shipped agents with their RMSE [mm], as on the test crystals."""
NOMINAL = find_case("nominal")


def sample(name, rmse, **facts):
    return contender(name, **facts), {"rmse_mm": [rmse]}


def names(contenders):
    return [one.name for one in contenders]


def everyone():
    """The default table: classical controllers of the registry, and the shipped agents."""
    classical = [(each, {"rmse_mm": [0.1]}) for each in CONTROLLERS if each.default]
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
    assert len(COLOURS) >= NAMED
    known = styles_of([who for who, _ in everyone()])
    assert len({one.colour for one in known.values()}) == len(known) == len(everyone())


@pytest.mark.filterwarnings("error")
def test_figures_of_a_crystal_that_nothing_disturbs_and_of_a_name_that_seems_a_formula():
    parts = []
    for name in ("nominal", "randomized"):
        row = find_case(name)
        run = rollout(OpenLoop(), make_config(name, horizon=600.0, **PLAIN), row.seeds(2))
        who = ["a $\\frac$ b", *(f"c{i}" for i in range(COLUMNS))]
        parts.append(rolled_out(row, [(contender(each, training_seeds=(1,)), run) for each in who]))
    figures = draw_figures(joined(parts))
    assert set(figures) == {"crystal.png", "pareto.png"}
    assert all(image.startswith(b"\x89PNG") for image in figures.values())
    inches = Image.open(io.BytesIO(figures["crystal.png"])).width / DPI
    assert 830.0 / inches * 8.0 / 72.0 > 10.0, "8 point text is too small where a page shows the figure 830 pixels wide"
