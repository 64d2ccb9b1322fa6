"""The page on which a visitor pulls a crystal: its script is the plant, its data and scores are the environment's."""

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from cz_gym import CzEnv
from cz_gym.body.process import accept_substep
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Actuators
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import Playback, rollout
from cz_gym.physics.plant import NO_DISTURBANCE, State
from cz_gym.process import Inputs
from cz_gym.support.units import KILO, MINUTE, MM_PER_MIN
from cz_gym.tools.registry import make_controller
from studies import play
from tests.conftest import ROOT

NODE, CHROMIUM = shutil.which("node"), shutil.which("chromium")
TEXT = (ROOT / play.PAGE).read_text("utf-8")
CONFIG = make_config("randomized", None, "measured", action="direct")
SLOW_DRIVES = Actuators(
    pull_window=0.3 * MM_PER_MIN, pull_slew=0.5 * MM_PER_MIN / MINUTE, heater_slew=0.9 * KILO / MINUTE, heater_step=50.0
)
LIMITED = make_config(replace(RANDOMIZED, name="limited", actuators=SLOW_DRIVES), None, "measured", action="direct")
SEED = play.SEEDS[0]
KINDS = {
    "dT_i": "<f8", "camera": "i1", "pyrometer": "i1", "error": "<i2", "v_p": "<i2",
    "rmse_so_far": "<f4", "cost_so_far": "<f4",
}  # fmt: skip
"""Types of the arrays in the page's data."""


def part(name):
    """The content of the page's script of this id."""
    found = re.search(rf'<script[^>]* id="{name}">(.*?)</script>', TEXT, re.DOTALL)
    assert found is not None
    return found[1]


def javascript(code, folder):
    """The value of an expression beside the page's plant, by node or else by Chromium."""
    if NODE:
        file = folder / "run.js"
        file.write_text(f"{part('plant')}\nconsole.log(JSON.stringify({code}));", "utf-8")
        command = [NODE, file]
    else:
        file = folder / "run.html"
        script = f"{part('plant')}\ndocument.querySelector('pre').textContent = JSON.stringify({code});"
        file.write_text(f"<meta charset='utf-8'><pre></pre><script>{script}</script>", "utf-8")
        command = [CHROMIUM, "--headless", "--no-sandbox", f"--user-data-dir={folder}", "--dump-dom", file.as_uri()]
    shown = subprocess.run(command, capture_output=True, check=True, text=True).stdout
    return json.loads(shown.partition("<pre>")[2].partition("</pre>")[0] or shown)


def held():
    """The moves with which the paper's controller holds the first crystal for three hours."""
    run = rollout(make_controller("paper", CONFIG), CONFIG, [SEED])
    moved = np.stack([run.signals.v_p - run.start.v_p, run.signals.Q_H - run.start.Q_H], axis=-1)[:, 0]
    return moved / np.array(CONFIG.ranges)


def waves():
    """Moves faster and wider than slow drives allow, whose heater comes to rest between two steps of it."""
    t = np.arange(CONFIG.steps) * CONFIG.control_interval / MINUTE
    return np.stack([0.4 * np.sin(2.0 * t), 0.1 * np.sign(np.cos(0.7 * t))], axis=-1)


def steady(pull, heat):
    """The same action to the end."""
    return lambda: np.tile((pull, heat), (CONFIG.steps, 1))


CASES = {
    "held": (CONFIG, held, None),
    "frozen": (CONFIG, steady(-1.0, 0.0), 67),
    "detached": (CONFIG, steady(1.0, 1.0), 28),
    "too wide": (CONFIG, steady(-0.05, -0.1), 260),
    "slow drives": (LIMITED, waves, 1725),
}
"""Settings, actions, and the step that loses the crystal."""


@pytest.mark.skipif(not (NODE or CHROMIUM), reason="node and chromium are absent")
@pytest.mark.parametrize("case", CASES)
def test_the_script_is_the_environment_up_to_the_first_failure_and_scores_as_the_benchmark(case, tmp_path):
    """Both get the same actions; an hour is 720 steps."""
    config, make, lost_at = CASES[case]
    exact = make()
    actions = exact.astype(np.float32)
    env, states, terminated, truncated = CzEnv.from_config(config), [], False, False
    env.reset(seed=SEED)
    while not (terminated or truncated):
        *_, terminated, truncated, _ = env.step(actions[len(states)])
        states.append(env.get_state().slot.slot["x"].tolist())
    assert (len(states) if terminated else None) == lost_at
    code = f"""((data, actions) => {{
        const crystal = begin(data.task, data.crystals[0]), states = [], samples = [sample(crystal)];
        for (const action of actions) {{
            step(crystal, ...action);
            [states[crystal.k - 1], samples[crystal.k]] = [crystal.x, sample(crystal)];
        }}
        return {{ states, samples, lost: crystal.lost, score: score(crystal) }};
    }})({json.dumps(play.content(config, [SEED], rivals=()))}, {json.dumps(exact.tolist())})"""
    found = javascript(code, tmp_path)
    assert found["lost"] == terminated
    np.testing.assert_allclose(found["states"], states, rtol=1e-9, atol=0.0)
    run = rollout(Playback(actions), config, [SEED])
    s, start, expected = run.episode(0), run.start, metrics(run)
    assert found["score"]["rmse_mm"] == pytest.approx(expected.rmse_mm[0], rel=1e-9)
    assert found["score"]["cost"] == pytest.approx(expected.cost[0], rel=1e-9)
    shown = {name: np.array([each[name] for each in found["samples"]]) for name in found["samples"][0]}
    signals = {name: np.append(getattr(start, name)[0], getattr(s, name)) for name in s._fields}
    bias = play.pullers_of(config, [SEED])[0].ring_bias
    camera = signals["r_br_measured"] - bias - signals["r_ref"]
    np.testing.assert_allclose(shown["ring"], camera, rtol=0.0, atol=0.5 * play.CAMERA_UNIT + 1e-9)
    np.testing.assert_allclose(shown["truth"], signals["r_c"] - signals["r_ref"], rtol=0.0, atol=1e-10)
    noise = play.PYROMETER_UNIT * unpacked(play.content(config, [SEED], ())["crystals"][0]["pyrometer"], "i1")
    warm = signals["T_1"] - signals["T_1_ref"] + noise[: len(signals["T_1"])]
    np.testing.assert_allclose(shown["warm"], warm, rtol=0.0, atol=1e-8)
    for name in ("v_p", "Q_H"):
        np.testing.assert_allclose(shown[name], signals[name], rtol=1e-12)


@pytest.mark.skipif(not (NODE or CHROMIUM), reason="node and chromium are absent")
def test_a_step_is_accepted_as_in_the_environment(tmp_path):
    """Over a very cold melt and for jumps too, which the cases above do not reach."""
    rng, p = np.random.default_rng(1), play.pullers_of(CONFIG, [SEED])[0]
    r, h = p.r_0 + rng.uniform(-9e-3, 9e-3, (400, 2)), rng.uniform(1e-3, 10e-3, (400, 2))
    h[::2, 0] = 1.2e-3 + rng.exponential(0.2e-3, 200)
    h[::3, 1], r[::4, 1] = h[::3, 0], r[::4, 0]
    T_b = p.T_b_0 - rng.exponential(30.0, 400)
    points = [[State(*r_h, 0.0, 0.0, T) for r_h in zip(r[i], h[i], strict=True)] for i, T in enumerate(T_b.tolist())]
    held = Inputs(p.v_0, p.Q_H_0), NO_DISTURBANCE, p, 5.0, p.r_0, CONFIG.meniscus.slope
    expected = [accept_substep(x, new, *held) for x, new in points]
    given = play.content(CONFIG, [SEED], rivals=())["task"], p._asdict(), points
    code = """((task, p, points) => points.map(([x, next]) =>
        accept({ task, p, x }, next, { v_p: p.v_0 }, { dT_i: 0 }, p.r_0)))"""
    assert javascript(f"{code}(...{json.dumps(given)})", tmp_path) == [[list(x), bool(grows)] for x, grows in expected]


def unpacked(text, kind):
    return np.frombuffer(base64.b64decode(text), kind)


def leaves(value, name=""):
    """Name and numbers of every entry of the page's data; an infinite limit is NaN."""
    if isinstance(value, dict | list):
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(each, str(key) if isinstance(key, str) else name)
    elif isinstance(value, str):
        yield name, unpacked(value, KINDS[name]) if name in KINDS else value
    else:
        yield name, np.array(value, np.float64)


@pytest.mark.slow
def test_the_command_writes_the_page_as_it_is(tmp_path, monkeypatch):
    """All but the last digits, which another machine may compute otherwise."""
    monkeypatch.chdir(ROOT)
    assert play.main(["--out", str(tmp_path / "page.html")]) == 0
    text = (tmp_path / "page.html").read_text("utf-8")
    assert play.PLACE.sub("", text, count=1) == play.PLACE.sub("", TEXT, count=1)
    for (name, shown), (_, made) in zip(
        *(leaves(json.loads(play.PLACE.search(page)[0])) for page in (TEXT, text)), strict=True
    ):
        whole = np.asarray(shown).dtype.kind == "i"
        if name == "scenario":
            assert shown == made == "randomized"
        else:
            rtol = 1e-5 if name.startswith(("rmse", "cost")) else 1e-9
            np.testing.assert_allclose(shown, made, rtol=0 if whole else rtol, atol=1 if whole else 1e-12, err_msg=name)
    assert len(TEXT) < 300_000
