"""Datasets for offline learning, in Minari's format: ``python -m cz_gym.datasets`` (extra ``data``).

Every policy is recorded alike: "history" observations, "direct" actions, the reward, and radius and true state as info.
So datasets of different policies can be joined, and an episode can be made again from its seed and its actions.
"""

from __future__ import annotations

import argparse
import os
import pkgutil
import shutil
import sys
import time
import warnings
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

import cz_gym
from cz_gym.atomic_files import check_writable
from cz_gym.commands import OneLineParser, between
from cz_gym.config import Config, check_config, make_config
from cz_gym.errors import CzError
from cz_gym.evaluation.protocol import TRAINING_SEEDS
from cz_gym.names import unknown
from cz_gym.observation import DRIVE_CHANNELS, to_measured
from cz_gym.task import drives_of
from cz_gym.vector import CzVectorEnv

CONTROLLERS, AGENTS = "cz_gym.baselines.registry:CONTROLLERS", "cz_gym.agents:load"
"""Where policies come from: looked up by name, since this package imports none."""
EPISODES, NOISE = 100, 0.2
AT_ONCE = 100
"""Episodes that run in one batch."""
STREAM = 1
"""Keeps the random numbers of the excitation apart from those of the crystal with the same seed."""
CODE = "https://github.com/cz-gym/cz-gym"


def find_policy(name: str, config: Config) -> Any:
    """The controller or shipped agent of that name for a config; CzError names what there is."""
    controllers = {entry.name: entry for entry in pkgutil.resolve_name(CONTROLLERS) if not entry.privileged}
    check_config(config)
    if name in controllers:
        return controllers[name].make(config)
    load = pkgutil.resolve_name(AGENTS)
    try:
        settings = settings_of(load(name))
    except ValueError as error:
        raise CzError(unknown("policy", name, controllers, f"; or an agent: {error}")) from None
    return load(name, replace(config, **settings))


def settings_of(policy: Any) -> dict[str, Any]:
    """The observation that a policy reads and what its actions mean; "measured" and "direct" where it does not say."""
    told = {"observation": "measured", "action": "direct"} | getattr(policy, "settings", {})
    return {name: told[name] for name in ("observation", "action")}


def excitation(seed: int, config: Config, noise: float) -> tuple[float, npt.NDArray[np.float64]]:
    """Noise on the drives of one episode: its level [-], and its course in "direct" actions, shape (steps, 2).

    White noise on a "smooth" action, which the lags of 50 s make slow. Its standard deviation, the level, is uniform
    between 0 and ``noise``: a dataset has quiet and excited episodes.
    """
    random, drives = np.random.default_rng([seed, STREAM]), drives_of("smooth", config.control_interval)
    level = noise * random.uniform()
    white = level * random.standard_normal((config.steps, 2)) * np.array([drives.pull, drives.heater])
    return level, lfilter([1.0], [1.0, -drives.keep], white, axis=0)


def record(policy: Any, config: Config, seeds: Sequence[int], noise: float) -> list[dict[str, Any]]:
    """One episode a seed, all in one batch: the fields of Minari's ``EpisodeBuffer``, each up to the episode's end."""
    settings, n = settings_of(policy), len(seeds)
    drives = drives_of(settings["action"], config.control_interval)
    gains, place = np.array([drives.pull, drives.heater]), list(DRIVE_CHANNELS)
    added = np.stack([excitation(seed, config, noise)[1] for seed in seeds], axis=1)
    begins, over, memory, before = np.ones(n, np.bool_), np.zeros(n, np.bool_), None, np.zeros((n, 2))
    with closing(CzVectorEnv.from_config(config, n)) as env:
        observation, info = env.reset(seed=list(seeds))
        seen, taken = [(observation, info["r_c"], info["r_ref"], info["state"])], []
        for noise_now in added:
            measured = settings["observation"] == "measured"
            shown = to_measured(observation, config.parameters.v_0) if measured else observation
            found, memory = policy.predict(shown, state=memory, episode_start=begins, deterministic=True)
            # An action that moves the drives moves them from where the policy alone would have them.
            wanted = drives.keep * (observation[:, place] - before) + gains * found
            action = np.clip(wanted + noise_now, -1.0, 1.0).astype(np.float32)
            observation, reward, terminated, truncated, info = env.step(action)
            seen.append((observation, info["r_c"], info["r_ref"], info["state"]))
            taken.append((action, reward, terminated, truncated))
            # A slot that is over is drawn anew by the next step: only then does its policy begin again.
            begins, over, before = over, terminated | truncated, noise_now
    observations, r_c, r_ref, state = map(np.stack, zip(*seen, strict=True))
    actions, rewards, terminations, truncations = map(np.stack, zip(*taken, strict=True))
    lengths = (terminations | truncations).argmax(axis=0) + 1
    return [
        {
            "seed": seed,
            "observations": observations[: m + 1, i],
            "actions": actions[:m, i],
            "rewards": rewards[:m, i],
            "terminations": terminations[:m, i],
            "truncations": truncations[:m, i],
            "infos": {"r_c": r_c[: m + 1, i], "r_ref": r_ref[: m + 1, i], "state": state[: m + 1, i]},
        }
        for i, (seed, m) in enumerate(zip(seeds, lengths.tolist(), strict=True))
    ]


def write(
    name: str,
    policy: Any,
    scenario: str = "randomized",
    seeds: Sequence[int] = TRAINING_SEEDS[:EPISODES],
    noise: float = NOISE,
    horizon: float = 10800.0,
    overwrite: bool = False,
) -> Any:
    """Write the Minari dataset ``cz/<scenario>/<name>-v0`` and return it; a dot in a name becomes "_".

    ValueError for seeds that are no training seeds, and for a dataset that is there. An error or Ctrl-C leaves none.
    """
    minari, _ = import_module("minari"), import_module("h5py")
    settings: dict[str, Any] = {"scenario": scenario, "observation": "history", "horizon": horizon}
    config, place = make_config(**settings), f"cz/{scenario}/{name.replace('.', '_')}-v0"
    if not seeds or not set(seeds) <= set(TRAINING_SEEDS):
        raise CzError(f"seeds must be some of the training seeds, {TRAINING_SEEDS[0]} to {TRAINING_SEEDS[-1]}")
    if not 0.0 <= noise <= 1.0:
        raise CzError(f"noise must be between 0 and 1, not {noise:g}")
    folder = Path(os.environ.get("MINARI_DATASETS_PATH", "~/.minari/datasets")).expanduser() / place
    check_writable(folder)
    if folder.exists() and not overwrite:
        raise CzError(f"{place} is there already: overwrite it, or give another folder ({folder})")

    def buffers(first: int) -> list[Any]:
        episodes = record(policy, config, seeds[first : first + AT_ONCE], noise)
        return [minari.data_collector.EpisodeBuffer(**episode) for episode in episodes]

    begun = buffers(0)
    shutil.rmtree(folder, ignore_errors=True)
    try:
        with closing(gym.make(cz_gym.ENV_ID, **settings)) as env, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # author and address are the user's own to give
            facts = {"algorithm_name": name, "code_permalink": CODE, "description": f"{name} on {scenario}, excited"}
            dataset = minari.create_dataset_from_buffers(place, begun, env, env, **facts)
        for first in range(AT_ONCE, len(seeds), AT_ONCE):
            dataset.update_dataset_from_buffer(buffers(first))
        dataset.storage.update_episode_metadata([{"excitation": excitation(i, config, noise)[0]} for i in seeds])
        dataset.storage.update_metadata({"cz_gym_version": cz_gym.__version__, "plant_hash": config.plant_hash})
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return dataset


def main(argv: list[str] | None = None) -> int:
    """Write datasets and say a line of each; 0 when done, 2 for bad input, 130 when interrupted."""
    about = "Write Minari datasets of policies on training crystals, with noise on their drives."
    parser = OneLineParser("python -m cz_gym.datasets", about)
    add, policies = parser.add_argument, "paper,paper-tuned,lqg-at-0.02,gradient"
    add("--policies", default=policies, metavar="NAMES", help="controllers and shipped agents (%(default)s)")
    add("--scenarios", default="randomized,sensor-fault", metavar="NAMES", help="(%(default)s)")
    add("--episodes", type=between(1, len(TRAINING_SEEDS)), default=EPISODES, metavar="N", help="of each (%(default)s)")
    add("--noise", type=float, default=NOISE, metavar="X", help="highest level of the excitation (%(default)s)")
    add("--out", type=Path, metavar="FOLDER", help="instead of $MINARI_DATASETS_PATH or ~/.minari/datasets")
    add("--overwrite", action="store_true", help="write again what is there already")
    return parser.run(_write_all, argv, "data", "the datasets named above are complete")


def _write_all(given: argparse.Namespace) -> None:
    if given.out is not None:
        os.environ["MINARI_DATASETS_PATH"] = str(given.out.resolve())
    chosen = [
        (name, find_policy(name, make_config(scenario, observation="history")), scenario)
        for scenario in given.scenarios.split(",")
        for name in given.policies.split(",")
    ]
    for each in chosen:
        began = time.perf_counter()
        dataset = write(*each, TRAINING_SEEDS[: given.episodes], given.noise, overwrite=given.overwrite)
        said = f"{dataset.id}: {dataset.total_episodes} episodes, {dataset.total_steps:,} steps, "
        print(f"{said}{dataset.storage.get_size():.0f} MB, {time.perf_counter() - began:.1f} s", flush=True)


if __name__ == "__main__":
    sys.exit(main())
