"""A stable-baselines3 model as an agent file: ``python -m cz_gym.agents.from_sb3 MODEL.zip --algo ppo --out FILE``.

For models trained elsewhere, by plain stable-baselines3 or RL-Zoo; ``train.py`` writes agent files by itself. A saved
model is a pickle, and reading one can run any code: convert only what you trained. The agent file holds no code.
"""

import argparse
import pkgutil
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_wrapper
from torch import nn

from cz_gym.config import Config, check_config, make_config
from cz_gym.env import CzEnv
from cz_gym.evaluation.protocol import PLANT, REWARD, STATE, scenarios
from cz_gym.sb3 import AddToController, CzVecEnv, environment_steps
from cz_gym.spaces import observations
from cz_gym.support.command_line import OneLineParser, between
from cz_gym.support.errors import require_type

from .apg import APG, RecurrentPolicy
from .asymmetric import Asymmetric, Remembering
from .contract import AgentFileError, Contract, OnnxPolicy, facts_of, make_contract
from .from_torch import export, largest_difference, write_validated
from .recipes import JUDGING_SEEDS
from .residual import Residual

ALGORITHMS = {
    "apg": "cz_gym.agents.apg:APG",
    "ppo_lstm": "sb3_contrib:RecurrentPPO",
    **{name: f"sb3_contrib:{name.upper()}" for name in ("tqc", "trpo")},
    **{name: f"stable_baselines3:{name.upper()}" for name in ("a2c", "ddpg", "ppo", "sac", "td3")},
}
"""Algorithms by RL-Zoo's names, and this package's own."""
SAFE_WRAPPERS = (
    "Monitor", "TimeLimit", "OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics", "RecordVideo",
    "HumanRendering", "NormalizeReward", "TransformReward", "ClipReward", "VecMonitor", "VecNormalize", "VecCheckNan",
    "VecVideoRecorder", "ActionRepeat", "LongMemory",
)  # fmt: skip
"""Wrappers that leave observations and actions as they are, and VecNormalize and LongMemory, which the agent file
contains."""


def save_agent(
    path: str | Path,
    model: BaseAlgorithm,
    name: str,
    normalisation: VecNormalize | Literal[False] | None = None,
    config: Config | None = None,
    seed: int | None = None,
) -> Contract:
    """Write a trained model as an agent file called ``name``; returns its contract, with its validation figures.

    The model's environment says its settings and its VecNormalize. For a model in no environment, say both: ``config``,
    and ``normalisation``, False if it was trained without one. ``seed`` is the training seed, by default the model's.
    Raises AgentFileError for a model that cannot be written: among others where its settings are not known or differ,
    where a wrapper may change observations or actions, and where the file would not act as the model does.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise AgentFileError(f"{path}: an agent file ends in .onnx")
    require_type(BaseAlgorithm, model, "stable_baselines3.PPO.load(file) reads one")
    if normalisation:
        require_type(VecNormalize, normalisation, "VecNormalize.load(file, env) reads one")
    config = config_of(model, config)
    _check_wrappers(model)
    wanted = (len(observations(config.process).get(config.observation, ())),), (2,)
    read = (model.policy.channels,) if isinstance(model.policy, Remembering) else model.observation_space.shape
    if (read, model.action_space.shape) != wanted:
        raise AgentFileError(
            f"the model reads an observation of shape {read} and gives an action of shape {model.action_space.shape}; "
            f"with observation {config.observation!r} they are {wanted[0]} and {wanted[1]}"
        )
    if normalisation is None:
        if model.get_env() is None:
            raise AgentFileError(
                "the model is in no environment: say by normalisation which VecNormalize it was trained in, or False"
            )
        normalisation = model.get_vec_normalize_env()
    normalisation = normalisation or None
    agent = to_agent(model, name, int((model.seed if seed is None else seed) or 0), config, normalisation, path)
    return write_validated(agent, config, path, "model", disagreement(agent, model, normalisation, config))


def disagreement(
    agent: OnnxPolicy, model: BaseAlgorithm, normalisation: VecNormalize | None, config: Config | None = None
) -> float:
    """Largest difference between the actions of file and model, on crystals that the file drives [action units]."""
    memory: Any = None

    def act(observation: Any, starts: Any) -> Any:
        nonlocal memory
        seen = observation if normalisation is None else normalisation.normalize_obs(observation)
        wanted, memory = model.predict(seen, memory, starts, deterministic=True)
        return wanted

    return largest_difference(agent, act, config or config_of(model))


def config_of(model: BaseAlgorithm, given: Config | None = None) -> Config:
    """Settings of the environments that a model is in, or those given; AgentFileError if these do not agree."""
    env = model.get_env()
    try:
        configs = [] if env is None else [each for each in env.get_attr("config") if isinstance(each, Config)]
    except AttributeError:
        configs = []
    if given is None and not configs:
        raise AgentFileError(
            "the model is in no environment of Cz-v0 or CzCrystal-v0: say in which it was trained (config)"
        )
    config = configs[0] if given is None else check_config(given)
    for each in configs:
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
    env, names = model.get_env(), list[str]()
    while isinstance(env, VecEnvWrapper):
        names.append(type(env).__name__)
        env = env.venv
    if env is not None and not isinstance(env, CzVecEnv):
        for chain in set(env.env_method("__str__")):  # as "<TimeLimit<OrderEnforcing<CzEnv<Cz-v0>>>>"
            wrappers, inner, _ = chain.partition(f"<{CzEnv.__name__}")
            names += re.findall(r"\w+", wrappers if inner else chain)
    for name in names:
        if name not in SAFE_WRAPPERS:
            raise AgentFileError(
                f"the model is wrapped in {name}, which may change observations or actions; the agent file would act "
                f"without it. If it changes neither, model.set_env(an environment without it) first. "
                f"Known to be harmless: {', '.join(SAFE_WRAPPERS)}"
            )


class DeterministicActor(nn.Module):
    """Deterministic action of a policy, clipped to [-1, 1], for observations as the environment gives them.

    A recurrent policy also takes its state, of length ``memory``, and returns the next one.
    """

    mean: torch.Tensor
    spread: torch.Tensor

    def __init__(self, policy: BasePolicy, normalisation: VecNormalize | None = None) -> None:
        super().__init__()
        self.policy: Any = policy
        self.limit, self.memory = 0.0, 0
        self.lstm: nn.LSTM | None = getattr(policy, "lstm_actor", None)
        """The LSTM of sb3-contrib's recurrent policies."""
        if isinstance(policy, RecurrentPolicy):
            self.memory = policy.initial_memory(1).shape[1]
        elif isinstance(policy, Remembering):
            self.memory = len(policy.means.keep)
        elif self.lstm is not None:
            if self.lstm.num_layers > 1:
                raise AgentFileError("a policy with more than one layer of LSTM cannot be written as an agent file")
            self.memory = 2 * self.lstm.hidden_size
        elif not isinstance(policy, ActorCriticPolicy) and not hasattr(policy, "actor"):
            raise AgentFileError(f"{type(policy).__name__} has no actor that gives two continuous actions")
        if normalisation is not None and normalisation.norm_obs:
            rms: Any = normalisation.obs_rms
            self.limit = normalisation.clip_obs
            self.register_buffer("mean", torch.as_tensor(rms.mean, dtype=torch.float32))
            self.register_buffer("spread", torch.as_tensor(np.sqrt(rms.var + normalisation.epsilon)).float())

    def forward(self, observation: torch.Tensor, *state: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Map observations (n, channels), with a memory its state too, to actions (n, 2) and the next state."""
        x, policy = observation, self.policy
        if self.limit:
            x = torch.clamp((x - self.mean) / self.spread, -self.limit, self.limit)
        after: list[torch.Tensor] = []
        if isinstance(policy, RecurrentPolicy):
            action, *after = policy(x, *state)
            return (action.clamp(-1.0, 1.0), *after)
        if isinstance(policy, Remembering):
            x, *after = policy.look(x, *state)
        if isinstance(policy, ActorCriticPolicy):
            x = _features(policy.pi_features_extractor, x)
            if self.lstm is not None:
                x, *after = lstm_step(x, state[0], self.lstm)
            action = policy.action_net(policy.mlp_extractor.forward_actor(x))
        else:
            actor = policy.actor
            x = _features(actor.features_extractor, x)
            action = torch.tanh(actor.mu(actor.latent_pi(x))) if hasattr(actor, "latent_pi") else actor.mu(x)
        return (action.clamp(-1.0, 1.0), *after)


def _features(extractor: nn.Module, x: torch.Tensor) -> Any:
    """Observations of shape (n, channels) are flat already."""
    return x if isinstance(extractor, FlattenExtractor) else extractor(x)


def lstm_step(x: torch.Tensor, state: torch.Tensor, lstm: nn.LSTM) -> tuple[torch.Tensor, torch.Tensor]:
    """Advance an LSTM by a step: hidden values and the next state, which holds hidden and cell values.

    In plain operations: agent files may not have ONNX's LSTM, whose output has a time axis.
    """
    hidden, cell = torch.split(state, lstm.hidden_size, dim=1)
    weight_x, weight_h, bias_x, bias_h = lstm.all_weights[0]
    gates = nn.functional.linear(x, weight_x, bias_x) + nn.functional.linear(hidden, weight_h, bias_h)
    gain, forget, new, emit = torch.split(gates, lstm.hidden_size, dim=1)
    cell = torch.sigmoid(forget) * cell + torch.sigmoid(gain) * torch.tanh(new)
    hidden = torch.sigmoid(emit) * torch.tanh(cell)
    return hidden, torch.cat([hidden, cell], dim=1)


def to_onnx(policy: BasePolicy, channels: int, normalisation: VecNormalize | None = None) -> bytes:
    """Export a policy as a serialised ONNX model; AgentFileError if that cannot be done."""
    policy.set_training_mode(False)
    module = DeterministicActor(policy, normalisation).eval()
    examples = [torch.zeros(2, channels), torch.zeros(2, module.memory)][: 2 if module.memory else 1]
    return export(module, examples, type(policy).__name__)


def to_agent(
    algorithm: BaseAlgorithm, name: str, seed: int, config: Config, normalisation: VecNormalize | None, path: str | Path
) -> OnnxPolicy:
    """Make an agent called ``name`` of the algorithm's policy, not validated yet; ``path`` names it in errors."""
    policy, env = algorithm.policy, algorithm.get_env()
    loop = None if env is None else unwrap_vec_wrapper(env, AddToController)
    residual: Residual | None = None if loop is None else loop.residual
    if isinstance(policy, Remembering):
        policy.check_interval(config)
    width = len(observations(config.process)[config.observation]) + (residual.width if residual else 0)
    content = to_onnx(policy, width, normalisation)
    contract = make_contract(
        content,
        **facts_of(config),
        **(residual.facts if residual else {}),
        algorithm=name,
        learned_from=PLANT if isinstance(algorithm, APG) else STATE if isinstance(policy, Asymmetric) else REWARD,
        training_seed=seed,
        training_steps=environment_steps(algorithm),
        validation_cost=0.0,
        validation_rmse_mm=0.0,
    )
    return OnnxPolicy.of(contract, content, config, path, residual.base if residual else None)


def main(argv: list[str] | None = None) -> int:
    """Convert a saved model."""
    description = "Write a model of stable-baselines3 or RL-Zoo as an agent file, which the benchmark runs."
    epilog = "A saved model is a pickle: reading one can run any code, so convert only what you trained."
    parser = OneLineParser("python -m cz_gym.agents.from_sb3", description, epilog)
    add = parser.add_argument
    add("model", type=Path, help="saved model (.zip)")
    add("--algo", choices=sorted(ALGORITHMS), required=True, help="algorithm, by RL-Zoo's name")
    add("--vecnormalize", type=Path, metavar="PKL", help="saved VecNormalize that it was trained in (default: none)")
    add("--name", help="what the agent is called (default: the agent file's name)")
    about = "what it was trained on: a name, all, FILE.py:NAME or A=0.6,B=0.4 (default: %(default)s)"
    parser.add_scenario(about, "randomized")
    add("--observation", default="history", help="observation it reads (default: %(default)s)")
    add("--action", default="smooth", help="direct, smooth or rate (default: %(default)s)")
    add("--control-interval", type=float, default=5.0, help="in seconds (default: %(default)s)")
    add("--seed", type=between(0, 2**63 - 1), help="training seed (default: the model's)")
    add("--out", type=Path, required=True, metavar="FILE", help="agent file to write (.onnx)")
    return parser.run(_convert, argv, "agents")


def _convert(given: argparse.Namespace) -> None:
    try:
        algorithm: Any = pkgutil.resolve_name(ALGORITHMS[given.algo])
    except ModuleNotFoundError as error:
        if error.name != "sb3_contrib":
            raise
        raise AgentFileError(f"{given.algo} is missing: pip install sb3-contrib") from None
    model = _read(given.model, f"a model of {given.algo}", lambda path: algorithm.load(path, device="cpu"))
    crystals = scenarios(given.scenario)
    config = make_config(crystals, None, given.observation, given.control_interval, action=given.action)
    normalisation: Any = False
    if given.vecnormalize:
        env = DummyVecEnv([lambda: CzEnv(observation=given.observation)])
        normalisation = _read(given.vecnormalize, "a VecNormalize", lambda path: VecNormalize.load(str(path), env))
    name = given.out.stem if given.name is None else given.name
    contract = save_agent(given.out, model, name, normalisation, config, given.seed)
    said = f"mean RMSE {contract.validation_rmse_mm:.3f} mm on {len(JUDGING_SEEDS)} validation episodes"
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
