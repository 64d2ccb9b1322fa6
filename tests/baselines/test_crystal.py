"""Controllers of a whole crystal: what the crown does to each, what they refuse, and that their models are right."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from cz_gym.baselines import crystal as along
from cz_gym.baselines.crystal import SIZES, START_SD, STATES, CrystalNoise, CrystalWeights, design, filtered
from cz_gym.baselines.tuned import by_scenario, with_values
from cz_gym.baselines.tuned_controllers import CRYSTALS
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.evaluation.metrics import crystal_metrics
from cz_gym.evaluation.protocol import TRAINING_SEEDS, Case
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.meniscus import HURLE
from cz_gym.tools.registry import CRYSTAL_CONTROLLERS, make_controller

CROWN = Case("crown", "randomized", "a crown", process=CRYSTAL, stage="crown")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least", "most", "error"),
    [
        ("ring-pid-reduced", 12, 12, 1.5),
        ("compensated", 12, 12, 1.0),
        ("lqg-along", 12, 12, 1.0),
        ("true-radius", 12, 12, 0.5),
    ],
)
def test_twelve_crowns(name, least, most, error):
    """The camera reads the crystal's edge where it shows no ring: none is lost."""
    (contender,) = (each for each in CRYSTAL_CONTROLLERS if each.name == name)
    config = CROWN.config(contender.observation)
    found = crystal_metrics(rollout(contender.make(config), config, TRAINING_SEEDS[:12]))
    assert least <= found.completed.sum() <= most
    assert np.median(found.crown_max_mm) < error
    assert (found.completed == 1.0 - found.lost_in_crown - found.lost_in_body).all()


@pytest.mark.slow
def test_without_the_edge_crowns_go_astray():
    """The camera shows no ring on two thirds of it."""
    config = CROWN.config("measured")
    made = make_controller("lqg-along", config)
    found = crystal_metrics(rollout(replace(made, sensors=("ring", "pyrometer")), config, TRAINING_SEEDS[:12]))
    assert np.median(found.crown_max_mm) > 2.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "puller", "least"),
    [("compensated", "germanium", 4), ("true-radius", "germanium", 6), ("lqg-along", "silicon-300mm", 6)],
)
def test_crowns_of_another_puller_with_settings_in_proportion(name, puller, least):
    """With the default puller's settings ``compensated`` loses all; ``lqg-along`` swings between the slew limits."""
    (contender,) = (each for each in CRYSTAL_CONTROLLERS if each.name == name)
    config = make_config(
        "randomized", observation=contender.observation, action="direct", process=CRYSTAL, puller=puller
    )
    found = crystal_metrics(rollout(contender.make(config), config, TRAINING_SEEDS[:6]))
    assert (found.failure_rate == 0.0).sum() >= least  # some are slow, and cut by the time


def test_settings_in_proportion_are_the_settings_for_the_default_puller():
    config = make_config("randomized", observation="measured", action="direct", process=CRYSTAL)
    for each in CRYSTALS:
        chosen = with_values(each.start, by_scenario(each.name)["randomized"])
        assert each.make(config) == chosen.for_config(config)


def test_regulator_is_stable_at_every_length():
    """Whatever the pull speed, the crystal's mass stays: the regulator leaves it alone."""
    at = design(make_config(process=CRYSTAL).parameters, HURLE, 5.0, 0.5, CrystalNoise(), CrystalWeights())
    acts = np.delete(np.arange(STATES + 2), STATES - 1)
    for A, B, _, _, F in zip(*at[1:], strict=True):
        loop = np.block([[A, np.zeros((STATES, 2))], [np.zeros((2, STATES + 2))]]) + np.vstack([B, np.eye(2)]) @ F
        assert not F[:, STATES - 1].any()
        assert np.abs(np.linalg.eigvals(loop[np.ix_(acts, acts)])).max() < 1.0


@pytest.mark.parametrize(("row", "read"), [(2, (0, 1, 2)), (8, (1, 2, 3)), (100, (0, 1, 2)), (8, (1, 2))])
def test_the_filter_s_covariance_settles_on_the_riccati_equation_s(row, read):
    """With ring, with edge, blind: what is not read has no gain; the observer is stable; scaled as the design is."""
    at = design(make_config(process=CRYSTAL).parameters, HURLE, 5.0, 0.5, CrystalNoise(), CrystalWeights())
    A, C, Q = at.A[row], at.C[row], at.Q[row]
    noise, reads = along.variances(CrystalNoise()), np.isin(np.arange(4), read)[None] * 1.0
    P = np.diag(START_SD**2)[None]
    for _ in range(6000):
        before = A @ P @ A.T + Q
        P, K, S = filtered(before, C[None], reads, noise)
    scale, told = 1.0 / SIZES[:STATES], C[list(read)] / np.sqrt(noise[list(read)])[:, None]
    moves = A * np.outer(scale, 1.0 / scale)
    exact = solve_discrete_are(moves.T, (told / scale).T, Q * np.outer(scale, scale), np.eye(len(read)))
    np.testing.assert_allclose(before[0] * np.outer(scale, scale), exact, rtol=1e-3, atol=1e-6 * np.abs(exact).max())
    assert not np.delete(K[0], read, axis=1).any()
    assert np.linalg.slogdet(S[0])[0] > 0


def test_a_controller_of_another_puller_acts_on_a_batch():
    germanium = make_config(process=CRYSTAL, puller="germanium", observation="measured", action="direct")
    made = make_controller("lqg-along", germanium)
    action, _ = made.predict(np.zeros((3, len(CRYSTAL.measured)), np.float32))
    assert action.shape == (3, 2)
    assert np.isfinite(action).all()


def test_ring_and_edge_take_turns_without_a_bump():
    """A constant difference of 2 mm between both readings moves the pull speed no more than one reading alone does."""
    config = make_config(process=CRYSTAL, observation="measured", action="direct", stage=0.02)
    made = make_controller("compensated", config)
    names = [each.name for each in CRYSTAL.measured]

    def pulls(by_edge, edge_error):
        seen = np.zeros((1, len(names)), np.float32)
        seen[0, names.index("L")] = 0.1
        memory, actions = None, []
        for edge in by_edge:
            seen[0, names.index("valid")], seen[0, names.index("edge_valid")] = 1.0 - edge, edge
            seen[0, names.index("edge_error")] = edge_error
            action, memory = made.predict(seen, memory)
            actions.append(action[0, 0])
        return np.array(actions)

    turns = np.r_[np.zeros(20), np.ones(20), np.zeros(20)]
    bumped, plain = pulls(turns, 2.0), pulls(np.zeros(60), 2.0)
    first, last = (np.abs(np.diff(bumped - plain))[at : at + 2].max() for at in (19, 39))
    assert max(first, last) < 0.1 * np.abs(pulls(np.ones(60), 2.0)[:3]).max()
