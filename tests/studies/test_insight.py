"""How an agent reacts: derivatives against simulation, events as described, limits where they lie."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("control")
pytest.importorskip("onnx")

from cz_gym import agents
from cz_gym.agents.agent_file.contract import read_agent
from cz_gym.baselines import CompensatedPID, OpenLoop
from cz_gym.baselines.analysis.sampled_loop import Loop, close, sampled_plant
from cz_gym.episodes.scenarios import HARD, PULLER, RANDOMIZED
from cz_gym.physics.plant import make_puller
from cz_gym.units import MINUTE, MM
from studies.insight import __main__ as insight
from studies.insight import figures, report
from studies.insight.linear_agent import jacobian
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
    ripple_gains,
    run_events,
    survive,
)

DT = 5.0


@pytest.fixture(scope="module")
def gradient() -> insight.Contender:
    return insight.learned(agents.shipped("gradient"))


@pytest.fixture(scope="module")
def tuned() -> insight.Contender:
    return insight.classical("paper-tuned")


def test_a_linear_agent_moves_as_the_agent_does_after_a_small_jump(gradient: insight.Contender) -> None:
    """The linear loop of agent and plant against the simulated one: radius 1 um too large, first ten minutes.

    Without noise, two hours later, the agent's filter takes so small a jump for an outlier.
    """
    config = crystal(100.0, gradient.interface)
    jump, late = 0.001 * MM, LIMITS[0].event._replace(at=90.0 * MINUTE)
    with_it, without = (run_events(gradient.policy, config, (late,), [size]).signals for size in (jump, 0.0))
    moved = (with_it.v_p - without.v_p)[round(late.at / DT) :, 0]
    loop = close(gradient.systems[" at rest"], make_puller(lam=0.5), DT)
    x, expected = np.zeros(len(loop.A)), [0.0]  # the sample of the jump itself was taken before it
    x[:5] = jump * sampled_plant(make_puller(lam=0.5), DT).A[:, 0]
    for _ in moved[1:]:
        expected.append(loop.C[0] @ x)
        x = loop.A @ x
    assert moved == pytest.approx(np.array(expected), abs=0.03 * np.abs(expected).max())


def test_an_agent_without_a_memory_is_refused() -> None:
    _, content = read_agent(agents.shipped("ppo"))
    with pytest.raises(ValueError, match="a state of their own"):
        jacobian(content, np.zeros((1, 72)), np.zeros((1, 0)))


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


def test_a_linear_controller_answers_all_small_jumps_alike_and_the_agent_large_ones_less(
    gradient: insight.Contender,
) -> None:
    paper, agent = (
        jump_gains(policy, interface, noisy=False)
        for policy, interface in ((CompensatedPID(), Interface()), (gradient.policy, gradient.interface))
    )
    assert paper[:5] == pytest.approx(np.full(5, paper[0]), rel=0.01)
    assert agent[0] == pytest.approx(agent[1], rel=0.02)
    assert agent[-1] < 0.5 * agent[0]


def test_a_linear_controller_answers_a_ripple_as_strongly_in_the_end_as_after_ten_minutes(
    tuned: insight.Contender,
) -> None:
    found = ripple_gains(tuned.policy, tuned.interface)
    assert found[1:] == pytest.approx(np.full(SPANS - 1, found[1]), rel=0.03)


def test_tables_and_figures_show_what_was_measured(tuned: insight.Contender) -> None:
    answers = {test: {"one": respond(tuned.policy, crystal(21.0, Interface()), test)} for test in STEP_TESTS}
    jumps = {"one": {noise: np.full(len(JUMPS), 0.5) for noise in ("none", "usual")}}
    ripples = {"one": np.ones(SPANS)}
    for text, shown in (
        (report.answers(answers), "| interface 0.3 K hotter | one |"),
        (report.jumps(jumps), "| one | usual | 30.00 |"),
        (report.ripples(ripples), "| one | 60.00 | 60.00 | 60.00 | 60.00 |"),
        (
            report.margins({"one": tuned.systems[""]}),
            "| one | Model II | camera | yes | 0.00987 | 1.76 | 0.212 | 21.4 |",
        ),
        (report.limits({"one": [Survival(1.5, 1.25, 2.0, True)] * len(LIMITS)}), "| 1.5 (1.25 to over 2) |"),
        (report.parts({"one": {"latency": (0.1, 0.25)}}), "| latency | 0.100 mm, 25 % lost |"),
    ):
        assert shown in text
    for picture in (
        figures.response_figure(answers),
        figures.jump_figure(jumps),
        figures.ripple_figure(ripples),
    ):
        assert picture.startswith(b"\x89PNG")


def test_the_growth_of_a_loop_is_that_of_its_fastest_mode() -> None:
    grows, fades = np.exp(5.0 / 7200.0), np.exp(-5.0 / 60.0)
    loop: Any = Loop(np.diag([fades, grows]), *[np.zeros((2, 2))] * 3, 5.0)
    assert loop.growth == pytest.approx(7200.0)
    assert not loop.stable
    calm = loop._replace(A=np.diag([fades, -0.5]))
    assert calm.growth == np.inf
    assert calm.stable
