"""Stock learners on the environment as it comes: ``python -m studies.stock`` trains those of stable-baselines3.

Each is judged on validation crystals of ``randomized``, on the way and at the end, with each training seed. Runs that
``--out`` holds are not trained again.
"""

import argparse
import csv
import io
import pkgutil
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from cz_gym.agents.from_sb3 import ALGORITHMS
from cz_gym.agents.validation import JUDGING, validate
from cz_gym.config import make_config
from cz_gym.support.command_line import OneLineParser, between
from cz_gym.support.errors import CzError
from cz_gym.support.files import write_files
from cz_gym.support.names import unknown_name_message
from cz_gym.tools.registry import make_controller
from cz_gym.tools.report.tables import markdown

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
    """Its name, as ``python -m cz_gym.agents.from_sb3 --algo`` knows it."""
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
    """Rows of :data:`COLUMNS`: one learner and training seed, after each number of actions."""
    import torch
    from stable_baselines3.common.vec_env import VecNormalize

    from cz_gym.agents.export import to_agent
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
        judged = validate(agent, config, JUDGING)
        rows.append((learner.words, seed, actions, f"{judged.rmse_mm:.4f}", f"{judged.failure_rate:.4f}"))
    return rows


def report(rows: Sequence[Sequence[str]]) -> str:
    """The table of all runs."""
    groups = dict[tuple[str, str], list[Sequence[str]]]()
    order = [each.words for each in LEARNERS.values()]
    for row in sorted(rows, key=lambda row: (order.index(row[0]), int(row[2]), int(row[1]))):
        groups.setdefault((row[0], row[2]), []).append(row)
    config = make_config("randomized", None, "measured", action="direct")
    pid = validate(make_controller("paper-tuned", config), config, JUDGING).rmse_mm
    table = [
        (words, f"{int(steps) / MILLION:g} M", str(len(of)), " / ".join(f"{float(row[3]):.3f}" for row in of),
         " / ".join(f"{100.0 * float(row[4]):.1f}" for row in of))
        for (words, steps), of in groups.items()
    ]  # fmt: skip
    return "\n\n".join([ABOUT.format(crystals=len(JUDGING), pid=pid), markdown(HEADS, table)])


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m studies.stock", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("learners", nargs="*", metavar="LEARNER", help=f"of: {', '.join(LEARNERS)} (default: all)")
    parser.add_argument(
        "--seeds", type=between(1, 100), default=3, help="training seeds of each (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, default=Path("results/stock"), help="folder (default: %(default)s)")
    return parser.run(_main, arguments, "agents")


def _main(given: argparse.Namespace) -> None:
    for name in given.learners:
        if name not in LEARNERS:
            raise CzError(unknown_name_message("learner", name, LEARNERS))
    runs, table = given.out / "runs.csv", given.out / "table.md"
    rows = list(csv.reader(runs.read_text().splitlines()))[1:] if runs.exists() else []
    known = {each.words for each in LEARNERS.values()}
    if any(len(row) != len(COLUMNS) or row[0] not in known for row in rows):
        raise CzError(f"{runs}: no runs of this study, or damaged")
    done = {(row[0], row[1]) for row in rows}
    for seed in range(given.seeds):
        for name in given.learners or LEARNERS:
            if (LEARNERS[name].words, str(seed)) not in done:
                rows += [list(map(str, row)) for row in train(name, seed)]
                text = io.StringIO()
                csv.writer(text, lineterminator="\n").writerows([COLUMNS, *rows])
                write_files({runs: text.getvalue().encode()})
    write_files({table: f"{report(rows)}\n".encode()})
    print(table.read_text())


if __name__ == "__main__":
    sys.exit(main())
