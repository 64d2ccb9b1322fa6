"""The price of robustness: each controller before, after and told."""

from functools import partial

from cz_gym.baselines.lqg.designs import TOLD
from cz_gym.baselines.registry import make_controller
from cz_gym.config import make_config
from studies import hot_zone
from tests.observed import PLAIN


def test_a_controller_before_has_the_settings_of_the_one_that_ships_for_nominal_hot_zones():
    config = make_config("hot-zone", **PLAIN)
    found, nominal = hot_zone.versions("lqg-at-0.02", config), make_controller(TOLD, config)
    assert found["before"] == nominal != found["after"]
    assert found["told"].design == found["before"].design
    assert "told" not in hot_zone.versions("lqg-at-0.02-adaptive", config)


def test_the_command_prints_a_row_a_controller(monkeypatch, capsys, refused):
    monkeypatch.setattr(hot_zone, "make_config", partial(make_config, horizon=300.0))
    assert hot_zone.main(["--episodes", "2", "--controllers", "paper-tuned,lqg"]) == 0
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert [[cell.strip("| ") == "-" for cell in row].count(True) for row in rows] == [2, 0]
    assert rows[0][1] == rows[0][2], "a PID has its settings of before"
    for name in ("lqgg", "paper"):  # no controller, and one without settings of before
        assert f"unknown controller {name!r}" in refused(hot_zone.main, ["--controllers", name])
