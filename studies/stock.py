"""Stock learners on the environment as it comes: ``python -m studies.stock`` trains those of stable-baselines3.

Each is judged on validation crystals of ``randomized``, on the way and at the end, with each training seed. Runs that
``--out`` holds are not trained again.
"""

import argparse
import pkgutil
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType
from typing import Any, NamedTuple

from cz_gym.agents.from_sb3 import ALGORITHMS
from cz_gym.agents.recipes import JUDGING_SEEDS, validate
from cz_gym.config import make_config
from cz_gym.support.command_line import between
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.files import write_files
from cz_gym.tools.registry import make_controller
from cz_gym.tools.report.tables import markdown

from . import StudyParser

MILLION = 1_000_000
SHORT = (MILLION // 4, MILLION // 2)
HELD = (MILLION // 2, MILLION, 2 * MILLION)
"""Numbers of actions that are held for four steps: the first is two million steps."""
LITTLE_ENTROPY = MappingProxyType({"gradient_steps": 4, "ent_coef": "auto_0.005", "target_entropy": 0.5})


class Learner(NamedTuple):
    """A learner on its defaults, but for what a user would set."""

    words: str
    """Name in tables."""
    crystals: int
    """Number of crystals at a time."""
    algorithm: str = "ppo"
    """Name of the algorithm, as ``python -m cz_gym.agents.from_sb3 --algo`` knows it."""
    policy: str = "MlpPolicy"
    observation: str = "history"
    action_repeat: int = 1
    """Environment steps that an action is held for in training."""
    normalised: Mapping[str, Any] | None = None
    """Arguments of the ``VecNormalize`` around the environment; None for none."""
    judged: tuple[int, ...] = (MILLION, 2 * MILLION)
    """Numbers of actions after which it is judged; with the last one it ends."""
    settings: Mapping[str, Any] = MappingProxyType({})
    """Arguments of the algorithm."""


LEARNERS = {
    "ppo-8": Learner("ppo, 8 crystals", 8),
    "ppo-8-normalised": Learner("ppo, 8 crystals, VecNormalize", 8, normalised={}),
    "ppo-8-rewards": Learner("ppo, 8 crystals, VecNormalize of rewards alone", 8, normalised={"norm_obs": False}),
    "ppo-8-normalised-slow": Learner(
        "ppo, 8 crystals, VecNormalize, smaller steps", 8, normalised={}, settings={"learning_rate": 3e-5}
    ),
    "ppo-16-normalised": Learner("ppo, 16 crystals, VecNormalize", 16, normalised={}),
    "ppo-8-held": Learner(
        "ppo, 8 crystals, VecNormalize, actions held 20 s", 8, action_repeat=4, normalised={}, judged=HELD
    ),
    "ppo-16-held": Learner(
        "ppo, 16 crystals, VecNormalize, actions held 20 s", 16, action_repeat=4, normalised={}, judged=HELD
    ),
    "recurrent-8": Learner(
        "recurrent ppo on measured, 8 crystals", 8, "ppo_lstm", "MlpLstmPolicy", "measured", judged=SHORT
    ),
    "sac-8": Learner("sac, 8 crystals", 8, "sac", judged=SHORT),
    "sac-64": Learner(
        "sac, 64 crystals, actions held 20 s, little entropy", 64, "sac", action_repeat=4, judged=HELD[:2],
        settings=LITTLE_ENTROPY,
    ),
    "tqc-64": Learner(
        "tqc, 64 crystals, actions held 20 s, little entropy", 64, "tqc", action_repeat=4, judged=HELD[:2],
        settings=LITTLE_ENTROPY,
    ),
}  # fmt: skip
HEADS = ("learner", "actions", "training seeds", "RMSE of each seed [mm]", "lost of each seed [%]")
COLUMNS = ("learner", "seed", "steps", "rmse_mm", "lost")
ABOUT = """# Stock learners: stable-baselines3 on the environment as it comes

{crystals} validation crystals of `randomized` a training seed. The re-tuned PID, on the same crystals: {pid:.3f} mm."""


def train(name: str, seed: int) -> list[tuple[Any, ...]]:
    """Train one learner with a training seed; rows of :data:`COLUMNS`, after each number of actions."""
    import torch
    from stable_baselines3.common.vec_env import VecNormalize

    from cz_gym.agents.from_sb3 import to_agent
    from cz_gym.sb3 import make_vec_env

    torch.set_num_threads(1)
    learner = LEARNERS[name]
    config = make_config("randomized", None, learner.observation)
    env = make_vec_env(learner.crystals, None, learner.action_repeat, observation=learner.observation)
    env = env if learner.normalised is None else VecNormalize(env, **learner.normalised)
    algorithm: Any = pkgutil.resolve_name(ALGORITHMS[learner.algorithm])
    model = algorithm(learner.policy, env, seed=seed, device="cpu", **learner.settings)
    rows = list[tuple[Any, ...]]()
    for before, actions in pairwise((0, *learner.judged)):
        model.learn(actions - before, reset_num_timesteps=False)
        agent = to_agent(model, "stock", seed, config, model.get_vec_normalize_env(), "stock.onnx")
        judged = validate(agent, config, JUDGING_SEEDS)
        rows.append((learner.words, seed, actions, round(judged.rmse_mm, 4), round(judged.failure_rate, 4)))
    return rows


def report(runs: Any) -> str:
    """Table of all runs, a data frame of :data:`COLUMNS`."""
    config = make_config("randomized", None, "measured", action="direct")
    pid = validate(make_controller("paper-tuned", config), config, JUDGING_SEEDS).rmse_mm
    order = [each.words for each in LEARNERS.values()]
    runs = runs.sort_values(
        ["learner", "steps", "seed"], key=lambda c: c.map(order.index) if c.name == "learner" else c
    )
    table = []
    for (words, steps), own in runs.groupby(["learner", "steps"], sort=False):
        errors, lost = (" / ".join(map(form.format, own[c])) for c, form in (("rmse_mm", "{:.3f}"), ("lost", "{:.1%}")))
        table.append((words, f"{steps / MILLION:g} M", str(len(own)), errors, lost.replace("%", "")))
    return "\n\n".join([ABOUT.format(crystals=len(JUDGING_SEEDS), pid=pid), markdown(HEADS, table)])


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = StudyParser("stock", __doc__, "results/stock")
    add = parser.add_argument
    add("learners", nargs="*", metavar="LEARNER", help=f"of: {', '.join(LEARNERS)} (default: all)")
    add("--seeds", type=between(1, 100), default=3, help="training seeds of each (default: %(default)s)")
    return parser.run(_main, arguments, "agents,benchmark")


def _main(given: argparse.Namespace) -> None:
    import pandas as pd

    for name in given.learners:
        if name not in LEARNERS:
            raise CzError(unknown_name_message("learner", name, LEARNERS))
    path, table = given.out / "runs.csv", given.out / "table.md"
    runs = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=COLUMNS)
    known = {each.words for each in LEARNERS.values()}
    if [*runs.columns] != [*COLUMNS] or runs.isna().any(axis=None) or not set(runs["learner"]) <= known:
        raise CzError(f"{path}: no runs of this study, or damaged")
    for seed in range(given.seeds):
        for name in given.learners or LEARNERS:
            if not ((runs["learner"] == LEARNERS[name].words) & (runs["seed"] == seed)).any():
                new = pd.DataFrame(train(name, seed), columns=COLUMNS)
                runs = pd.concat([runs, new]) if len(runs) else new
                write_files({path: runs.to_csv(index=False, float_format="%.4f", lineterminator="\n").encode()})
    write_files({table: f"{report(runs)}\n".encode()})
    print(table.read_text())


if __name__ == "__main__":
    sys.exit(main())
