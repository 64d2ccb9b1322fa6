"""The design procedure against the paper's printed constants, partial fractions and the loop itself."""

import math

import numpy as np
import pytest
from scipy.signal import residue

from cz_gym import make_puller
from cz_gym.baselines.analysis.compensator_design import (
    NoSplitError,
    design_compensator,
    high_passed,
    ideal_compensator,
    margins,
    open_loop,
    split_stable,
)
from cz_gym.baselines.pid.compensated_pid import SeriesPID
from cz_gym.physics.linearisation import StateSpace, radius_model
from studies.paper.published import COMPENSATOR, MODEL_I, MODEL_II


def gain(system, s):
    A, B, C, D = system
    return (C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D)[0, 0]


def test_printed_compensator_to_five_digits():
    found = design_compensator(MODEL_I)
    assert f"{found.gain:.5f}" == "-0.22517"
    assert found.fast == pytest.approx(1.684e-3, rel=1e-9)
    assert found.slow == pytest.approx(2e-4, rel=1e-9)


def test_stable_part_against_partial_fractions():
    """G_pc G_hpf multiplied out by hand; its stable residues, put together again, give the numerator."""
    n, (p_0, p_1), lead, constant = MODEL_I
    numerator = -n * lead * np.poly([0.0, (1.0 - constant) / lead])
    residues, poles, _ = residue(numerator, np.poly([p_0, p_1, -2e-4]), tol=1e-9)
    stable = split_stable(high_passed(ideal_compensator(MODEL_I))).stable
    for s in (1e-4j, 2e-3j, 0.3j):
        expected = sum(r / (s - p) for r, p in zip(residues, poles, strict=True) if p.real < 0)
        assert gain(stable, s) == pytest.approx(expected, rel=1e-8)
    lead_of_stable = sum(r for r, p in zip(residues, poles, strict=True) if p.real < 0)
    assert design_compensator(MODEL_I).gain == pytest.approx(lead_of_stable.real, rel=1e-8)


@pytest.mark.parametrize(("stable", "unstable"), [(1, 1), (3, 2), (2, 5), (4, 0)])
@pytest.mark.parametrize("seed", range(3))
def test_split_adds_up(stable, unstable, seed):
    random = np.random.default_rng(seed)
    n = stable + unstable
    poles = np.concatenate([-random.uniform(0.1, 3.0, stable), random.uniform(0.0, 3.0, unstable)])
    basis = random.normal(size=(n, n)) + 2.0 * np.eye(n)
    A = basis @ np.diag(poles) @ np.linalg.inv(basis)
    system = StateSpace(A, random.normal(size=(n, 1)), random.normal(size=(1, n)), np.array([[0.7]]))
    parts = split_stable(system)
    assert len(parts.stable.A) == stable
    assert len(parts.unstable.A) == unstable
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(parts.stable.A).real), np.sort(poles[:stable]), rtol=1e-6)
    for s in (0.3j, 2.0j, 10.0j):
        assert sum(gain(part, s) for part in parts) == pytest.approx(gain(system, s), rel=1e-7)


def test_split_keeps_complex_pairs_together():
    A = np.array([[-0.1, 2.0, 1.0, 0.0], [-2.0, -0.1, 0.0, 1.0], [0.0, 0.0, 0.2, 3.0], [0.0, 0.0, -3.0, 0.2]])
    parts = split_stable(StateSpace(A, np.ones((4, 1)), np.ones((1, 4)), np.zeros((1, 1))))
    np.testing.assert_allclose(np.linalg.eigvals(parts.stable.A).real, -0.1, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.eigvals(parts.unstable.A).real, 0.2, rtol=1e-9)


def test_integrator_counts_as_unstable():
    parts = split_stable(StateSpace(np.diag([-1.0, 0.0]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1))))
    np.testing.assert_allclose(parts.unstable.A, [[0.0]], atol=1e-12)


def test_no_split_is_said_clearly():
    def diagonal(*poles):
        n = len(poles)
        return StateSpace(np.diag(poles), np.ones((n, 1)), np.ones((1, n)), np.zeros((1, 1)))

    with pytest.raises(NoSplitError, match="no stable part: every eigenvalue"):
        split_stable(diagonal(1.0, 2.0))
    with pytest.raises(NoSplitError, match="agree to"):
        split_stable(diagonal(-3e-13, 1e-20, 1.0))
    with pytest.raises(NoSplitError, match="no compensator comes of this plant"):
        design_compensator(MODEL_II)
    with pytest.raises(ValueError, match="cut_off must be a positive frequency"):
        design_compensator(MODEL_I, 0.0)


@pytest.mark.parametrize(("model", "crossover", "phase"), [(MODEL_I, 0.030, 79.0), (MODEL_II, 0.029, 76.0)])
def test_margins_of_the_published_loop(model, crossover, phase):
    """And the definition of a margin, evaluated by hand."""
    found = margins(model, COMPENSATOR)
    assert found.crossover == pytest.approx(crossover, abs=5e-4)
    assert found.phase_margin_deg == pytest.approx(phase, abs=0.5)
    s, pid = 1j * found.crossover, SeriesPID()
    K = pid.K_p * (pid.T_i * s + 1) * (pid.T_d * s + 1) / (pid.T_i * s * (1 + pid.T_d * s / pid.N))
    ring = model.numerator * (model.lead * s + model.constant) / ((s - model.poles[0]) * (s - model.poles[1]))
    L = -K * (ring + COMPENSATOR.gain * s / ((s + COMPENSATOR.fast) * (s + COMPENSATOR.slow)))
    assert abs(L) == pytest.approx(1.0, rel=1e-6)
    assert 180.0 + math.degrees(np.angle(L)) == pytest.approx(found.phase_margin_deg, abs=1e-4)


@pytest.mark.parametrize("model", [MODEL_I, MODEL_II, radius_model(make_puller(lam=0.0))])
def test_pid_needs_the_compensator(model):
    with_it, without = margins(model, COMPENSATOR), margins(model, None)
    assert with_it.stable
    assert not without.stable
    assert without.phase_margin_deg < 0
    loop = open_loop(model, COMPENSATOR)
    fast = [pole for pole in with_it.poles if abs(pole) > 1e-2]
    assert len(fast) == 2
    for pole in fast:
        assert loop(pole) == pytest.approx(-1.0, abs=1e-6)
