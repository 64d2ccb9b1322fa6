"""Controllers of a whole crystal: what the crown does to each, what they refuse, and that their models are right."""

import numpy as np
import pytest

from cz_gym.baselines.crystal import STATES, CrystalNoise, CrystalWeights, design, without_ring
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
        ("ring-pid-reduced", 10, 12, 6.0),
        ("compensated", 10, 12, 3.0),
        ("lqg-along", 12, 12, 2.5),
        ("true-radius", 12, 12, 1.0),
    ],
)
def test_twelve_crowns(name, least, most, error):
    """Who knows the meniscus, or is slow in the cones, grows nearly all."""
    (contender,) = (each for each in CRYSTAL_CONTROLLERS if each.name == name)
    config = CROWN.config(contender.observation)
    found = crystal_metrics(rollout(contender.make(config), config, TRAINING_SEEDS[:12]))
    assert least <= found.completed.sum() <= most
    assert np.median(found.crown_max_mm) < error
    assert (found.completed == 1.0 - found.lost_in_crown - found.lost_in_body).all()


@pytest.mark.slow
def test_the_ring_freezes_a_pid_with_the_body_s_gains():
    (contender,) = (each for each in CRYSTAL_CONTROLLERS if each.name == "ring-pid")
    found = crystal_metrics(rollout(contender.make(CROWN.config("measured")), CROWN.config("measured"), range(12)))
    assert found.frozen.all()
    assert found.lost_in_crown.all()


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


def test_filter_and_regulator_are_stable_at_every_length():
    """Whatever the pull speed, the crystal's mass stays: the regulator leaves it alone."""
    at = design(make_config(process=CRYSTAL).parameters, HURLE, 5.0, 0.5, CrystalNoise(), CrystalWeights())
    for A, B, C, K, F, _ in zip(*at[1:], strict=True):
        told = np.eye(STATES) - K @ C
        loop = np.block([[A, np.zeros((STATES, 2))], [np.zeros((2, STATES + 2))]]) + np.vstack([B, np.eye(2)]) @ F
        assert not F[:, STATES - 1].any()
        acts = np.delete(np.arange(STATES + 2), STATES - 1)
        assert max(np.abs(np.linalg.eigvals(part)).max() for part in (told @ A, loop[np.ix_(acts, acts)])) < 1.0


def test_without_the_ring_the_other_sensors_have_gains_of_their_own():
    """Those of a filter with the same covariance of the state that never had a camera."""
    at = design(make_config(process=CRYSTAL).parameters, HURLE, 5.0, 0.5, CrystalNoise(), CrystalWeights())
    gain, known = without_ring(at.K, at.S)
    covariance = np.linalg.inv(at.S)
    PC = at.K @ covariance
    for row in (0, 100, 255):
        expected = PC[row][:, 1:] @ np.linalg.inv(covariance[row, 1:, 1:])
        np.testing.assert_allclose(gain[row], np.column_stack([np.zeros(STATES), expected]), rtol=1e-9, atol=1e-18)
        assert np.linalg.slogdet(known[row])[1] == pytest.approx(-np.linalg.slogdet(covariance[row, 1:, 1:])[1])


def test_a_controller_of_another_puller_acts_on_a_batch():
    germanium = make_config(process=CRYSTAL, puller="germanium", observation="measured", action="direct")
    made = make_controller("lqg-along", germanium)
    action, _ = made.predict(np.zeros((3, len(CRYSTAL.measured)), np.float32))
    assert action.shape == (3, 2)
    assert np.isfinite(action).all()
