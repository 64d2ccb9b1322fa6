"""A stable-baselines3 model as an agent file: ``python -m cz_gym.agents.from_sb3 MODEL.zip --algo ppo --out FILE``.

For models trained elsewhere, by plain stable-baselines3 or RL-Zoo; ``train.py`` writes agent files by itself. A saved
model is a pickle, and reading one can run any code: convert only what you trained. The agent file holds no code.
"""

from __future__ import annotations

import argparse
import pkgutil
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cz_gym.config import Config, check_config, make_config
from cz_gym.env import CzEnv, CzVectorEnv, observation_space
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.user_code import scenarios
from cz_gym.spaces import observations
from cz_gym.support.command_line import OneLineParser
from cz_gym.support.files import write_files
from cz_gym.support.names import require_type

from .contract import AgentFileError, Contract, agent_files
from .policy import OnnxPolicy
from .validation import JUDGING, validate

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecNormalize

ALGORITHMS = {
    "apg": "cz_gym.agents.apg:APG",
    "ppo_lstm": "sb3_contrib:RecurrentPPO",
    **{name: f"sb3_contrib:{name.upper()}" for name in ("tqc", "trpo")},
    **{name: f"stable_baselines3:{name.upper()}" for name in ("a2c", "ddpg", "ppo", "sac", "td3")},
}
"""Algorithms by RL-Zoo's names, and this package's own."""
VALID = "valid"
"""Name of the camera's flag among the channels."""
GIVE_IT = "give the VecNormalize it was trained in (save_agent's normalisation, --vecnormalize of the command)"
SAMPLES, SLOTS = 50, 8
"""Samples, each of SLOTS crystals, on which file and model must agree."""
TOLERANCE = 1e-3
"""Largest difference between their actions [action units]."""
HARMLESS = (
    "Monitor", "TimeLimit", "OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics", "RecordVideo",
    "HumanRendering", "NormalizeReward", "TransformReward", "ClipReward", "VecMonitor", "VecNormalize", "VecCheckNan",
    "VecVideoRecorder", "ActionRepeat",
)  # fmt: skip
"""Wrappers that leave observations and actions as they are, and VecNormalize, which the agent file contains."""


def save_agent(
    path: str | Path,
    model: BaseAlgorithm,
    name: str,
    normalisation: VecNormalize | None = None,
    config: Config | None = None,
    seed: int | None = None,
) -> Contract:
    """Write a trained model as an agent file called ``name``; returns its contract, with its validation figures.

    By default ``normalisation``, ``config`` (the settings of its training environment) and training ``seed`` are the
    model's own. Raises AgentFileError for a model that cannot be written: among others where the file would not act as
    the model does, where a wrapper may change observations or actions, where the normalisation is missing, and where
    its environments differ. Warns of a model that does not know how it was trained.
    """
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecNormalize

    from .export import to_agent

    path = Path(path)
    if path.suffix != ".onnx":
        raise AgentFileError(f"{path}: an agent file ends in .onnx")
    require_type(BaseAlgorithm, model, "stable_baselines3.PPO.load(file) reads one")
    if normalisation is not None:
        require_type(VecNormalize, normalisation, "VecNormalize.load(file, env) reads one")
    if config is not None:
        check_config(config)
    normalisation, config = normalisation or model.get_vec_normalize_env(), _config_of(model, config)
    _check_wrappers(model)
    _check_spaces(model, config)
    _check_normalisation(model, normalisation, config)
    agent = to_agent(model, name, int((model.seed if seed is None else seed) or 0), config, normalisation, path)
    apart = disagreement(agent, model, normalisation, config)
    if not apart <= TOLERANCE:
        raise AgentFileError(f"{path}: the file would act otherwise than the model, by up to {apart:.2g}")
    if normalisation is None and not model.num_timesteps:
        said = f"this model does not know how it was trained: if on normalised observations, {GIVE_IT}"
        warnings.warn(said, stacklevel=2)
    contract = validate(agent, config, JUDGING).put_into(agent.contract)
    write_files(agent_files(path, agent.content, contract))
    return contract


def disagreement(
    agent: OnnxPolicy, model: BaseAlgorithm, normalisation: VecNormalize | None, config: Config | None = None
) -> float:
    """The largest difference between the actions of file and model, on crystals that the file drives [action units]."""
    envs = CzVectorEnv.from_config(config or _config_of(model), SLOTS)
    observation, _ = envs.reset(seed=list(VALIDATION_SEEDS[:SLOTS]))
    apart, memory, recalled = 0.0, None, None
    starts = np.ones(SLOTS, bool)
    for _ in range(SAMPLES):
        seen = observation if normalisation is None else normalisation.normalize_obs(observation)
        wanted, memory = model.predict(seen, memory, starts, deterministic=True)
        action, recalled = agent.predict(observation, recalled, starts)
        apart = max(apart, float(np.abs(action - wanted).max()))
        observation, _, terminated, truncated, _ = envs.step(action)
        starts = terminated | truncated
    envs.close()
    return apart


def _config_of(model: BaseAlgorithm, given: Config | None = None) -> Config:
    """The settings of the environments that a model is in, or those given; AgentFileError if these do not agree."""
    try:
        configs: list[Config] = model.get_env().get_attr("config")  # type: ignore[union-attr]  # None: said below
    except AttributeError:
        if given is None:
            raise AgentFileError(
                "the model is in no environment of Cz-v0 or CzCrystal-v0: say in which it was trained (config)"
            ) from None
        return given
    config = given or configs[0]
    for each in configs:
        if not isinstance(each, Config):
            raise AgentFileError(f"the model's environment is not Cz-v0's: its config is {each!r:.80}")
        if (each.observation, each.made_for) != (config.observation, config.made_for):
            raise AgentFileError(
                f"the model's environments differ, or differ from the given config: {each.observation}, "
                f"{each.made_for} and {config.observation}, {config.made_for}; an agent is made for one of them"
            )
        if given is None and each.scenario != config.scenario:
            raise AgentFileError(
                f"the model's environments have several scenarios, {config.scenario.name!r} and "
                f"{each.scenario.name!r}: say by config which one the agent file shall name"
            )
    return config


def _check_wrappers(model: BaseAlgorithm) -> None:
    """AgentFileError if a wrapper may change observations or actions, which the agent file would leave out."""
    from stable_baselines3.common.vec_env import VecEnvWrapper

    from cz_gym.sb3 import CzVecEnv

    env, names = model.get_env(), list[str]()
    while isinstance(env, VecEnvWrapper):
        names.append(type(env).__name__)
        env = env.venv
    if env is not None and not isinstance(env, CzVecEnv):
        for chain in set(env.env_method("__str__")):  # as "<TimeLimit<OrderEnforcing<CzEnv<Cz-v0>>>>"
            wrappers, inner, _ = chain.partition(f"<{CzEnv.__name__}")
            names += re.findall(r"\w+", wrappers if inner else chain)
    for name in names:
        if name not in HARMLESS:
            raise AgentFileError(
                f"the model is wrapped in {name}, which may change observations or actions; the agent file would act "
                f"without it. If it changes neither, model.set_env(an environment without it) first. "
                f"Known to be harmless: {', '.join(HARMLESS)}"
            )


def _check_spaces(model: BaseAlgorithm, config: Config) -> None:
    """AgentFileError unless the model reads and acts as the environment of these settings wants."""
    from .asymmetric import Asymmetric

    wanted = (len(observations(config.process).get(config.observation, ())),), (2,)
    shapes = model.observation_space.shape, model.action_space.shape
    if isinstance(model.policy, Asymmetric):
        shapes = (model.policy.channels,), shapes[1]
    if shapes != wanted:
        raise AgentFileError(
            f"the model reads an observation of shape {shapes[0]} and gives an action of shape {shapes[1]}; "
            f"with observation {config.observation!r} they are {wanted[0]} and {wanted[1]}"
        )


def _check_normalisation(model: BaseAlgorithm, normalisation: VecNormalize | None, config: Config) -> None:
    """AgentFileError if the model was trained on normalised observations, and their normalisation is missing.

    A saved model keeps its last observation: there the camera's flag is 0 or 1 unless it is normalised. A model that is
    loaded into an environment has lost that, but keeps the last original observation before a VecNormalize.
    """
    from .asymmetric import Asymmetric

    if normalisation is not None:
        return
    names = [channel.name for channel in observations(config.process)[config.observation]]
    seen, before = model._last_obs, model._last_original_obs
    space = observation_space(config.observation, config.process)
    plain = before is None and (model.observation_space == space or isinstance(model.policy, Asymmetric))
    if isinstance(seen, np.ndarray) and VALID in names:
        plain = bool(np.isin(seen[:, names.index(VALID)], (0.0, 1.0)).all())
    elif isinstance(seen, np.ndarray) and model.get_env() is not None:
        plain = True  # it learned in this environment, whose VecNormalize would have been found
    elif before is not None and hasattr(model, "replay_buffer"):
        loaded = "a model with a replay buffer, loaded into an environment, does not tell whether it was trained on"
        raise AgentFileError(f"{loaded} normalised observations: load it without env and give config, or {GIVE_IT}")
    if not plain:
        raise AgentFileError(f"the model was trained on normalised observations: {GIVE_IT}")


def main(argv: list[str] | None = None) -> int:
    """Convert a saved model."""
    description = "Write a model of stable-baselines3 or RL-Zoo as an agent file, which the benchmark runs."
    epilog = "A saved model is a pickle: reading one can run any code, so convert only what you trained."
    parser = OneLineParser("python -m cz_gym.agents.from_sb3", description, epilog)
    add = parser.add_argument
    add("model", type=Path, help="saved model (.zip)")
    add("--algo", choices=sorted(ALGORITHMS), required=True, help="algorithm, by RL-Zoo's name")
    add("--vecnormalize", type=Path, metavar="PKL", help="saved VecNormalize, if it was trained with one")
    add("--name", help="what the agent is called (default: the agent file's name)")
    about = "what it was trained on: a scenario's name, all, FILE.py:NAME or A=0.6,B=0.4 (default: %(default)s)"
    add("--scenario", default="randomized", help=about)
    add("--observation", default="history", help="observation it reads (default: %(default)s)")
    add("--action", default="smooth", help="direct, smooth or rate (default: %(default)s)")
    add("--control-interval", type=float, default=5.0, help="in seconds (default: %(default)s)")
    add("--seed", type=int, help="training seed (default: the model's)")
    add("--out", type=Path, required=True, metavar="FILE", help="agent file to write (.onnx)")
    return parser.run(_convert, argv, "agents")


def _convert(given: argparse.Namespace) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    try:
        algorithm: Any = pkgutil.resolve_name(ALGORITHMS[given.algo])
    except ModuleNotFoundError as error:
        if error.name != "sb3_contrib":
            raise
        raise AgentFileError(f"{given.algo} is missing: pip install sb3-contrib") from None
    model = _read(given.model, f"a model of {given.algo}", lambda path: algorithm.load(path, device="cpu"))
    crystals = scenarios(given.scenario)
    config = make_config(crystals, None, given.observation, given.control_interval, action=given.action)
    normalisation = None
    if given.vecnormalize:
        env = DummyVecEnv([lambda: CzEnv(observation=given.observation)])
        normalisation = _read(given.vecnormalize, "a VecNormalize", lambda path: VecNormalize.load(str(path), env))
    name = given.out.stem if given.name is None else given.name
    contract = save_agent(given.out, model, name, normalisation, config, given.seed)
    said = f"mean RMSE {contract.validation_rmse_mm:.3f} mm on {len(JUDGING)} validation episodes"
    print(f"wrote {given.out}: {contract.algorithm} after {contract.training_steps:,} steps, {said}")


def _read(path: Path, what: str, load: Callable[[Path], Any]) -> Any:
    """The content of a file of stable-baselines3; AgentFileError whatever a broken file makes it raise."""
    if not path.is_file():
        raise AgentFileError(f"{path}: no such file")
    try:
        return load(path)
    except Exception as error:
        raise AgentFileError(f"{path}: not {what} that stable-baselines3 can read ({error})") from None


if __name__ == "__main__":
    sys.exit(main())
