"""Datasets: stock Minari reads them, each episode can be made again, and what is wrong is said in one line."""

from functools import cache

import minari
import numpy as np
import pytest

from cz_gym.baselines import CompensatedPID
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import TRAINING_SEEDS, VALIDATION_SEEDS
from cz_gym.evaluation.rollout import Playback, rollout
from cz_gym.puller.file import DEFAULT, find_puller
from cz_gym.spaces import DRIVE_CHANNELS
from cz_gym.tools import datasets
from cz_gym.tools.datasets import dataset_id, excitation, find_policy, main, modes_of, record, write

CONFIG = make_config("randomized", action="direct", horizon=1200.0)


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "data"))
    monkeypatch.setattr(datasets, "VALIDATION_SEEDS", VALIDATION_SEEDS[:1])  # of the scores: 100 take 16 s
    return tmp_path / "data"


def again(dataset, episode):
    """Make an episode again, from its seed and its actions: everything is the same."""
    (facts,) = dataset.storage.get_episode_metadata([episode])
    kept, env = dataset[episode], dataset.recover_environment(info="all")
    observation, info = env.reset(seed=facts["seed"])
    for k in range(len(kept) + 1):
        np.testing.assert_array_equal(observation, kept.observations[k])
        assert all(np.array_equal(info[name], kept.infos[name][k]) for name in ("r_c", "r_ref", "state"))
        if k < len(kept):
            observation, *ends, info = env.step(kept.actions[k])
            assert ends == [kept.rewards[k], kept.terminations[k], kept.truncations[k]]
    env.close()


def test_an_episode_can_be_made_again_from_its_seed_and_actions(place, monkeypatch):
    monkeypatch.setattr(datasets, "AT_ONCE", 2)
    write("lqg-at-0.02", find_policy("lqg-at-0.02", CONFIG), "sensor-fault", TRAINING_SEEDS[7:10], horizon=600.0)
    dataset = minari.load_dataset("cz/sensor-fault/lqg-at-0_02-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (3, 360)
    facts = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
    assert [each["seed"] for each in facts] == [7, 8, 9]
    assert [each["excitation"] for each in facts] == [excitation(seed, CONFIG, 0.2)[0] for seed in (7, 8, 9)]
    for episode in range(3):
        again(dataset, episode)
    assert minari.list_local_datasets()["cz/sensor-fault/lqg-at-0_02-v0"]["algorithm_name"] == "lqg-at-0.02"


def test_a_set_of_another_puller_gives_that_puller_back(place):
    """Minari #131, Gymnasium #439: the settings in a set are JSON, which holds no PullerFile and no Path."""
    puller = find_puller("germanium")
    write("paper", CompensatedPID(), "puller", TRAINING_SEEDS[:1], horizon=300.0, puller=puller)
    dataset = minari.load_dataset("cz/germanium/puller/paper-v0")
    assert dataset.recover_environment().unwrapped.config.puller == puller
    again(dataset, 0)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("lqg-at-0.02", "cz/hard/lqg-at-0_02-v0"),
        ("runs/mine/agent.onnx", "cz/hard/mine-v0"),
        ("runs/ppo/seed3/agent.onnx", "cz/hard/ppo-seed3-v0"),
        ("runs/mine/größte ppo.onnx", "cz/hard/gr_te_ppo-v0"),
    ],
)
def test_names_are_what_minari_takes(name, expected):
    assert dataset_id(name, "hard", DEFAULT) == expected


@pytest.mark.slow
def test_named_sets_have_failures_and_scores_and_the_same_bytes_twice(tmp_path, place):
    command = ["--policies", "random,mixed,operator", "--episodes", "4", "--out"]
    bytes_of = []
    for folder in (tmp_path / "one", tmp_path / "two"):
        assert main([*command, str(folder)]) == 0
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        bytes_of.append([(str(path.relative_to(folder)), path.read_bytes()) for path in files])
    assert bytes_of[0] == bytes_of[1]
    assert len(bytes_of[0]) == 8, "of each set two files, and one of each of the two folders above them"
    sets = {name: minari.load_dataset(f"cz/randomized/{name}-v0") for name in ("random", "mixed", "operator")}
    ends = {name: [each.terminations[-1] for each in some.iterate_episodes()] for name, some in sets.items()}
    assert all(ends["random"])
    assert not any(ends["operator"])
    assert list(ends["mixed"][:2]) == [False, False]
    assert ends["mixed"][3]
    again(sets["mixed"], 3)
    drives = next(iter(sets["operator"].iterate_episodes())).observations[:, list(DRIVE_CHANNELS)]
    assert len(np.unique(np.sign(np.diff(drives[:24, 0])))) > 1
    scores = sets["mixed"].storage.metadata
    low, high = scores["ref_min_score"], scores["ref_max_score"]
    np.testing.assert_allclose(minari.get_normalized_score(sets["mixed"], np.array([low, high])), [0.0, 1.0])
    facts = sets["mixed"].storage.get_episode_metadata(range(4))
    assert [each["excitation"] > 0.0 for each in facts] == [True, True, True, False]


def test_without_a_home_a_folder_is_asked_for(monkeypatch, refused):
    for name in ("HOME", "MINARI_DATASETS_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    assert "name another one with --out" in refused(main, ["--policies", "paper", "--episodes", "1"])


def test_a_lost_crystal_ends_its_episode(place):
    """A policy that pulls at full speed loses each crystal."""
    dataset = write("fast", Playback([[1.0, 0.0]]), seeds=TRAINING_SEEDS[:2], horizon=3600.0)
    for episode, kept in enumerate(dataset.iterate_episodes()):
        assert kept.terminations.tolist() == [False] * (len(kept) - 1) + [True]
        assert not kept.truncations.any()
        assert len(kept) < 720
        assert kept.rewards[-1] < -999.0
        again(dataset, episode)


@pytest.mark.parametrize("name", ["paper-tuned", "gradient", "ppo"])
def test_without_excitation_a_policy_acts_as_in_the_benchmark(name):
    """Observations and actions are "measured" and "direct", "measured" and "rate", "history" and "smooth"."""
    policy, seeds = find_policy(name, CONFIG), TRAINING_SEEDS[:3]
    own = make_config("randomized", horizon=CONFIG.horizon, **modes_of(policy))
    expected = rollout(policy, own, seeds).signals.r_c
    found = np.stack([each["infos"]["r_c"][1:] for each in record(policy, CONFIG, seeds, 0.0)], axis=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-7)  # 0.2 um


@pytest.mark.parametrize("name", ["paper-tuned", "gradient"])
def test_excitation_neither_piles_up_nor_depends_on_the_batch(name):
    policy = find_policy(name, CONFIG)
    quiet, several = (record(policy, CONFIG, TRAINING_SEEDS[:4], noise) for noise in (0.0, 0.2))
    (alone,) = record(policy, CONFIG, TRAINING_SEEDS[3:4], 0.2)
    np.testing.assert_allclose(alone["actions"], several[3]["actions"], atol=1e-6)
    assert all(each["truncations"][-1] for each in several)
    pulls = [np.array([each["actions"][:, 0] for each in some]) for some in (quiet, several)]
    early, late = (half.std() for half in np.split(pulls[1] - pulls[0], 2, axis=1))
    assert 0.01 < early < 0.1, "what the noise moves, half its level at most"
    assert late < 1.5 * early, "a sum of noise would grow by more"


def test_excitation_is_a_smooth_action_of_white_noise():
    """Its lag-one correlation is the drives' lag, its spread that of a first-order process."""
    config = make_config("randomized", action="direct", horizon=500_000.0)
    level, noise = excitation(3, config, 0.5)
    keep = np.exp(-5.0 / 50.0)
    assert 0.0 < level < 0.5
    assert level == excitation(3, config, 0.5)[0] != excitation(4, config, 0.5)[0]
    spread = level * (1 - keep) / np.sqrt(1 - keep**2) * np.array([1, 0.5])
    np.testing.assert_allclose(np.std(noise, axis=0), spread, rtol=0.05)
    assert np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1] == pytest.approx(keep, abs=0.01)
    assert not excitation(3, config, 0.0)[1].any()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--policies", "papper"], "unknown policy 'papper': did you mean 'paper'?"),
        (["--policies", "lqg-true"], "unknown policy 'lqg-true'"),
        (["--scenarios", "randomised"], "unknown scenario 'randomised'"),
        (["--noise", "-1"], "noise must be between 0 and 1, not -1"),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing(options, said, refused, place):
    assert said in refused(main, ["--policies", "paper", *options, "--out", str(place)])
    assert not place.exists()


@pytest.mark.parametrize("seeds", [[], [-1], [0, 1_000_000], VALIDATION_SEEDS[:1]])
def test_only_training_seeds_are_recorded(seeds):
    with pytest.raises(ValueError, match="training seeds, 0 to 999999"):
        write("paper", CompensatedPID(), seeds=seeds)
    assert not set(VALIDATION_SEEDS) & set(TRAINING_SEEDS)


@pytest.mark.slow
def test_a_dataset_is_replaced_only_when_asked_for_and_never_left_half(place, monkeypatch, capsys):
    monkeypatch.setattr(datasets, "reference_scores", cache(datasets.reference_scores))
    command = ["--policies", "paper", "--scenarios", "nominal", "--episodes", "1", "--out", str(place)]
    assert main(command) == 0
    assert "cz/nominal/paper-v0: 1 episodes, 2,160 steps" in capsys.readouterr().out
    assert main(command) == 2
    assert capsys.readouterr().err.count("cz/nominal/paper-v0 exists in ") == 1
    assert main([*command, "--overwrite"]) == 0

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(datasets, "excitation", interrupted)
    assert main([*command, "--overwrite"]) == 130  # before the first write: what was there stays
    assert len(minari.load_dataset("cz/nominal/paper-v0")) == 1
    monkeypatch.setattr(datasets, "record", lambda *_: [])
    assert main([*command, "--overwrite"]) == 130  # after it
    assert minari.list_local_datasets() == {}
