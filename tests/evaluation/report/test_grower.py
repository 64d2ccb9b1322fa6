"""The report for a puller: what a grower reads first, and that its figures are those of the rollouts."""

from dataclasses import replace

import numpy as np
import pytest

from cz_gym.baselines.analysis import linear_form, loop_margins
from cz_gym.evaluation.metrics import OUTSIDE
from cz_gym.evaluation.protocol import find_case
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.plant import make_puller
from cz_gym.puller.file import find_puller
from cz_gym.tools import benchmark
from cz_gym.tools.registry import find_controller
from cz_gym.tools.report import markdown as grower
from cz_gym.tools.report import tables
from cz_gym.tools.report.markdown import markdown, terminal
from cz_gym.tools.report.page import page
from tests.samples import rolled_out

NAMES = ("open-loop", "pid-conventional", "paper-tuned")
ROW = replace(find_case("randomized"), puller=find_puller("silicon-300mm"), tolerance=0.4e-3)


@pytest.fixture(scope="module")
def runs():
    config = ROW.config()
    return {name: rollout(find_controller(name).make(config), config, ROW.seeds(4)) for name in NAMES}


@pytest.fixture(scope="module")
def result(runs):
    return rolled_out(ROW, [(find_controller(name), run) for name, run in runs.items()])


def test_scrap_is_the_share_of_time_outside_the_band_and_all_of_it_after_a_loss(runs, result):
    assert runs["open-loop"].failed.any()
    shares = {}
    for name, run in runs.items():
        error, whole = np.abs(run.signals.r_c - run.signals.r_ref), run.alive.sum(axis=0) - run.failed
        inside = [(error[:end, crystal] <= ROW.tolerance).sum() for crystal, end in enumerate(whole)]
        shares[name] = 1.0 - np.mean(inside) / len(error)
    for name, share in shares.items():
        assert result.mean(ROW, name, OUTSIDE) == pytest.approx(share)
    heads, rows = grower.outcome(result, ROW)
    assert heads[1:4] == ("scrap: diameter outside ±0.8 mm [% of time]", "crystals lost [%]", "diameter RMSE [mm]")
    assert [row[0] for row in rows] == sorted(shares, key=shares.get)
    rmse = result.mean(ROW, "paper-tuned", "rmse_mm")
    assert f"{2 * rmse:.3f} [" in next(row for row in rows if row[0] == "paper-tuned")[3]


def test_the_first_line_recommends_the_controller_that_loses_least_and_scraps_least(result, monkeypatch):
    texts = markdown(result, "", ()), page(result, ""), terminal(result)
    assert texts[0].startswith("No recommendation: 4 crystals, and it takes a controller and at least 20.")
    monkeypatch.setattr(tables, "FEWEST", 4)
    line = grower.recommendation(result)
    best = grower.outcome(result, ROW)[1][0][0]
    assert line.startswith(f"Recommended for silicon-300mm: {best}, which loses none of 4 crystals on randomized. The ")
    alone = result.only(contenders=result.contenders[:1])
    assert grower.recommendation(alone).startswith("No controller is fit for silicon-300mm: open-loop loses the ")
    texts = markdown(result, "", ()), page(result, ""), terminal(result)
    assert texts[0].startswith(line)
    assert f'<body>\n<p id="verdict">{line}' in texts[1]
    assert texts[2].endswith(line)
    for text in texts:
        assert "No learned agent" not in text
        assert "outside ±0.8 mm" in text
    for text in texts[:2]:
        assert "300 mm in diameter" in text
        assert "counts 13.7" in text, "the largest error on this puller, not the default one's 8 mm"


def test_margins_are_those_of_the_worse_model_and_a_dash_where_there_is_no_loop(result):
    rows = {name: cells for name, *cells in grower.margins(result)}
    assert rows["open-loop"] == ["-"] * 4
    config = ROW.config()
    form = linear_form(find_controller("paper-tuned").make(config), config.sole_scenario.sensor)
    both = [loop_margins(form.controller, make_puller(config.parameters, mix), form.dt) for mix in (1.0, 0.0)]
    wanted = min(one.gain_up for one in both), max(one.gain_down for one in both), min(one.phase_deg for one in both)
    assert rows["paper-tuned"][:3] == [f"{value:.3g}" for value in wanted]


@pytest.mark.parametrize("options", [["--tolerance", "1"], ["--puller", "germanium", "--tolerance", "-1"]])
def test_a_tolerance_is_a_length_and_for_a_puller(options, refused, tmp_path):
    said = refused(benchmark.main, [*options, "--out", str(tmp_path)])
    assert f"--tolerance {options[-1]} must be up to 50 mm, beside --puller FILE.toml" in said
