"""The game's page in Chromium without a window: from disk, by keyboard, on a phone; its score is the benchmark's."""

import numpy as np
import pytest

from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import Playback, rollout
from studies import play
from tests.browser.test_pages import chromium, pytestmark, resize, text, until  # noqa: F401
from tests.conftest import ROOT
from tests.studies.test_game import CONFIG

WAIT_AND_SEE = """
    for (let n = 0; !over; n++) {
        $("pull").value = 1.2 + [0.02, -0.03, 0.0][n % 3];
        $("power").value = [-0.05, 0.0, 0.1][n % 3];
        advance(7);
    }
    show();
    return moves;
"""
CONTRAST = """
    const light = (name) => css(name).match(/[0-9a-f]{2}/gi).map((two) => parseInt(two, 16) / 255)
        .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4))
        .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
    const [a, b] = [light(arguments[0]), light(arguments[1])];
    return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
"""


@pytest.fixture(scope="module")
def game(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


@pytest.fixture(autouse=True)
def page(game):
    game.get((ROOT / play.PAGE).as_uri())


def test_it_plays_by_keyboard_and_pauses(game):
    body = game.find_element("tag name", "body")
    body.send_keys(" ")
    until(game, lambda: game.execute_script("return crystal.k") > 0)
    body.send_keys("\ue013\ue013\ue012")  # up, up, left
    assert text(game, "pull-text") == "1.22 mm/min"
    assert text(game, "power-text").endswith("(\u22120.05)")
    body.send_keys(" ")
    assert text(game, "status") == "Paused."
    assert not game.find_element("id", "end").is_displayed()


@pytest.mark.parametrize("which", [0, 4])
def test_the_score_is_the_benchmarks_on_the_same_moves(game, which):
    game.execute_script("$('which').value = arguments[0]; restart()", which)
    moves = np.array(game.execute_script(WAIT_AND_SEE))
    expected = metrics(rollout(Playback(moves), CONFIG, [play.SEEDS[which]]))
    lost = ", lost" if expected.failure_rate[0] else ""
    row = [cell.text for cell in game.find_elements("css selector", "#scores tr:first-child td")]
    assert row[0] == f"{expected.rmse_mm[0]:.3f} mm{lost}"
    assert float(row[1]) == pytest.approx(expected.cost[0], rel=5e-3)
    assert "truth" in text(game, "moment-text")


@pytest.mark.parametrize("width", [1200, 390])
def test_it_fits_the_window_and_every_control_has_a_name(game, width):
    resize(game, width)
    game.execute_script(WAIT_AND_SEE)
    assert game.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")
    for control in game.find_elements("css selector", "button, select, input, progress, canvas"):
        assert control.accessible_name or not control.is_displayed()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_words_and_curves_stand_out_from_the_ground(game, scheme):
    game.execute_cdp_cmd(
        "Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    )
    for name in ("ink", "faint", "accent"):
        assert all(game.execute_script(CONTRAST, name, ground) >= 4.5 for ground in ("back", "panel")), name
    for name in ("ring", "truth", "paper", "lqg", "plan"):
        assert game.execute_script(CONTRAST, name, "back") >= 3.0, name
    assert game.execute_script(CONTRAST, "on-accent", "accent") >= 4.5


def test_no_page_logged_an_error(game):
    assert [line for line in game.get_log("browser") if line["level"] != "INFO"] == []
