"""Datasets for offline learning, in Minari's format: ``cz-gym data`` (extra ``data``).

All policies are recorded in one form: "history" observations, "direct" actions, rewards, and as info the radius and
the true state. Datasets of different policies can therefore be joined, and seed and actions reproduce an episode.
"""

import argparse
import os
import re
import shutil
import time
import warnings
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from functools import lru_cache, partial
from importlib import import_module
from itertools import repeat
from pathlib import Path
from types import MappingProxyType
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

import cz_gym
from cz_gym import agents
from cz_gym.config import Config, check_config, make_config
from cz_gym.env import CzVectorEnv
from cz_gym.evaluation.parallel import run_parallel
from cz_gym.evaluation.protocol import TRAINING_SEEDS, VALIDATION_SEEDS
from cz_gym.evaluation.rollout import informed, rollout, settings_of
from cz_gym.puller.file import DEFAULT, PullerFile, chosen_puller, to_toml
from cz_gym.spaces import DRIVE_CHANNELS, drives_of, to_measured
from cz_gym.support.command_line import OneLineParser, between, names
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.files import check_writable
from cz_gym.tools.identify.moves import Excited
from cz_gym.tools.registry import CONTROLLERS

EPISODES, NOISE = 100, 0.2
"""Default number of episodes, and default highest level of the excitation [-]."""
AT_ONCE = 100
"""Number of episodes in one batch."""
OWN = "random", "operator", "mixed"
"""Names of policies that only datasets have."""
MIXED = "paper", "lqg", "pid-uncompensated", "random"
"""Policies that take turns in the set "mixed"; the last two lose crystals."""
EXCITATION_STREAM, RANDOM_STREAM = 1, 2
"""Random streams of the excitation and of random actions, separate from those of the crystal with the same seed."""
CODE = "https://github.com/cz-gym/cz-gym"


class Random:
    """Policy of uniform random "smooth" actions; each crystal's seed gives its own."""

    settings = MappingProxyType({"action": "smooth"})

    def __init__(self, seeds: Sequence[int] = ()) -> None:
        self.streams = [np.random.default_rng([seed, RANDOM_STREAM]) for seed in seeds]

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> "Random":
        """Return the policy for one episode a seed."""
        return Random(seeds)

    def predict(self, observation: Any, state: Any = None, **_: Any) -> tuple[Any, Any]:
        """Return actions, shape (episodes, 2)."""
        return np.array([stream.uniform(-1.0, 1.0, 2) for stream in self.streams], np.float32), state


def find_policy(name: str, config: Config) -> Any:
    """Make the policy of that name for a config; a tuple of several for "mixed". CzError lists the known names.

    Names are those of controllers and shipped agents, an agent's file, "random", and "operator": a PID with small moves
    of the drives on top, as an operator's log for identification has them.
    """
    controllers = {entry.name: entry for entry in CONTROLLERS if not entry.privileged}
    check_config(config)
    if name in controllers:
        return controllers[name].make(config)
    if name == "random":
        return Random()
    if name == "operator":
        return Excited(find_policy("paper", config))
    if name == "mixed":
        return tuple(find_policy(each, config) for each in MIXED)
    try:
        settings = modes_of(agents.load(name))
    except ValueError as error:
        raise CzError(unknown_name_message("policy", name, [*controllers, *OWN], f"; or an agent: {error}")) from None
    return agents.load(name, replace(config, **settings))


@lru_cache(maxsize=8)
def reference_scores(config: Config) -> dict[str, float]:
    """Minari's ``ref_min_score`` and ``ref_max_score``: mean returns of open loop and of the best classical controller.

    The crystals are the first 100 of validation; the controllers are those that reports quote.
    """
    chosen = [each for each in CONTROLLERS if each.name == "open-loop" or (each.quoted and not each.bound)]
    runs = [rollout(each.make(config), config, VALIDATION_SEEDS[:100]) for each in chosen]
    means = [float(run.reward.sum(axis=0).mean()) for run in runs]
    return {"ref_min_score": means[0], "ref_max_score": max(means)}


def modes_of(policy: Any) -> dict[str, Any]:
    """Environment settings "observation" and "action" of a policy; by default "measured" and "direct"."""
    settings = {"observation": "measured", "action": "direct"} | settings_of(policy)
    return {name: settings[name] for name in ("observation", "action")}


def highest_noise(policy: Any, noise: float) -> float:
    """Highest level of the excitation [-] of a policy: 0 for one that moves the drives by itself, else ``noise``."""
    return 0.0 if isinstance(policy, Random | Excited) else noise


def excitation(seed: int, config: Config, noise: float) -> tuple[float, npt.NDArray[np.float64]]:
    """Draw the noise that excites the drives in one episode: its level [-], and "direct" actions of shape (steps, 2).

    They are white noise passed through the lags of "smooth" actions (50 s). The level is the white noise's standard
    deviation, drawn uniformly between 0 and ``noise``, so that a dataset has quiet and excited episodes.
    """
    random, drives = np.random.default_rng([seed, EXCITATION_STREAM]), drives_of("smooth", config.control_interval)
    level = noise * random.uniform()
    white = level * random.standard_normal((config.steps, 2)) * np.array([drives.pull, drives.heater])
    return level, lfilter([1.0], [1.0, -drives.keep], white, axis=0)


def record(policy: Any, config: Config, seeds: Sequence[int], noise: float) -> list[dict[str, Any]]:
    """Run one episode a seed, all in one batch; return the fields of Minari's ``EpisodeBuffer`` for each episode.

    The policies of a tuple take turns from seed to seed.
    """
    if isinstance(policy, tuple):
        turns = [[seed for seed in seeds if policy[seed % len(policy)] is each] for each in policy]
        parts = [record(each, config, turn, noise) for each, turn in zip(policy, turns, strict=True) if turn]
        return sorted((episode for part in parts for episode in part), key=lambda each: seeds.index(each["seed"]))
    settings, n, noise = modes_of(policy), len(seeds), highest_noise(policy, noise)
    policy = informed(policy, config, seeds)
    drives = drives_of(settings["action"], config.control_interval, config.heater_range)
    gains, place = np.array([drives.pull, drives.heater]), list(DRIVE_CHANNELS)
    added = np.stack([excitation(seed, config, noise)[1] for seed in seeds], axis=1)
    begins, over, memory, before = np.ones(n, np.bool_), np.zeros(n, np.bool_), None, np.zeros((n, 2))
    with closing(CzVectorEnv.from_config(config, n, info="all")) as env:
        observation, info = env.reset(seed=list(seeds))
        seen, taken = [(observation, info["r_c"], info["r_ref"], info["state"])], []
        for noise_now in added:
            measured = settings["observation"] == "measured"
            shown = to_measured(observation, *config.ranges) if measured else observation
            chosen, memory = policy.predict(shown, state=memory, episode_start=begins, deterministic=True)
            # "smooth" and "rate" actions act on the drives without the excitation of the step before.
            wanted = drives.keep * (observation[:, place] - before) + gains * chosen
            action = np.clip(wanted + noise_now, -1.0, 1.0).astype(np.float32)
            observation, reward, terminated, truncated, info = env.step(action)
            seen.append((observation, info["r_c"], info["r_ref"], info["state"]))
            taken.append((action, reward, terminated, truncated))
            # A slot whose episode has ended is reset by the next step; its policy restarts there.
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


def policy_label(policy: str) -> str:
    """Name of a policy in a dataset: an agent file's own, or for ``agent.onnx`` its folder's, as "ppo-seed1"."""
    path = Path(policy).absolute()
    if path.suffix != ".onnx" or path.stem != "agent":
        return path.stem if path.suffix == ".onnx" else policy
    folder, seed = path.parent, re.fullmatch(r"seed\d+", path.parent.name)
    return f"{folder.parent.name}-{folder.name}" if seed else folder.name


def dataset_id(name: str, scenario: str, puller: PullerFile) -> str:
    """Identifier ``cz/<scenario>/<policy>-v0`` of a dataset, with the puller before the scenario if it has a file.

    "_" stands for what Minari does not take.
    """
    parts = ["cz", *([puller.name] if puller != DEFAULT else []), scenario, f"{policy_label(name)}-v0"]
    return "/".join(re.sub(r"[^-\w]+", "_", part, flags=re.ASCII) for part in parts)


def datasets_root() -> Path:
    """Return Minari's folder of datasets; CzError where the user has no home."""
    try:
        return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")
    except RuntimeError:
        raise CzError("there is no home folder: name another one with --out, or in MINARI_DATASETS_PATH") from None


def write(
    name: str,
    policy: Any,
    scenario: str = "randomized",
    seeds: Sequence[int] = TRAINING_SEEDS[:EPISODES],
    noise: float = NOISE,
    horizon: float = 10800.0,
    overwrite: bool = False,
    puller: PullerFile = DEFAULT,
    scored: bool = False,
) -> Any:
    """Write a Minari dataset, whose name is :func:`dataset_id`, and return it.

    The numbers of the puller stand in it, so ``recover_environment`` gives the same puller back. ``scored`` adds
    :func:`reference_scores`. Raises CzError for seeds that are not training seeds, and for a dataset that exists
    unless ``overwrite`` is set. Nothing is left of a dataset whose writing fails or is interrupted.
    """
    minari, _ = import_module("minari"), import_module("h5py")
    settings: dict[str, Any] = {"scenario": scenario, "observation": "history", "action": "direct", "horizon": horizon}
    settings |= {"puller": to_toml(puller)} if puller != DEFAULT else {}  # a spec is JSON
    config, place = make_config(**settings), dataset_id(name, scenario, puller)
    if not seeds or not set(seeds) <= set(TRAINING_SEEDS):
        raise CzError(f"seeds must be some of the training seeds, {TRAINING_SEEDS[0]} to {TRAINING_SEEDS[-1]}")
    if not 0.0 <= noise <= 1.0:
        raise CzError(f"noise must be between 0 and 1, not {noise:g}")
    check_writable(folder := datasets_root() / place)
    if folder.exists() and not overwrite:
        raise CzError(f"{place} exists in {folder}. Use --out FOLDER (--overwrite would replace it)")

    def buffers(first: int) -> list[Any]:
        episodes = record(policy, config, seeds[first : first + AT_ONCE], noise)
        return [minari.data_collector.EpisodeBuffer(**episode) for episode in episodes]

    begun = buffers(0)
    shutil.rmtree(folder, ignore_errors=True)
    try:
        with closing(gym.make(cz_gym.ENV_ID, **settings)) as env, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # author and address are the user's own to give
            said = policy_label(name)
            facts = {"algorithm_name": said, "code_permalink": CODE, "description": f"{said} on {scenario}, excited"}
            scores: Any = reference_scores(replace(config, observation="measured")) if scored else {}
            dataset = minari.create_dataset_from_buffers(place, begun, env, env, **facts, **scores)
        for first in range(AT_ONCE, len(seeds), AT_ONCE):
            dataset.update_dataset_from_buffer(buffers(first))
        turns = policy if isinstance(policy, tuple) else (policy,)
        noises = [highest_noise(turns[seed % len(turns)], noise) for seed in seeds]
        levels = map(excitation, seeds, repeat(config), noises)
        dataset.storage.update_episode_metadata([{"excitation": level} for level, _ in levels])
        dataset.storage.update_metadata({"cz_gym_version": cz_gym.__version__, "plant_hash": config.plant_hash})
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return dataset


def main(argv: list[str] | None = None) -> int:
    """Write datasets and print one line about each; 0 when done, 2 for bad input, 130 when interrupted."""
    about = "Write Minari datasets of policies on training crystals, with noise on their drives."
    parser = OneLineParser("cz-gym data", about)
    add, about = parser.add_argument, "controllers, agents, random, operator, mixed (%(default)s)"
    add("--policies", type=names, default="paper,lqg,mixed,operator", metavar="NAME[,NAME]", help=about)
    parser.add_scenario("scenarios (randomized)", several=True)
    add("--episodes", type=between(1, len(TRAINING_SEEDS)), default=EPISODES, metavar="N", help="of each (%(default)s)")
    add("--noise", type=float, default=NOISE, metavar="X", help="highest level of the excitation (%(default)s)")
    add("--out", type=Path, metavar="FOLDER", help="instead of $MINARI_DATASETS_PATH or ~/.minari/datasets")
    add("--overwrite", action="store_true", help="replace datasets that exist")
    parser.add_cluster()
    parser.add_puller("record on it, at its control interval")
    return parser.run(_write_all, argv, "data", "the datasets named above are complete")


def _write_all(given: argparse.Namespace) -> None:
    if given.out is not None:
        os.environ["MINARI_DATASETS_PATH"] = str(given.out.resolve())
    puller = chosen_puller(given.puller)
    settings: dict[str, Any] = {"overwrite": given.overwrite, "puller": puller, "scored": True}
    tasks = [
        (name, find_policy(name, make_config(scenario, None, "measured", action="direct", puller=puller)), scenario)
        for scenario in given.scenario or ["randomized"]
        for name in given.policies
    ]
    one = partial(_write_one, datasets_root().absolute(), TRAINING_SEEDS[: given.episodes], given.noise, settings)
    on_cluster = run_parallel(one, tasks, None, given.cluster, datasets_root().absolute())
    for _, line in on_cluster if given.cluster else enumerate(map(one, tasks)):
        print(line, flush=True)


def _write_one(
    root: Path, seeds: Sequence[int], noise: float, settings: dict[str, Any], task: tuple[str, Any, str]
) -> str:
    """Write the set of a policy's name, the policy and a scenario into a folder of sets; one line about it."""
    os.environ["MINARI_DATASETS_PATH"], began = str(root), time.perf_counter()
    dataset = write(*task, seeds, noise, **settings)
    said = f"{dataset.id}: {dataset.total_episodes} episodes, {dataset.total_steps:,} steps, "
    return f"{said}{dataset.storage.get_size():.0f} MB, {time.perf_counter() - began:.1f} s, into {root}"
