"""The scalar environment: arguments, actions, info, mixtures of scenarios; tagged actions in every form."""

import math
import pickle
from copy import deepcopy
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import InvalidAction, ResetNeeded

import cz_gym
from cz_gym import SCENARIOS, CzEnv, CzVectorEnv, Parameters, Scenario, make_puller
from cz_gym.body.signals import Logged
from cz_gym.camera import Camera
from cz_gym.config import Config, make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.engine.batch import first_key
from cz_gym.engine.tangents import DifferentiableBatch
from cz_gym.episodes.draw import MIXTURE_STREAM
from cz_gym.episodes.scenario import Actuators
from cz_gym.episodes.scenarios import ALL, find_distribution
from cz_gym.physics.plant import Disturbance, State, growth
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.puller.file import FOLDER, find_puller
from cz_gym.spaces import tag
from tests.observed import PLAIN

MM_PER_MIN = 1e-3 / 60
P = make_puller()


def test_everything_advertised_is_there():
    assert cz_gym.__all__ == sorted(cz_gym.__all__, key=lambda name: (not name.isupper(), name))
    for name in cz_gym.__all__:
        assert hasattr(cz_gym, name)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"scenario": "paper-ramp-II"}, "the scenario is 'paper-ramp', with model='II'"),
        ({"scenario": "randomized-2s"}, "the scenario is 'randomized', with control_interval=2.0"),
        ({"scenario": "randomised"}, "unknown scenario 'randomised': did you mean 'randomized'"),
        ({"scenario": "nonsense"}, "unknown scenario 'nonsense'; choose from nominal"),
        ({"scenario": {"randomised": 1.0}}, "unknown scenario 'randomised': did you mean 'randomized'"),
        ({"scenario": "al"}, "unknown scenario 'al'.* all"),
        ({"scenario": {"hard": 0.0}}, "positive numbers: that of 'hard' is 0.0"),
        ({"scenario": {"hard": math.nan}}, "positive numbers"),
        ({"scenario": {"hard": True}}, "positive numbers"),
        ({"scenario": {"hard": "much"}}, "positive numbers"),
        ({"scenario": {}}, "at least one scenario"),
        ({"scenario": {"hard": 1, SCENARIOS["hard"]: 1}}, "'hard' is there twice"),
        ({"scenario": {"all": 1.0}}, "one scenario, not the mixture"),
        ({"scenario": {"hard-I": 1.0}}, "is a row of the benchmark"),
        ({"scenario": ["hard"]}, "unknown scenario .* dict of scenarios and their shares"),
        ({"model": "III"}, "not 'III'"),
        ({"model": True}, '"I", "II", a mix in .* not True'),
        ({"observation": "all"}, "unknown observation 'all'; choose from measured, history, state"),
        ({"control_interval": 0}, "control_interval must be a positive number"),
        ({"control_interval": 7.0}, "whole number of control intervals"),
        ({"horizon": math.inf}, "horizon must be a positive number"),
        ({"render_mode": "hologram"}, "render_mode .*'hologram'"),
        ({"parameters": {"sigma": 1.0}}, r"cz_gym\.Parameters"),
        ({"parameters": Parameters(k_l=math.nan)}, "parameter k_l = nan"),
        ({"meniscus": "hurl"}, r"cz_gym\.MeniscusModel"),
        ({"weights": {"pul": 0.1}}, "unknown weight 'pul': did you mean 'pull'"),
        *(({"weights": {"pull": w}}, "'pull' must be a number of at least 0") for w in (-1.0, math.nan, math.inf, "1")),
        ({"weights": [0.5]}, "this needs a Mapping, not .0.5.: weights="),
        ({"process": "x"}, "this needs a Process, not 'x': cz_gym.body.process.BODY is one"),
        ({"scenaro": "hard"}, "unexpected keyword argument .scenaro.: did you mean .scenario.[?]"),
        ({"frameskip": 4}, "unexpected keyword argument .frameskip.; choose from scenario"),
        ({"settings": 4}, "unexpected keyword argument .settings.; choose from scenario, model, .* stage, [^s]"),
        ({"action": "rough"}, "unknown action 'rough'; choose from direct, smooth, rate"),
        ({"info": "everything"}, "info must be one of lean, all, not 'everything'"),
        ({"parameters": Parameters(alpha_0=1.5)}, "nominal meniscus height .* check r_0, alpha_0"),
        ({"meniscus": YOUNG_LAPLACE, "parameters": Parameters(r_0=0.02)}, "meniscus .young-laplace. .r_0 >= a"),
        ({"meniscus": YOUNG_LAPLACE, "parameters": Parameters(phi_b=0.35)}, "phi_b from 0.0087 to 0.2618 rad"),
    ],
)
@pytest.mark.parametrize("make", [CzEnv, cz_gym.CzVectorEnv])
def test_bad_arguments_are_refused_in_one_line(make, arguments, says):
    with pytest.raises(ValueError, match=says) as refusal:
        make(**arguments)
    assert "\n" not in str(refusal.value)
    assert isinstance(refusal.value, TypeError) == says.startswith("unexpected keyword"), (
        "TorchRL probes with frameskip"
    )


def test_a_drawn_puller_without_operating_point_is_drawn_again():
    """In a crucible as hot as this, every third draw has none: a training died of it in the middle of a step."""
    scenario = SCENARIOS["randomized"]
    spread = replace(scenario.pullers, conductance=0.3, conductivity=0.3)
    hot = Config(replace(scenario, name="hot", pullers=spread), horizon=25.0, parameters=Parameters(T_e=2450.0))
    env = CzVectorEnv.from_config(hot, 200, info="all")
    env.reset(seed=0)
    for _ in range(12):
        env.step(np.zeros((200, 2), np.float32))
    pullers = np.array([[*state.slot.slot["puller"].item()] for state in env.get_state()])
    assert np.isfinite(pullers).all()
    assert len(np.unique(pullers[:, 0])) == 200
    one = CzEnv.from_config(hot, info="all")
    for seed in range(20):
        one.reset(seed=seed)
        assert np.isfinite(one.get_state().slot.slot["puller"].item()).all()


@pytest.mark.parametrize(
    "action",
    [[math.nan, 0.0], [0.0], [0.0, 0.0, 0.0], [[0.0, 0.0]], 0.0, "up", None, ["a", "b"], np.zeros((2, 3)),
     np.full((2, 2), math.nan), [[0.0, 0.0], [0.0]]],
)  # fmt: skip
@pytest.mark.parametrize("make", [CzEnv, lambda: CzVectorEnv(2, **PLAIN)])
def test_bad_actions_are_refused(make, action):
    env = make()
    with pytest.raises(ResetNeeded):
        env.step(np.zeros((2, 2)))
    env.reset(seed=0)
    with pytest.raises(InvalidAction, match=r"actions? must") as refusal:
        env.step(action)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("number", [np.int64, np.float32, np.float64])
def test_numpy_numbers_are_numbers(number):
    parameters = Parameters()._replace(T_m=number(1685), C_1=number(57000))
    given = make_config("nominal", number(1), "measured", number(5), number(100), parameters, action="direct")
    plain = make_config("nominal", 1.0, "measured", 5.0, 100.0, action="direct")
    assert (given.hash, given.steps, given.mix) == (plain.hash, 20, (1.0, 1.0))


def test_equal_plants_have_equal_hashes():
    zero, minus_zero = (make_config(parameters=Parameters(T_e=T_e), **PLAIN) for T_e in (0.0, -0.0))
    assert zero.plant_hash == minus_zero.plant_hash == Config(parameters=Parameters(T_e=0)).plant_hash
    assert Config(parameters=Parameters(T_m=1685)).plant_hash == make_config(**PLAIN).plant_hash
    assert make_config(action="smooth", observation="measured").plant_hash == make_config(**PLAIN).plant_hash
    assert make_config(action="smooth", observation="measured").hash != make_config(**PLAIN).hash
    assert make_config("nominal", -0.0, **PLAIN).hash == make_config("nominal", 0, **PLAIN).hash


def test_out_of_range_actions_are_clipped_and_said_so():
    runs = []
    for action, clipped in (([3.0, -math.inf], True), ([1.0, -1.0], False)):
        env = CzEnv(info="all", **PLAIN)
        env.reset(seed=0)
        observation, *_, info = env.step(np.array(action))
        assert info["action_clipped"] == clipped
        runs.append((observation.tolist(), info["v_p"], info["Q_H"]))
    assert runs[0] == runs[1]


def infos(env, actions, seed=0):
    """Infos of a reset and of a step with each of the actions."""
    return [env.reset(seed=seed)[1], *(env.step(np.array(action, np.float32))[4] for action in actions)]


def drives(found):
    """Pull speed, in shares of v_0, and heater power [W] above nominal, in infos of the default puller."""
    pull, power = np.array([(info["v_p"], info["Q_H"]) for info in found]).T
    return pull / P.v_0 - 1.0, power - P.Q_H_0


def test_actions_are_pull_speed_and_power():
    pull, power = drives(infos(CzEnv("nominal", info="all", **PLAIN), [(1.0, 0.0), (-1.0, 1.0), (0.5, -0.25)]))
    assert (pull[0], power[0]) == (0.0, 0.0)
    assert pull[1:] == pytest.approx([1.0, -1.0, 0.5], abs=1e-12)
    assert power[1:] == pytest.approx([0.0, 10e3, -2.5e3])


def test_info_is_the_plant_in_si():
    env = CzEnv("only-interface", model=0.3, info="all", **PLAIN)
    p, info = make_puller(lam=0.3), infos(env, [(0.2, 0.0)] * 5, seed=2)[-1]
    slot = env.get_state().slot.slot
    x = State(info["r_c"], info["h_c"], info["T_1"], math.nan, info["T_b"])
    grown = growth(x, Disturbance(0.0, float(slot["dT_i"]), 1.0), p, cz_gym.HURLE.slope)
    assert info["v_g"] == pytest.approx(grown.v_g, rel=1e-12)
    assert math.tan(info["alpha_c"]) == pytest.approx(grown.tan_alpha, rel=1e-9)
    assert info["r_br"] == pytest.approx(info["r_c"] + cz_gym.HURLE.ring_offset(info["r_c"], info["h_c"], p))
    assert (info["r_ref"], info["T_1_ref"]) == (p.r_0, p.T_1_0)
    assert "state" not in info


def test_drives_obey_window_slew_and_steps():
    limits = Actuators(
        pull_window=0.5 * MM_PER_MIN, pull_slew=0.3 * MM_PER_MIN / 60, heater_slew=2000.0 / 60, heater_step=100.0
    )
    env = CzEnv(Scenario("mine", actuators=limits), info="all", **PLAIN)
    pull, power = drives(infos(env, [(1.0, 0.553)] * 60 + [(-1.0, 0.0)] * 60)[1:])
    t = 5.0 * np.arange(1, 61)
    np.testing.assert_allclose(1.2 * pull[:60], np.minimum(0.3 * t / 60, 0.5), atol=1e-9)
    np.testing.assert_allclose(power[:60], 100 * np.rint(np.minimum(2000.0 * t / 60, 5530.0) / 100), atol=1e-6)
    assert 1.2 * pull[60:].min() == pytest.approx(-0.5)


@pytest.mark.parametrize("interval", [2.0, 5.0, 10.0])
def test_a_held_action_is_approached_with_one_time_constant(interval):
    """v_p -> v_0 (1 + a) and Q_H -> Q_H0 + 5 kW a, whatever the control interval."""
    env = CzEnv("nominal", action="smooth", control_interval=interval, horizon=600.0, info="all")
    steps = round(100.0 / interval)
    pull, power = drives(infos(env, [(0.4, -0.5)] * steps + [(0.0, 0.0)] * steps))
    reached = 1.0 - np.exp(-np.arange(1, steps + 1) * interval / 50.0)
    assert pull[1 : steps + 1] == pytest.approx(0.4 * reached, rel=1e-5)
    assert power[1 : steps + 1] == pytest.approx(-2.5e3 * reached, rel=1e-5)
    assert pull[-1] == pytest.approx(0.4 * (math.exp(-2.0) - math.exp(-4.0)), rel=1e-5)


@pytest.mark.parametrize("interval", [2.0, 10.0])
def test_rates_add_up_within_the_range_of_the_drives(interval):
    """An action of 1 moves the pull speed by v_0 and the heater by 5 kW every 50 s; left alone they stay."""
    env = CzEnv("nominal", action="rate", control_interval=interval, horizon=600.0, info="all")
    held = [action for action in (-0.5, 0.0, -1.0, -1.0, -1.0) for _ in range(round(20.0 / interval))]
    pull, power = drives(infos(env, [(action, action) for action in held])[:: round(20.0 / interval)])
    assert pull[1:] == pytest.approx([-0.2, -0.2, -0.6, -1.0, -1.0], abs=1e-5)
    assert power[1:] == pytest.approx([-1e3, -1e3, -3e3, -5e3, -7e3], rel=1e-5)
    env.step(np.zeros(2))  # which an episode that is over refuses


def test_info_is_lean_unless_all_is_asked_for():
    for env, keys in (
        (CzEnv(), {"r_c", "r_ref", "cost", "action_clipped"}),
        (CzEnv(info="all"), {*Logged._fields, "state"}),
        (CzEnv(info="all", observation="measured"), set(Logged._fields)),
    ):
        _, info = env.reset(seed=0)
        assert set(info) == keys
        *_, info = env.step(np.array([0.5, 0.5], np.float32))
        assert set(info) == keys
        assert not info["action_clipped"]
        *_, info = env.step(np.array([1.5, 0.5], np.float32))
        assert (set(info), type(info)) == (keys, dict), "trees of arrays take no other keys and no other class"
        assert info["action_clipped"]
        assert {type(value) for value in info.values()} <= {np.float64, np.bool_, bool, np.ndarray}, (
            "TorchRL reads dtypes"
        )


def test_a_deep_copy_of_info_shares_nothing():
    for env in CzEnv(), CzEnv(observation="measured"), CzEnv(info="all"):
        _, info = env.reset(seed=0)
        info["of a wrapper"] = {"inside": [1.0]}
        before, copy = deepcopy(dict(info)), deepcopy(info)
        info["r_c"] = 0.0
        info["of a wrapper"]["inside"].append(2.0)
        if "state" in info:
            info["state"][:] = 0.0
        assert repr(copy) == repr(before)


MIX = {"puller": 1.0, "randomized": 2.0, replace(SCENARIOS["hard"], name="mine"): 1.0}
MEMBERS = find_distribution(MIX).scenarios
BY_NAME = {scenario.name: scenario for scenario in MEMBERS}
SHORT = {"horizon": 40.0, "observation": "history", "action": "smooth", "info": "all"}


def test_all_is_every_random_row_of_the_benchmark():
    shares = {each.name: share for each, share in zip(ALL.scenarios, ALL.shares, strict=True)}
    assert shares == {"hard": 0.175, "hot-zone": 0.175, "puller": 0.175, "randomized": 0.3, "sensor-fault": 0.175}
    assert find_distribution("all") is ALL
    assert find_distribution({name: 2.0 * share for name, share in shares.items()}) == ALL


def test_shares_order_and_unit_of_equal_mixtures_do_not_matter():
    one, other = find_distribution({"hard": 1, "puller": 3}), find_distribution({"puller": 75.0, "hard": 25.0})
    assert (one, one.hash, one.name) == (other, other.hash, "0.25 hard + 0.75 puller")
    assert one.hash != find_distribution({"hard": 1, "puller": 2}).hash
    assert find_distribution(one) is one
    config = make_config(one)
    assert (config.scenario, config.mix) == (one, (0.0, 1.0))
    assert make_config({"hard": 1, "puller": 2}).hash != config.hash != make_config("hard").hash
    assert not one.deterministic
    assert find_distribution({"nominal": 1.0}).deterministic
    assert make_config("hard").sole_scenario is SCENARIOS["hard"]
    with pytest.raises(ValueError, match="one scenario, not the mixture"):
        config.sole_scenario  # noqa: B018


def test_shares_of_two_thousand_episodes_on_a_stream_of_their_own():
    _, infos = CzVectorEnv(2000, "all").reset(seed=list(range(5, 2005)))
    names, upto = [each.name for each in ALL.scenarios], np.cumsum(ALL.shares)
    for i in range(2000):
        stream = np.random.SeedSequence(list(first_key(5 + i)), spawn_key=(MIXTURE_STREAM,))
        u = np.random.Generator(np.random.PCG64(stream)).random()
        assert infos["scenario"][i] == names[int(np.searchsorted(upto, u, side="right"))]
    for name, share in zip(names, ALL.shares, strict=True):
        assert np.mean(infos["scenario"] == name) == pytest.approx(share, abs=4 * math.sqrt(share / 2000))


@pytest.mark.parametrize("model", [None, "I"])
def test_an_episode_is_bit_for_bit_that_of_its_scenario_alone(model):
    """Every re-drawn episode, too: the environments alone are reset with the same seed as often as the mixture was."""
    env, alone = CzEnv(MIX, model, **SHORT), {name: CzEnv(one, model, **SHORT) for name, one in BY_NAME.items()}
    met = set()
    for episode in range(12):
        seed = 7 if episode == 0 else None
        expected = {name: each.reset(seed=seed) for name, each in alone.items()}
        observation, info = env.reset(seed=seed)
        name = info.pop("scenario")
        met.add(name)
        np.testing.assert_array_equal(observation, expected[name][0])
        for action in np.random.default_rng(4).uniform(-1.1, 1.1, (8, 2)):
            found, (seen, reward, *ends, told) = env.step(action), alone[name].step(action)
            assert found[4].pop("scenario") == name
            np.testing.assert_array_equal(found[0], seen)
            np.testing.assert_array_equal(found[4].pop("state"), told.pop("state"))
            assert (found[1], *found[2:]) == (reward, *ends, told)
    assert met == set(BY_NAME)


def test_an_option_draws_one_episode_from_a_scenario_or_a_mixture():
    env, batch = gym.make("Cz-v0", scenario=MIX), gym.make_vec("Cz-v0", 2, "vector_entry_point", scenario=MIX)
    assert env.reset(seed=1, options={"scenario": "sensor-fault"})[1]["scenario"] == "sensor-fault"
    assert batch.reset(seed=1, options={"scenario": "nominal"})[1]["scenario"].tolist() == ["nominal"] * 2
    assert env.reset()[1]["scenario"] in BY_NAME
    plain, batch = CzEnv("hard"), CzVectorEnv(2, "hard")
    assert "scenario" not in plain.reset(seed=1)[1]
    assert plain.reset(options={"scenario": {"nominal": 1.0}})[1]["scenario"] == "nominal"
    assert batch.reset(options={"scenario": {"nominal": 1.0}})[1]["scenario"].tolist() == ["nominal"] * 2
    assert pickle.loads(pickle.dumps(plain)).step(np.zeros(2))[4]["scenario"] == "nominal"
    assert plain.reset()[1]["scenario"] == "hard"


OWN = make_config(horizon=600.0, **PLAIN)


@pytest.fixture(params=["scalar", "vector", "differentiable"])
def step(request):
    """The step of one form of the environment, with an action of its shape."""
    if request.param == "scalar":
        env = CzEnv.from_config(OWN)
        env.reset(seed=0)
        return env.step, np.zeros(2)
    many = CzVectorEnv.from_config(OWN, 2) if request.param == "vector" else DifferentiableBatch(OWN, 2)
    many.reset(seed=0) if isinstance(many, CzVectorEnv) else many.reset([0, 1])
    return many.step, np.zeros((2, 2))


@pytest.mark.parametrize(
    ("other", "named"),
    [
        ({"action": "smooth"}, "action='smooth'"),
        ({"control_interval": 2.0}, "control_interval=2"),
        ({"parameters": Parameters(v_0=3e-5)}, "plant [0-9a-f]{16}"),
        ({"meniscus": YOUNG_LAPLACE}, "plant [0-9a-f]{16}"),
    ],
)
def test_step_refuses_what_was_made_for_another_environment(step, other, named):
    take, action = step
    theirs = tag(action, make_config(horizon=600.0, **other).made_for)
    with pytest.raises(InvalidAction, match=f"was made for .*{named}.*; the environment has .*gym.make"):
        take(theirs)
    take(np.asarray(theirs))
    take(np.clip(2.0 * theirs, -1.0, 1.0))
    take(tag(action, make_config("hard", **PLAIN).made_for))
    take(tag(action, None))


SPECS = [
    ("Cz-v0", {"scenario": replace(SCENARIOS["puller"], name="mine"), "control_interval": np.int64(10)}),
    ("Cz-v0", {"scenario": {replace(SCENARIOS["hard"], name="mine"): 1, "puller": np.float32(2.0)}}),
    ("Cz-v0", {"scenario": ALL, "model": np.float64(0.5), "weights": {"pull": 0.1}, "action_repeat": 4}),
    ("Cz-v0", {"parameters": Parameters(T_m=1686.0), "meniscus": YOUNG_LAPLACE}),
    ("Cz-v0", {"observation": "camera", "camera": Camera(tilt=0.4)}),
    ("Cz-v0", {"puller": find_puller("germanium")}),
    ("Cz-v0", {"puller": FOLDER / "germanium.toml", "process": CRYSTAL}),
    ("CzCrystal-v0", {"stage": {"crown": 1, "tail": np.float64(2.0)}}),
    ("CzCrystal-v0", {"parameters": make_config(process=CRYSTAL, stage="tail").parameters}),
]


@pytest.mark.parametrize(("name", "arguments"), SPECS)
def test_a_spec_is_json_that_makes_the_same_environment(name, arguments):
    for make, given in ((gym.make, {}), (gym.make_vec, {"num_envs": 2, "vectorization_mode": "vector_entry_point"})):
        env = make(name, **given, **arguments)
        again = make(EnvSpec.from_json(env.spec.to_json()), **given)
        for one, other in ((again, env), (deepcopy(env), env), (pickle.loads(pickle.dumps(env)), env)):
            assert one.unwrapped.config == other.unwrapped.config
            assert one.unwrapped.action_repeat == arguments.get("action_repeat", 1)


@pytest.mark.parametrize("steps", [50, 6])
def test_a_repeated_action_is_the_same_action_for_some_steps(steps):
    """Reward and cost are sums; episodes of 6 steps end in the middle of the second action."""
    settings = {"scenario": "hard", "action": "direct", "horizon": 5.0 * steps}
    repeated, plain = CzEnv(**settings, action_repeat=4), CzEnv(**settings)
    for env in (repeated, plain):
        env.reset(seed=5)
    for action in np.random.default_rng(0).normal(0.0, 0.3, (2, 2)).astype(np.float32):
        observation, reward, terminated, truncated, info = repeated.step(action)
        singly = []
        while len(singly) < 4 and not any(singly[-1][2:4] if singly else ()):
            singly.append(plain.step(action))
        np.testing.assert_array_equal(observation, singly[-1][0])
        assert (reward, terminated, truncated) == (sum(each[1] for each in singly), *singly[-1][2:4])
        assert info["cost"] == sum(each[4]["cost"] for each in singly)
        assert info["r_c"] == singly[-1][4]["r_c"]
    assert truncated == (steps == 6)
    with pytest.raises(ValueError, match="action_repeat must be a positive whole number, not 0"):
        CzEnv(action_repeat=0)
