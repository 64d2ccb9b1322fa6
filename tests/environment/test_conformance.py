"""Cz-v0 under the checkers, and in a single-file training loop as others write them."""

from __future__ import annotations

import threading
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env as check_with_gymnasium
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_checker import check_env as check_with_sb3

from cz_gym import SCENARIOS, CzEnv, CzVectorEnv
from cz_gym.testing.checker import check_vector_env, main

SHORT: dict[str, Any] = {"control_interval": 60.0, "horizon": 1200.0}


@pytest.mark.parametrize("observation", ["measured", "history", "state"])
def test_the_checkers_on_every_scenario(observation: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scenario in SCENARIOS:
            check_with_gymnasium(gym.make("Cz-v0", scenario=scenario, observation=observation, **SHORT).unwrapped)
            check_with_sb3(gym.make("Cz-v0", scenario=scenario, observation=observation, **SHORT), warn=True)


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize(
    ("scenario", "observation"), [("puller", "history"), ("hard", "state"), ("sensor-fault", "measured")]
)
def test_the_native_batch_is_a_vector_of_scalars(scenario: str, observation: str, mode: AutoresetMode) -> None:
    settings = {"scenario": scenario, "observation": observation, "info": "all", **SHORT}
    checked = check_vector_env(
        lambda n, mode: CzVectorEnv(n, autoreset_mode=mode, **settings),
        lambda: CzEnv(**settings),
        steps=60,
        modes=[mode],
    )
    assert checked.episodes > checked.failures > 8
    assert checked.held > 2000


def test_a_batch_of_images_is_a_vector_of_scalars() -> None:
    settings: dict[str, Any] = {
        "scenario": "hard",
        "observation": "camera",
        "control_interval": 60.0,
        "horizon": 180.0,
        "info": "all",
    }
    checked = check_vector_env(
        lambda n, mode: CzVectorEnv(n, autoreset_mode=mode, **settings), lambda: CzEnv(**settings), num_envs=2, steps=5
    )
    assert checked.episodes > 6
    assert checked.held > 300


def test_the_command_prints_the_counts(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cz_gym.episodes.scenarios.SCENARIOS", {"nominal": SCENARIOS["nominal"]})
    assert main(["--steps", "50"]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("4 cases conform: ")


@pytest.mark.parametrize("keep", ["thread", "torch", "dlpack", "generator", "flat bytes", "closure"])
def test_whoever_holds_an_array_keeps_it(keep: str) -> None:
    """Output arrays are used again once nobody holds them: by reference count, which every holder must raise."""
    env, go, kept = CzVectorEnv(4), threading.Event(), []
    seen: list[tuple[np.ndarray, Any]] = []

    def wait(array: np.ndarray, into: list[np.ndarray]) -> None:
        go.wait(30)
        into.append(array.copy())

    given = [env.reset(seed=0)[0]]
    for _ in range(12):
        observation = given.pop()
        copy = observation.copy()
        if keep == "thread":
            into: list[np.ndarray] = []
            thread = threading.Thread(target=wait, args=(observation, into))
            thread.start()
            kept.append((thread, into, copy))
        else:
            holder = {
                "torch": lambda array: torch.from_numpy(array).numpy,
                "dlpack": lambda array: np.from_dlpack(array),
                "generator": lambda array: (row for row in array),
                "flat bytes": lambda array: np.frombuffer(memoryview(array).cast("B"), np.float32).reshape(array.shape),
                "closure": lambda array: lambda: array,
            }[keep](observation)
            seen.append((copy, holder))
        del observation
        result = env.step(np.full((4, 2), 0.3, np.float32))
        given.append(result[0])
        del result
    go.set()
    for thread, into, copy in kept:
        thread.join()
        np.testing.assert_array_equal(into[0], copy)
    for copy, holder in seen:
        shown = holder() if keep in ("closure", "torch") else list(holder) if keep == "generator" else holder
        np.testing.assert_array_equal(np.array(shown), copy)


class Agent(torch.nn.Module):
    """CleanRL's continuous actor and critic, smaller."""

    def __init__(self, envs: Any) -> None:
        super().__init__()
        seen, acted = np.prod(envs.single_observation_space.shape), np.prod(envs.single_action_space.shape)
        self.critic = torch.nn.Sequential(torch.nn.Linear(int(seen), 32), torch.nn.Tanh(), torch.nn.Linear(32, 1))
        self.actor = torch.nn.Sequential(
            torch.nn.Linear(int(seen), 32), torch.nn.Tanh(), torch.nn.Linear(32, int(acted))
        )
        self.actor_logstd = torch.nn.Parameter(-torch.ones(1, int(acted)))

    def act(self, x: torch.Tensor, action: torch.Tensor | None = None) -> tuple[torch.Tensor, ...]:
        normal = torch.distributions.Normal(self.actor(x), self.actor_logstd.exp())
        action = normal.sample() if action is None else action
        return action, normal.log_prob(action).sum(1), self.critic(x).flatten()


@pytest.mark.parametrize("form", ["vector_entry_point", "sync"])
def test_a_cleanrl_style_loop_runs_it_unmodified(form: str) -> None:
    """PPO in one function: torch tensors over what the environment returns, episodes counted by Gymnasium's wrapper."""
    torch.manual_seed(0)
    envs: Any = gym.make_vec("Cz-v0", num_envs=4, vectorization_mode=form, control_interval=20.0, horizon=400.0)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    agent = Agent(envs)
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-3)
    obs, _ = envs.reset(seed=1)
    obs, returns, before = torch.Tensor(obs), [], agent.actor[0].weight.detach().clone()
    for _ in range(3):
        rows = []
        for _ in range(32):
            with torch.no_grad():
                action, logprob, value = agent.act(obs)
            seen, reward, terminated, _, infos = envs.step(action.cpu().numpy())
            rows.append((obs, action, logprob, torch.Tensor(reward) / 10 + 0.99 * value * ~torch.tensor(terminated)))
            obs = torch.Tensor(seen)
            if "episode" in infos:
                returns += infos["episode"]["r"][infos["_episode"]].tolist()
        x, action, old, target = (torch.cat(parts) for parts in zip(*rows, strict=True))
        _, new, value = agent.act(x, action)
        advantage = (target - value).detach()
        loss = -(torch.exp(new - old).clamp(0.8, 1.2) * advantage).mean() + (target - value).pow(2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    envs.close()
    assert len(returns) >= 16
    assert np.isfinite(returns).all()
    assert not torch.equal(before, agent.actor[0].weight)
