"""Models of plain stable-baselines3 as agent files: the file acts as the model does, or there is none."""

import os
import shlex
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import RecordEpisodeStatistics, TransformAction
from sb3_contrib import TQC, RecurrentPPO
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecMonitor, VecNormalize
from torch import nn

from cz_gym import CzEnv, sb3
from cz_gym.agents import AgentFileError, OnnxPolicy, from_sb3
from cz_gym.agents.apg import APG
from cz_gym.agents.contract import make_contract
from cz_gym.agents.from_sb3 import to_onnx
from cz_gym.config import make_config
from cz_gym.spaces import HISTORY
from tests.contracts import facts

pytestmark = pytest.mark.usefixtures("few_crystals")
ON = {"n_steps": 16, "batch_size": 32, "n_epochs": 1}
OFF = {"learning_starts": 8, "buffer_size": 64, "batch_size": 8}
KINDS = {
    "a2c": (A2C, "MlpPolicy", {"policy_kwargs": {"activation_fn": nn.ELU}}),
    "ddpg": (DDPG, "MlpPolicy", OFF),
    "ppo": (PPO, "MlpPolicy", ON),
    "ppo_lstm": (RecurrentPPO, "MlpLstmPolicy", ON),
    "sac": (SAC, "MlpPolicy", OFF),
    "sac with a clipped mean": (SAC, "MlpPolicy", {**OFF, "use_sde": True}),
    "td3": (TD3, "MlpPolicy", {**OFF, "policy_kwargs": {"activation_fn": nn.SiLU}}),
    "tqc": (TQC, "MlpPolicy", OFF),
}


def trained(kind, normalised=False, observation="history"):
    algorithm, policy, options = KINDS[kind]
    settings = {"observation": observation, "control_interval": 10.0}
    env = make_vec_env("Cz-v0", n_envs=2, env_kwargs=settings)
    if normalised:
        env = VecNormalize(env, clip_obs=3.0)
    return algorithm(policy, env, device="cpu", seed=5, **options).learn(64)


@pytest.mark.parametrize("kind", KINDS)
def test_every_policy_becomes_a_file_that_acts_as_it_does(kind, tmp_path):
    model = trained(kind)
    contract = from_sb3.save_agent(tmp_path / "mine.onnx", model, "mine")
    assert (contract.algorithm, contract.observation, contract.training_seed) == ("mine", "history", 5)
    assert (contract.action, contract.control_interval) == ("smooth", 10.0), "not what it was trained in"
    assert contract.training_steps == model.num_timesteps >= 64
    agent = OnnxPolicy.load(tmp_path / "mine.onnx")
    assert from_sb3.disagreement(agent, model, None) < 1e-5
    for parameter in model.policy.parameters():
        parameter.data += 0.3
    assert from_sb3.disagreement(agent, model, None) > 1e-3, "the comparison would not tell another network"


def test_a_policy_without_an_actor_is_refused():
    model = DQN("MlpPolicy", "CartPole-v1", buffer_size=10)
    with pytest.raises(AgentFileError, match="DQNPolicy has no actor that gives two continuous actions"):
        to_onnx(model.policy, 4)


@pytest.mark.parametrize("kind", ["ppo", "ppo_lstm"])
def test_normalisation_goes_into_the_graph(kind, tmp_path):
    model = trained(kind, normalised=True, observation="measured")
    normalisation = model.get_vec_normalize_env()
    from_sb3.save_agent(tmp_path / "mine.onnx", model, "mine")
    agent = OnnxPolicy.load(tmp_path / "mine.onnx")
    assert agent.observation == "measured"
    assert from_sb3.disagreement(agent, model, normalisation) < 1e-4
    assert from_sb3.disagreement(agent, model, None) > 1e-3


def test_the_command_reads_what_stable_baselines3_and_rl_zoo_save(tmp_path, capsys):
    model = trained("ppo", normalised=True)
    model.save(tmp_path / "best_model.zip")
    model.get_vec_normalize_env().save(str(tmp_path / "vecnormalize.pkl"))
    command = [str(tmp_path / "best_model.zip"), "--algo", "ppo", "--out", str(tmp_path / "zoo.onnx")]
    command += ["--vecnormalize", str(tmp_path / "vecnormalize.pkl")]
    made = ["--action", "smooth", "--control-interval", "10"]
    assert from_sb3.main([*command, "--name", "zoo", "--seed", "7", "--scenario", "hard", *made]) == 0
    assert "wrote" in capsys.readouterr().out
    agent = OnnxPolicy.load(tmp_path / "zoo.onnx")
    assert (agent.contract.algorithm, agent.contract.training_seed, agent.contract.scenario) == ("zoo", 7, "hard")
    assert (agent.contract.action, agent.contract.control_interval) == ("smooth", 10.0)
    assert from_sb3.disagreement(agent, model, model.get_vec_normalize_env()) < 1e-4


def test_the_command_reads_analytic_policy_gradients_of_a_mixture(tmp_path):
    env = sb3.make_vec_env(2, observation="measured", action="rate")
    model = APG("RecurrentPolicy", env, window=4, seed=3).learn(16)
    model.save(tmp_path / "model.zip")
    command = f"{tmp_path / 'model.zip'} --algo apg --out {tmp_path / 'own.onnx'} --observation measured --action rate"
    assert from_sb3.main([*command.split(), "--scenario", "randomized=0.5,hard=0.5"]) == 0
    agent = OnnxPolicy.load(tmp_path / "own.onnx")
    assert (agent.contract.scenario, agent.contract.training_seed) == ("0.5 hard + 0.5 randomized", 3)
    assert from_sb3.disagreement(agent, model, None) < 1e-6


@pytest.mark.parametrize("kind", ["ppo", "sac"])
def test_a_model_in_no_environment_is_written_by_settings_that_are_given(kind, tmp_path):
    path, model, config = tmp_path / "mine.onnx", trained(kind, normalised=True), make_config(control_interval=10.0)
    normalisation = model.get_vec_normalize_env()
    model.save(tmp_path / "model.zip")
    loaded = type(model).load(tmp_path / "model.zip", device="cpu")
    with pytest.raises(AgentFileError, match=r"in no environment of .*: say in which it was trained \(config\)"):
        from_sb3.save_agent(path, loaded, "mine", normalisation)
    with pytest.raises(AgentFileError, match=r"in no environment: say by normalisation .*, or False"):
        from_sb3.save_agent(path, loaded, "mine", config=config)
    from_sb3.save_agent(path, loaded, "mine", normalisation, config)
    assert from_sb3.disagreement(OnnxPolicy.load(path), model, normalisation, config) < 1e-4
    from_sb3.save_agent(str(path), loaded, "mine", False, config)
    assert from_sb3.disagreement(OnnxPolicy.load(path), model, None, config) < 1e-4


def in_environments(*wrapped, outer=lambda env: env, **options):
    return PPO("MlpPolicy", outer(DummyVecEnv([*wrapped])), device="cpu", n_steps=8, batch_size=8, **options)


DOUBLED = partial(TransformAction, func=lambda action: np.clip(2.0 * action, -1.0, 1.0), action_space=None)


def otherwise():
    """A model whose graph is not what it does."""
    model = trained("ppo")
    predict = model.predict
    model.predict = lambda *given, **options: (predict(*given, **options)[0] + np.float32(0.01), None)
    return model


@pytest.mark.parametrize(
    ("model", "given", "said"),
    [
        (lambda: in_environments(lambda: Monitor(DOUBLED(gym.make("Cz-v0")))), {}, "TransformAction"),
        (lambda: in_environments(CzEnv, outer=lambda env: VecFrameStack(env, 1)), {}, "wrapped in VecFrameStack"),
        (lambda: in_environments(CzEnv, lambda: CzEnv("hard")), {}, "several scenarios, 'randomized' and 'hard'"),
        (lambda: in_environments(CzEnv, lambda: CzEnv(action="rate")), {}, "environments differ"),
        (lambda: in_environments(CzEnv, lambda: CzEnv(control_interval=2.0)), {}, "environments differ"),
        (lambda: in_environments(CzEnv, policy_kwargs={"features_extractor_class": Own}), {}, "operator 'Sin'"),
        (otherwise, {}, r"otherwise than the model, by up to 0\.01"),
        (lambda: in_environments(CzEnv), {"path": "mine"}, "ends in .onnx"),
        (lambda: in_environments(CzEnv), {"config": "hard"}, "needs a Config, not 'hard'"),
        (lambda: "model.zip", {}, "needs a BaseAlgorithm, not 'model.zip': stable_baselines3.PPO.load"),
    ],
)
def test_a_model_whose_file_would_be_another_agent_is_refused(model, given, said, tmp_path):
    """The figures of a wrapped model would be those of an agent that acts without the wrapper."""
    with pytest.raises(ValueError, match=said):
        from_sb3.save_agent(**{"path": tmp_path / "mine.onnx", "model": model(), "name": "mine", **given})
    assert not list(tmp_path.iterdir())


def test_a_model_of_several_scenarios_is_written_for_the_one_that_is_given(tmp_path):
    model = in_environments(lambda: RecordEpisodeStatistics(CzEnv()), lambda: CzEnv(scenario="hard"), outer=VecMonitor)
    model.learn(16)
    contract = from_sb3.save_agent(tmp_path / "mine.onnx", model, "mine", config=make_config("hard"))
    assert contract.scenario == "hard"
    with pytest.raises(AgentFileError, match="differ from the given config"):
        from_sb3.save_agent(tmp_path / "mine.onnx", model, "mine", config=make_config(action="rate"))


class Own(BaseFeaturesExtractor):
    """A layer of somebody's own before the policy's, which no agent file may hold."""

    def __init__(self, space):
        super().__init__(space, space.shape[0])

    def forward(self, observations):
        return torch.sin(observations)


LAYERS = {
    name: getattr(nn, name)
    for name in (
        "CELU", "ELU", "GELU", "Hardsigmoid", "Hardswish", "Hardtanh", "LeakyReLU", "Mish", "PReLU", "ReLU6",
        "SELU", "SiLU", "Softplus", "Softsign", "Tanhshrink",
    )
} | {"LayerNorm": lambda: nn.LayerNorm(8)}  # fmt: skip


@pytest.mark.parametrize("layer", LAYERS)
def test_usual_layers_act_alike_in_torch_and_in_the_file(layer):
    arch = {"activation_fn": LAYERS[layer], "net_arch": [8]}
    policy = PPO("MlpPolicy", "Cz-v0", seed=0, device="cpu", n_steps=8, batch_size=8, policy_kwargs=arch).policy
    with torch.no_grad():
        policy.action_net.weight *= 30.0
    seen = np.random.default_rng(0).normal(0.0, 2.0, (50, len(HISTORY))).astype(np.float32)
    content = to_onnx(policy, len(HISTORY))
    agent = OnnxPolicy.of(make_contract(content, **facts()), content)
    wanted = policy.predict(seen, deterministic=True)[0]
    assert np.abs(wanted).max() > 0.2
    assert agent.predict(seen)[0] == pytest.approx(wanted, abs=1e-5)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("missing.zip --algo ppo --out mine.onnx", "missing.zip: no such file"),
        ("broken.zip --algo ppo --out mine.onnx", "broken.zip: not a model of ppo"),
        ("good.zip --algo sac --out mine.onnx", "good.zip: not a model of sac"),
        ("good.zip --algo ppo --out mine.pt", "ends in .onnx"),
        ("good.zip --algo ppo --out mine.onnx --observation measured", "shape (73,)"),
        ("good.zip --algo ppo --out mine.onnx --vecnormalize broken.zip", "broken.zip: not a VecNormalize"),
        ("good.zip --algo ppo --out mine.onnx --seed -1", "--seed"),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(arguments, said, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    in_environments(CzEnv).save("good.zip")
    Path("broken.zip").write_bytes(b"not a model")
    before = set(os.listdir())
    assert said in refused(from_sb3.main, shlex.split(arguments))
    assert set(os.listdir()) == before
