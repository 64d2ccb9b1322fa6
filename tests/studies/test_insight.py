"""What an agent does: exact derivatives, loops against the design table's, events that happen as they are said to."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

pytest.importorskip("control")
pytest.importorskip("onnx")

from cz_gym import agents
from cz_gym.agents.agent_file.contract import read_agent
from cz_gym.agents.training.export import actor_onnx
from cz_gym.agents.training.imitation import make_network
from cz_gym.agents.training.recipes import Imitation
from cz_gym.baselines import CompensatedPID, OpenLoop
from cz_gym.baselines.analysis.frequency import frequencies, margins_of, opened
from cz_gym.baselines.analysis.frequency import response as theirs
from cz_gym.baselines.analysis.sampled_loop import Loop, close, root_mean_square, sampled_plant
from cz_gym.baselines.registry import find_controller
from cz_gym.episodes.scenarios import HARD, PULLER, RANDOMIZED
from cz_gym.observation import HISTORY
from cz_gym.physics.linearisation import StateSpace
from cz_gym.physics.plant import make_puller
from cz_gym.units import MINUTE, MM, MM_PER_MIN
from studies.insight import __main__ as insight
from studies.insight import figures
from studies.insight.figures import gain_figure, jump_figure, loop_figure, response_figure, ripple_figure, share_figure
from studies.insight.linear_agent import AT, jacobian, linear_agent
from studies.insight.loop import Contender, apart, noise_gains, one_reading, response
from studies.insight.report import answer_figures, as_json, as_markdown, jump_figures, ripple_figures
from studies.insight.step_tests import (
    JUMPS,
    LIMITS,
    SPANS,
    STEP_TESTS,
    Event,
    Interface,
    Limit,
    Survival,
    crystal,
    jump_gains,
    parts_of,
    respond,
    ripple_answers,
    run_events,
    survive,
)

DT = 5.0
OMEGA = np.geomspace(1e-4, np.pi / DT, 9)
PATH = agents.shipped("imitation")
CONTRACT, CONTENT = read_agent(PATH)
LEARNED = Interface(CONTRACT.observation, CONTRACT.action)
REST = np.eye(len(HISTORY))[1]
"""Nothing but a valid camera."""


@pytest.fixture(scope="module")
def near() -> Any:
    return linear_agent(CONTENT, REST, DT, CONTRACT.action)


def test_the_derivative_is_the_chain_rules() -> None:
    random, n = np.random.default_rng(0), len(HISTORY)

    def some(*shape: int) -> Any:
        return random.normal(0.0, 0.1, shape).astype(np.float32)

    network = make_network(Imitation(name="some", hidden=(6,)), 0)
    network.normalise.set(some(n), some(n, n))
    weights = {name: value.numpy().astype(float) for name, value in network.state_dict().items()}
    mean, scaling, last = weights["normalise.mean"], weights["normalise.scaling"], weights["last.weight"]
    first, bias = weights["layers.layers.0.weight"], weights["layers.layers.0.bias"]
    at = np.float64(some(n))
    bent = 1.0 - np.tanh(first @ ((at - mean) @ scaling) + bias) ** 2
    expected = ((last[:, :6] * bent) @ first + last[:, 6:]) @ scaling.T
    assert jacobian(actor_onnx(network.actor), at[None]) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_the_frequency_response_is_python_controls() -> None:
    system = insight.controller("lqg").system
    alone = StateSpace(system.A, system.B[:, :1], system.C[:1], system.D[:1, :1])
    assert np.allclose(response(system, DT, OMEGA)[:, 0, 0], theirs(alone, DT, OMEGA), rtol=1e-9)


@pytest.mark.parametrize("name", ["imitation", "gradient"])
def test_a_linear_agent_moves_as_the_agent_does_after_a_small_jump(name: str) -> None:
    """The linear loop of agent and plant against the simulated one: radius 1 um too large, first ten minutes.

    Without noise, two hours later, the agent's filter takes so small a jump for an outlier.
    """
    (system,) = [
        each.system for each in insight.contenders(agents.shipped(name)) if each.name.endswith(insight.AT_REST)
    ]
    contract, _ = read_agent(agents.shipped(name))
    config = crystal(100.0, Interface(contract.observation, contract.action))
    policy = agents.OnnxPolicy.load(agents.shipped(name), config)
    jump, late = 0.001 * MM, LIMITS[0].event._replace(at=90.0 * MINUTE)
    with_it, without = (run_events(policy, config, (late,), [size]).signals for size in (jump, 0.0))
    moved = (with_it.v_p - without.v_p)[round(late.at / DT) :, 0]
    loop = close(system, make_puller(lam=0.5), DT)
    x, expected = np.zeros(len(loop.A)), [0.0]  # the sample of the jump itself was taken before it
    x[:5] = jump * sampled_plant(make_puller(lam=0.5), DT).A[:, 0]
    for _ in moved[1:]:
        expected.append(loop.C[0] @ x)
        x = loop.A @ x
    assert moved == pytest.approx(np.array(expected), abs=0.03 * np.abs(expected).max())


@pytest.mark.parametrize("at", ["camera", "v_p"])
@pytest.mark.parametrize("name", ["lqg", "paper-tuned"])
def test_loops_are_opened_as_the_design_table_opens_them(name: str, at: str) -> None:
    controller, puller = insight.controller(name).system, make_puller(lam=0.5)
    loop = insight.controller(name).loop(OMEGA, 0.5, DT)
    assert np.allclose(loop.opened(at), theirs(opened(controller, puller, DT, at), DT, OMEGA), rtol=1e-8)


def test_the_legend_says_what_at_rest_means() -> None:
    figure = figures.canvas(4.0, 3.0)
    axis = figure.subplots()
    axis.plot([0.0, 1.0], label="gradient at rest")
    figures._legend(figure, axis)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["gradient at rest (no noise)"]


def test_one_reading_is_answered_as_the_loops_own_simulation_does() -> None:
    loop = close(insight.controller("lqg").system, make_puller(lam=0.5), DT)
    x, expected = loop.B[:, 3], [loop.D[:2, 3]]
    for _ in range(39):
        expected.append(loop.C[:2] @ x)
        x = loop.A @ x
    assert one_reading(insight.controller("lqg"), DT)[:40] == pytest.approx(np.array(expected), rel=1e-9, abs=1e-15)


def test_noise_gains_are_those_of_the_lyapunov_equation() -> None:
    pull = close(insight.controller("lqg").system, make_puller(lam=0.5), DT).pick("v_p", ("camera",))
    found = noise_gains(insight.controller("lqg"), DT)
    assert found["pull_mm_per_min_per_mm"] == pytest.approx(root_mean_square(pull) / (MM_PER_MIN / MM), rel=2e-3)
    steps = root_mean_square(pull, difference=True) / (MM_PER_MIN / MM)
    assert found["pull_step_mm_per_min_per_mm"] == pytest.approx(steps, rel=2e-3)


def test_events_happen_when_and_as_large_as_they_are_said() -> None:
    config = crystal(30.0, Interface())
    quiet = CompensatedPID()
    interface, load, reference, noise = (run_events(quiet, config, t.events, [t.amplitude, 0.0]) for t in STEP_TESTS)
    at = round(600.0 / DT)
    for course in (interface, load):
        different = course.signals.v_g[:, 0] != course.signals.v_g[:, 1]
        assert not different[:at].any()
        assert different[at + 2 :].any()
    for course, amplitude in ((interface, 0.3), (load, 1.0)):
        first = course.env.get_state()[0].slot.slot
        assert (first["dT_i"] if course is interface else first["drift"]) == pytest.approx(amplitude)
    assert reference.signals.r_ref[-1, 0] < reference.signals.r_ref[at, 0]
    measured = noise.signals.r_br_measured - noise.signals.r_br
    assert np.std(measured[at + 1 : 2 * at - 1, 0]) == pytest.approx(0.05 * MM, rel=0.3)
    assert np.ptp(measured[2 * at + 2 :, 0]) == pytest.approx(0.0, abs=1e-12)


def test_survival_is_found_where_it_lies() -> None:
    lost = Limit("lost", "jump beyond the limit at once", "mm", MM, 16.0, LIMITS[0].event)
    found = survive(OpenLoop(), lost, Interface())
    assert 7.0 < found.least <= found.largest <= found.most <= 8.0
    assert not found.capped
    never = Limit("never", "nothing", "mm", MM, 4.0, Event(0.0, lambda slot, amplitude: None))
    assert survive(CompensatedPID(), never, Interface()) == Survival(4.0, 4.0, 4.0, True)


def test_the_real_puller_is_taken_apart_property_by_property() -> None:
    parts = parts_of(PULLER, RANDOMIZED)
    assert parts["latency"].sensor.latency == PULLER.sensor.latency
    assert parts["latency"].actuators == RANDOMIZED.actuators
    with pytest.raises(ValueError, match="'hard' differs from 'randomized' in more than melt loss"):
        parts_of(HARD, RANDOMIZED)


def test_a_linear_controller_answers_every_small_jump_alike_and_the_agent_none_of_the_larger_ones() -> None:
    paper, agent = (
        jump_gains(policy, interface, noisy=False)
        for policy, interface in ((CompensatedPID(), Interface()), (agents.OnnxPolicy.load(PATH), LEARNED))
    )
    assert paper[:5] == pytest.approx(np.full(5, paper[0]), rel=0.01)
    assert agent[0] == pytest.approx(agent[1], rel=0.02)
    assert agent[-1] < 0.5 * agent[0]


def test_a_linear_controller_answers_a_ripple_as_strongly_in_the_end_as_after_ten_minutes() -> None:
    found = ripple_answers(find_controller("paper-tuned").make(crystal(1.0, Interface())), Interface())
    assert found.shape == (SPANS,)
    assert found[1:] == pytest.approx(np.full(SPANS - 1, found[1]), rel=0.03)


@pytest.fixture(scope="module")
def answers() -> dict[str, dict[str, Any]]:
    config = crystal(21.0, Interface())
    policy = find_controller("paper-tuned").make(config)
    return {test.name: {"one": respond(policy, config, test)} for test in STEP_TESTS}


@pytest.fixture(scope="module")
def loop(near: Any) -> Any:
    one = Contender("one", LEARNED, lambda _: None, near)
    return one.loop(frequencies(DT, 60), 1.0, DT)


JUMPED = {"one": [np.ones(len(JUMPS)), np.ones(len(JUMPS))]}


@pytest.mark.slow
def test_pictures(answers: Any, loop: Any) -> None:
    for picture in (
        response_figure(answers, DT),
        gain_figure({"one": np.ones((5, 2))}, {"one": loop}, DT),
        jump_figure(JUMPED),
        ripple_figure({"one": np.ones(SPANS)}),
        loop_figure({"one": loop}, 0.02),
        share_figure(answers["load"], {"one": loop}, "load"),
    ):
        assert picture.startswith(b"\x89PNG")


def test_tables_say_what_was_found(answers: Any, loop: Any) -> None:
    margins = {"controller": "one", "plant": "Model I", "at": "v_p", "growth": np.inf}
    found = {
        "agent": asdict(read_agent(PATH)[0]),
        "answers": {name: {"one": answer_figures(by["one"])} for name, by in answers.items()},
        "margins": [margins | margins_of(loop.opened("v_p"), loop.omega, DT, False)._asdict()],
        "noise_gain": {"one": {"pull": 1.0, "step": 2.0, "heater": 3.0}},
        "apart": {"from": "two", "one": {"pull speed": (0.0, 0.01, 0.5, 2.0)}},
        "jumps": jump_figures(JUMPED),
        "ripples": ripple_figures({"one": np.ones(SPANS)}),
        "limits": {"one": {limit.name: Survival(1.5, 1.25, 2.0, True)._asdict() for limit in LIMITS}},
        "puller_parts": {
            "validation_episodes": 4,
            "one": {"latency": {"rmse_observable_mm": 0.1, "failure_rate": 0.25}},
        },
    }
    (row,) = json.loads(as_json(found))["margins"]
    assert (row["controller"], row["growth"], row["gain_up"]) == ("one", None, None)
    text = as_markdown(found)
    for line in (
        "| latency | 0.100 mm, 25 % lost |",
        "| one | 60.00 | 60.00 | 60.00 | 60.00 |",
        "| one | pull speed | 0 % | 1 % | 50 % | 200 % |",
        "| 1.5 (1.25 to over 2) |",
        "| - | - | - | - | - |",
    ):
        assert line in text


def test_gains_are_apart_from_others_and_not_from_themselves(near: Any) -> None:
    mine = Contender("one", LEARNED, lambda _: None, near)
    seen = np.where(np.arange(near.B.shape[1]) == AT[0], 2.0, 1.0)
    twice = mine._replace(system=near._replace(B=near.B * seen, D=near.D * seen))
    for other, deviation in ((mine, 0.0), (twice, 1.0)):
        for values in apart(other, mine, DT).values():
            assert values == pytest.approx([deviation] * 4, abs=1e-12)


def test_the_growth_of_a_loop_is_that_of_its_fastest_mode() -> None:
    grows, fades = np.exp(5.0 / 7200.0), np.exp(-5.0 / 60.0)
    loop = Loop(np.diag([fades, grows]), *[np.zeros((2, 2))] * 3, 5.0)
    assert loop.growth == pytest.approx(7200.0)
    assert not loop.stable
    calm = loop._replace(A=np.diag([fades, -0.5]))
    assert calm.growth == np.inf
    assert calm.stable
