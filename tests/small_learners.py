"""Learners that are done in a moment, for tests that need one that has learned something."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cz_gym.agents.training import fleet, run, validation
from cz_gym.agents.training.algorithms import make_algorithm, repeat_of
from cz_gym.agents.training.recipes import APG, PPO, SAC, Recipe
from cz_gym.atomic_files import locked
from cz_gym.evaluation.protocol import VALIDATION_SEEDS

SMALL = PPO(num_envs=4, hidden=(16, 16), steps=128, n_steps=16, batch_size=32, n_epochs=1)
SMALL_SAC = SAC(
    num_envs=4, hidden=(16, 16), steps=256, buffer_size=256, learning_starts=32, batch_size=16, gradient_steps=1
)
SMALL_APG = APG(num_envs=4, window=20, steps=160)
REFERENCES = dict.fromkeys(validation.REFERENCES, (0.2, 0.1))
TRAIN_SEED = fleet.train_seed


def train_small_seed(job: fleet.Job) -> dict[str, float]:
    """As :func:`fleet.train_seed`, with few validation episodes, in whatever process."""
    validation.PICKING, validation.JUDGING = VALIDATION_SEEDS[:2], VALIDATION_SEEDS[2:4]
    return TRAIN_SEED(job)


def train_held_seed(job: fleet.Job) -> dict[str, float]:
    """The same, held."""
    hold()
    return train_small_seed(job)


def hold() -> None:
    """Validations in this process wait until there is a file ``go`` beside the run folders."""
    validate = run.Run.validate

    def wait(self: run.Run, bar: Any) -> None:
        while not (self.folder.parent / "go").exists():
            time.sleep(0.1)
        validate(self, bar)

    run.Run.validate = wait  # type: ignore[method-assign]


def losing(nodes: tuple[Any, Any], folder: Path) -> Callable[[], None]:
    """What :func:`cluster.completed` calls: takes the second node away when two runs have begun, then lets them go."""
    made, second = nodes
    lost = []

    def watch() -> None:
        begun = [path.parent for path in folder.glob("*/settings.json")]
        if len(begun) == 2 and not lost:
            lost.append(second)
            made.remove_node(second, allow_graceful=False)
        elif lost and any(map(is_free, begun)):
            (folder / "go").touch()

    return watch


def is_free(folder: Path) -> bool:
    """Whether no process is at work in a folder."""
    try:
        with locked(folder):
            return True
    except ValueError:
        return False


def tell_and_wait(task: Any) -> None:
    """Print that it has begun, and after a minute that it is still there."""
    print("begun", flush=True)
    time.sleep(60.0)
    print("still there", flush=True)


def learned(algorithm: Any, recipe: Recipe) -> Any:
    """The algorithm after what is left of the recipe's steps, as a run lets it learn."""
    left = recipe.steps // repeat_of(recipe) - algorithm.num_timesteps
    return algorithm.learn(left, reset_num_timesteps=False)


def trained(recipe: Recipe, seed: int = 0) -> Any:
    return learned(make_algorithm(recipe, seed), recipe)
