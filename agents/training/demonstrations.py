"""Demonstrations: a controller's actions on crystals that it or its imitation drives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym import CzVectorEnv
from cz_gym.config import Config
from cz_gym.episodes.scenario import Scenario
from cz_gym.observation import DRIVE_CHANNELS
from cz_gym.task import drives_of

Floats = npt.NDArray[np.float32]
SAMPLE_EVERY = 4
"""Control intervals between demonstrated samples."""


class Demonstrations(NamedTuple):
    """Observations, and the teacher's actions there."""

    observation: Floats
    """Shape (samples, channels)."""
    action: Floats
    """The teacher's answer as an action of the environment, not clipped; shape (samples, 2)."""

    @classmethod
    def concatenated(cls, parts: Iterable[Demonstrations]) -> Demonstrations:
        """Several demonstrations as one."""
        return cls(*map(np.concatenate, zip(*parts, strict=True)))


def demonstrate(
    teacher: Any,
    config: Config,
    seeds: Sequence[int],
    noise: tuple[float, float],
    driver: Callable[[Floats], Floats] | None = None,
    progress: Callable[[int], None] = lambda steps: None,
) -> Demonstrations:
    """Label one episode a seed with the actions of a teacher, whose ``predict`` maps "history" to drives.

    A privileged teacher (``for_episodes``) knows what no sensor shows of those episodes. The teacher drives, or the
    ``driver``, a function of the observation; ``noise`` is the standard deviation added to its actions. Samples
    after a crystal is lost are left out. ``progress`` receives the environment steps taken.
    """
    n = len(seeds)
    if hasattr(teacher, "for_episodes"):
        teacher = teacher.for_episodes(config, seeds)
    env = CzVectorEnv.from_config(config, n)
    random = np.random.default_rng(seeds[0])
    observation, _ = env.reset(seed=list(seeds))
    begins, over, memory = np.ones(n, np.bool_), np.zeros(n, np.bool_), None
    running = np.ones(n, np.bool_)
    samples: list[Demonstrations] = []
    drives = drives_of(config.action, config.control_interval)
    for k in range(config.steps):
        wanted, memory = teacher.predict(observation, memory, begins)
        action = drives.asked(wanted, observation[:, list(DRIVE_CHANNELS)])
        if k % SAMPLE_EVERY == 0:
            samples.append(Demonstrations(observation[running], np.asarray(action[running], np.float32)))
        applied = action if driver is None else driver(observation)
        disturbed = applied + random.normal(0.0, noise, applied.shape)
        observation, _, terminated, truncated, _ = env.step(np.clip(disturbed, -1.0, 1.0).astype(np.float32))
        begins, over = over, terminated | truncated
        running &= ~over
        progress(n)
    env.close()
    return Demonstrations.concatenated(samples)


def widened(scenario: Scenario, width: float) -> Scenario:
    """The scenario with the spread of its pullers, ramps, fluctuations and noises multiplied by ``width``."""
    if width == 1.0:
        return scenario
    s, pullers = scenario, scenario.pullers
    middle, half = sum(pullers.mix) / 2.0, (pullers.mix[1] - pullers.mix[0]) / 2.0

    def times(bounds: tuple[float, float]) -> tuple[float, float]:
        return width * bounds[0], width * bounds[1]

    return replace(
        s,
        name=f"{s.name}-times-{width:g}",
        pullers=replace(
            pullers,
            mix=(max(middle - width * half, 0.0), min(middle + width * half, 1.0)),
            capillary=width * pullers.capillary,
            conductivity=width * pullers.conductivity,
            conductance=width * pullers.conductance,
            start_radius_sd=width * pullers.start_radius_sd,
        ),
        recipe=replace(s.recipe, rate=times(s.recipe.rate)),
        drift=replace(s.drift, amount=times(s.drift.amount)),
        interface=replace(s.interface, sd=times(s.interface.sd)),
        reference=replace(s.reference, amount=times(s.reference.amount)),
        sensor=replace(
            s.sensor, camera_noise=times(s.sensor.camera_noise), pyrometer_noise=times(s.sensor.pyrometer_noise)
        ),
    )
