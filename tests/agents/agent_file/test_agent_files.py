"""Agent files: what is exported is what was trained, and what is broken is refused in one line."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from contracts import facts
from hypothesis import given
from hypothesis import strategies as st

from cz_gym import Parameters
from cz_gym.agents import AgentFileError, OnnxPolicy, shipped
from cz_gym.agents.agent_file.contract import MAX_BYTES, write_agent
from cz_gym.agents.training import recipes as settings
from cz_gym.agents.training.checkpoint import load_checkpoint, restore, to_bytes
from cz_gym.agents.training.export import actor_of, to_onnx
from cz_gym.agents.training.learners import make_training
from cz_gym.agents.training.networks import Normalise
from cz_gym.baselines import CompensatedPID
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.observation import HISTORY, STATE

CONFIG = make_config(observation="history")
SMALL = replace(
    settings.SCRATCH,
    recipe=settings.Recipe(num_envs=4, hidden=(16, 16)),
    steps=64,
    n_steps=16,
    batch_size=32,
    n_epochs=1,
)
SMALL_SAC = settings.SAC(
    recipe=settings.Recipe(num_envs=4, hidden=(16, 16), privileged_critic=False),
    steps=64,
    buffer_size=256,
    learning_starts=32,
    batch_size=16,
    gradient_steps=1,
)


def observations(n: int, channels: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-3.0, 3.0, (n, channels)).astype(np.float32)


@pytest.fixture(scope="module")
def ppo() -> Any:
    training = make_training(SMALL, 0, None)
    training.learner.learn(64, callback=training.callbacks)
    return training.learner


@pytest.fixture
def agent(ppo: Any, tmp_path: Path) -> Path:
    path = tmp_path / "agent.onnx"
    write_agent(path, to_onnx(actor_of(ppo)), **facts())
    return path


def test_exported_ppo_acts_like_the_network_it_came_from(ppo: Any, agent: Path) -> None:
    normalise = ppo.policy.features_extractor
    assert normalise.scaling.diagonal().min() > 0
    assert not torch.allclose(normalise.scaling, torch.eye(len(normalise.scaling)))
    seen = observations(64, len(HISTORY) + len(STATE))
    expected, _ = ppo.predict(seen, deterministic=True)
    action, _ = OnnxPolicy.load(agent, CONFIG).predict(seen[:, : len(HISTORY)])
    np.testing.assert_allclose(action, expected, atol=2e-6)
    assert action.dtype == np.float32


def test_actor_is_blind_to_the_true_state(ppo: Any) -> None:
    seen = observations(8, len(HISTORY) + len(STATE))
    blind = seen.copy()
    blind[:, len(HISTORY) :] = 0.0
    np.testing.assert_array_equal(ppo.predict(seen, deterministic=True)[0], ppo.predict(blind, deterministic=True)[0])
    values = [ppo.policy.predict_values(torch.as_tensor(array)) for array in (seen, blind)]
    assert not torch.allclose(*values)


def test_exported_sac_acts_like_its_network_on_top_of_the_drives(tmp_path: Path) -> None:
    training = make_training(SMALL_SAC, 0, None)
    training.learner.learn(64, callback=training.callbacks)
    path = tmp_path / "sac.onnx"
    write_agent(path, to_onnx(actor_of(training.learner)), **facts(algorithm="sac"))
    seen = observations(64, len(HISTORY))
    output, _ = training.learner.predict(seen, deterministic=True)
    head = SMALL_SAC.recipe.head
    wanted = head.skip * seen[:, [9, 10]] + np.array([head.pull_scale, head.heater_scale]) * output
    action, _ = OnnxPolicy.load(path).predict(seen)
    np.testing.assert_allclose(action, np.clip(wanted, -1.0, 1.0), atol=2e-6)


def test_normalisation_is_the_data_s_mean_and_spread() -> None:
    training = make_training(SMALL, 1, None)
    training.learner.learn(64, callback=training.callbacks)
    buffer = training.learner.rollout_buffer
    assert buffer.observations.shape[-1] == len(HISTORY) + len(STATE)
    normalise = next(module for module in training.learner.policy.modules() if isinstance(module, Normalise))
    assert np.isfinite(normalise.mean.numpy()).all()


def test_one_observation_and_a_batch_of_one_act_alike(agent: Path) -> None:
    policy = OnnxPolicy.load(agent)
    seen = observations(1, len(HISTORY))
    np.testing.assert_array_equal(policy.predict(seen)[0][0], policy.predict(seen[0])[0])
    with pytest.raises(ValueError, match="expected 72 channels"):
        policy.predict(seen[:, :-1])


def test_agent_for_another_plant_is_refused(agent: Path) -> None:
    with pytest.raises(AgentFileError, match="trained on plant"):
        OnnxPolicy.load(agent, make_config(observation="history", parameters=Parameters(k_l=60.0)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observation": "camera"}, "does not have"),
        ({"channels": 71}, "reads 71 channels"),
        ({"channels": "72"}, "must be int"),
        ({"format": "zip"}, "not a cz-gym-agent contract"),
        ({"format_version": 1}, "format version 1, this release reads 3"),
        ({"sha256": "0" * 64}, "SHA-256 differs"),
        ({"surprise": 1}, "'surprise' is unknown"),
    ],
)
def test_broken_promises_are_refused(agent: Path, change: dict[str, Any], message: str) -> None:
    contract = agent.with_suffix(".json")
    contract.write_text(json.dumps({**json.loads(contract.read_text()), **change}))
    with pytest.raises(AgentFileError, match=message) as caught:
        OnnxPolicy.load(agent)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("number", ["NaN", "Infinity"])
def test_a_contract_without_finite_numbers_is_refused(agent: Path, number: str) -> None:
    contract = agent.with_suffix(".json")
    contract.write_text(contract.read_text().replace('"validation_rmse_mm": 1.0', f'"validation_rmse_mm": {number}'))
    with pytest.raises(AgentFileError, match="must be finite"):
        OnnxPolicy.load(agent)


def test_networks_that_give_no_action_are_refused(ppo: Any, tmp_path: Path) -> None:
    path = tmp_path / "agent.onnx"
    actor = actor_of(ppo)
    write_agent(path, to_onnx(dataclasses.replace(actor, scale=np.full(2, np.nan, np.float32))), **facts())
    with pytest.raises(AgentFileError, match="not finite"):
        OnnxPolicy.load(path)
    weight, bias = actor.layers[-1]
    endless = dataclasses.replace(actor, layers=(*actor.layers[:-1], (weight * 0, bias * 0 + 1e38)))
    model = onnx.load_from_string(to_onnx(dataclasses.replace(endless, scale=np.full(2, 1e38, np.float32))))
    clip = model.graph.node[-1]
    clip.CopyFrom(onnx.helper.make_node("Sub", [clip.input[0], clip.input[0]], [clip.output[0]]))
    write_agent(path, model.SerializeToString(), **facts())
    with pytest.raises(AgentFileError, match="not two finite numbers"):
        OnnxPolicy.load(path)
    model = onnx.load_from_string(to_onnx(actor))
    drives = next(value for value in model.graph.initializer if value.name == "drives")
    drives.CopyFrom(onnx.numpy_helper.from_array(np.array([9, 900], np.int64), "drives"))
    write_agent(path, model.SerializeToString(), **facts())
    with pytest.raises(AgentFileError, match="cannot be run"):
        OnnxPolicy.load(path)


def test_missing_and_oversized_files_are_refused(agent: Path, tmp_path: Path) -> None:
    with pytest.raises(AgentFileError, match="no such file"):
        OnnxPolicy.load(tmp_path / "nobody.onnx")
    agent.write_bytes(b"0" * (MAX_BYTES + 1))
    with pytest.raises(AgentFileError, match="larger than"):
        OnnxPolicy.load(agent)
    with pytest.raises(AgentFileError, match="no shipped agent"):
        shipped("nobody")


@given(content=st.binary(max_size=200), where=st.integers(0, 10_000), as_contract=st.booleans())
def test_damaged_files_always_give_one_line(
    tmp_path_factory: pytest.TempPathFactory, ppo: Any, content: bytes, where: int, as_contract: bool
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "agent.onnx"
    whole = to_onnx(actor_of(ppo))
    damaged = whole[: where % len(whole)] + content
    write_agent(path, damaged, **facts())
    if as_contract:
        path.with_suffix(".json").write_bytes(content)
    with pytest.raises(AgentFileError) as caught:
        OnnxPolicy.load(path)
    assert "\n" not in str(caught.value)


def test_checkpoint_continues_and_refuses_what_does_not_fit(ppo: Any, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(to_bytes(ppo, 12.0, 0.5))
    progress, tensors = load_checkpoint(path)
    assert (progress.seconds, progress.best_cost) == (12.0, 0.5)
    other = make_training(SMALL, 1, None).learner
    restore(other, progress, tensors, path)
    assert other.num_timesteps == ppo.num_timesteps
    for one, two in zip(ppo.policy.state_dict().values(), other.policy.state_dict().values(), strict=True):
        torch.testing.assert_close(one, two, rtol=0, atol=0)
    path.write_bytes(to_bytes(other, 12.0, 0.5))
    again = load_checkpoint(path)
    assert again[0] == progress
    assert set(again[1]) == set(tensors)
    assert all(torch.equal(again[1][name], tensor) for name, tensor in tensors.items())
    wider = dataclasses.replace(SMALL, recipe=dataclasses.replace(SMALL.recipe, hidden=(8, 8)))
    with pytest.raises(AgentFileError, match="does not fit"):
        restore(make_training(wider, 0, None).learner, progress, tensors, path)


def test_a_resumed_sac_keeps_its_temperature(tmp_path: Path) -> None:
    """stable-baselines3 counts it as a variable, not among the parameters."""
    path = tmp_path / "checkpoint.safetensors"
    learner = make_training(SMALL_SAC, 0, None).learner
    with torch.no_grad():
        learner.log_ent_coef.fill_(-1.25)
    path.write_bytes(to_bytes(learner, 1.0, None))
    other = make_training(SMALL_SAC, 1, None).learner
    restore(other, *load_checkpoint(path), path)
    assert other.log_ent_coef.item() == -1.25
    assert other.log_ent_coef in other.ent_coef_optimizer.param_groups[0]["params"]


@pytest.fixture(scope="module")
def sac() -> Any:
    """A learner whose buffer of 64 steps has gone round."""
    training = make_training(SMALL_SAC, 0, None)
    training.learner.learn(280, callback=training.callbacks)
    return training.learner


@pytest.mark.parametrize(("kept", "steps"), [(50_000, 64), (80, 20)])
def test_a_resumed_sac_keeps_its_latest_transitions(
    sac: Any, kept: int, steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cz_gym.agents.training.replay_buffer.KEPT", kept)
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(to_bytes(sac, 1.0, None))
    other = make_training(SMALL_SAC, 1, None, sac.num_timesteps).learner
    restore(other, *load_checkpoint(path), path)
    assert sac.replay_buffer.full
    assert other.replay_buffer.size() == steps
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        was = np.roll(getattr(sac.replay_buffer, name), -sac.replay_buffer.pos, axis=0)[-steps:]
        np.testing.assert_array_equal(getattr(other.replay_buffer, name)[:steps], was)
    other.learn(40, callback=[], reset_num_timesteps=False)
    assert other.replay_buffer.pos == (steps + 10) % 64


def test_normalisation_is_found_by_a_run_that_was_cut_short_before_it_knew_any() -> None:
    training = make_training(SMALL_SAC, 0, None, done=8)
    training.learner.num_timesteps = 8
    training.learner.learn(40, callback=training.callbacks, reset_num_timesteps=False)
    found = [module.mean for module in training.learner.policy.modules() if isinstance(module, Normalise)]
    assert found
    assert all(mean.any() for mean in found)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("replay/rewards", lambda tensor: tensor[:-1]),
        ("replay/rewards", lambda tensor: tensor[0, 0]),
        ("replay/actions", lambda tensor: tensor.double()),
        ("replay/actions", lambda tensor: tensor[:, :, :1].contiguous()),
        ("replay/dones", lambda tensor: tensor + 0.5),
        ("replay/observations", lambda tensor: None),
        ("replay/observations", lambda tensor: tensor * torch.nan),
        ("replay/surprise", lambda tensor: torch.zeros(1)),
    ],
)
def test_transitions_that_do_not_belong_are_refused(sac: Any, name: str, change: Any, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(to_bytes(sac, 1.0, None))
    progress, tensors = load_checkpoint(path)
    tensors[name] = change(tensors.get(name))
    other = make_training(SMALL_SAC, 1, None).learner
    with pytest.raises(AgentFileError, match=r"does not fit|not finite"):
        restore(other, progress, {key: tensor for key, tensor in tensors.items() if tensor is not None}, path)
    assert other.replay_buffer.size() == 0


def test_more_transitions_than_are_kept_are_refused(sac: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(to_bytes(sac, 1.0, None))
    monkeypatch.setattr("cz_gym.agents.training.replay_buffer.KEPT", 80)
    with pytest.raises(AgentFileError, match="does not fit"):
        restore(make_training(SMALL_SAC, 1, None).learner, *load_checkpoint(path), path)


@pytest.mark.parametrize(
    ("name", "tensor", "message"),
    [
        ("policy/log_std", torch.full((2,), torch.nan), "not finite"),
        ("policy/log_std", torch.zeros(3), "does not fit"),
        ("policy/log_std", torch.zeros(2, dtype=torch.float64), "does not fit"),
        ("policy.optimizer/0/step", torch.tensor(-1.0), "does not fit"),
        ("policy.optimizer/99/step", torch.tensor(1.0), "does not fit"),
        ("policy.optimizer/0/surprise", torch.tensor(1.0), "does not fit"),
        ("elsewhere/weight", torch.zeros(2), "does not fit"),
    ],
)
def test_tensors_that_do_not_belong_are_refused(
    ppo: Any, tmp_path: Path, name: str, tensor: torch.Tensor, message: str
) -> None:
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(to_bytes(ppo, 1.0, None))
    progress, tensors = load_checkpoint(path)
    with pytest.raises(AgentFileError, match=message):
        restore(ppo, progress, {**tensors, name: tensor}, path)
    with pytest.raises(AgentFileError, match="does not fit"):
        restore(ppo, progress, {key: tensors[key] for key in tensors if key != "policy/log_std"}, path)


def test_shipped_agent_beats_the_paper_s_controller_on_validation() -> None:
    seeds = range(1_000_000, 1_000_030)
    agent = metrics(rollout(OnnxPolicy.load(shipped(), CONFIG), CONFIG, seeds))
    paper = metrics(rollout(CompensatedPID(), make_config(), seeds))
    assert agent.rmse_mm.mean() < 0.3 * paper.rmse_mm.mean()
    assert agent.failure_rate.sum() == 0
    assert agent.pull_step_rms_mm_per_min.mean() < paper.pull_step_rms_mm_per_min.mean()
