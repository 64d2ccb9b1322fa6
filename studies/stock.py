"""Stock learners on the environment as it comes: ``python -m studies.stock`` trains those of stable-baselines3.

Each is judged on validation crystals of ``randomized`` after one million steps and after two, with each training seed.
Runs that ``--out`` holds are not trained again.
"""

import argparse
import csv
import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from cz_gym.agents.export import to_agent
from cz_gym.agents.training.validation import JUDGING, validate
from cz_gym.baselines.registry import make_controller
from cz_gym.config import make_config
from cz_gym.errors import CzError
from cz_gym.evaluation.report.tables import markdown
from cz_gym.sb3 import make_vec_env
from cz_gym.support.atomic_files import write_files
from cz_gym.support.command_line import OneLineParser, between
from cz_gym.support.names import unknown

MILLION = 1_000_000
"""Steps after which a learner is judged, and again after as many."""


class Learner(NamedTuple):
    """stable-baselines3's PPO on its defaults, but for what a user would set."""

    crystals: int
    """Number of crystals at a time."""
    normalised: bool
    """Whether ``VecNormalize``, on its defaults, is around the environment."""
    learning_rate: float = 3e-4


LEARNERS = {
    "ppo, 8 crystals": Learner(8, normalised=False),
    "ppo, 8 crystals, VecNormalize": Learner(8, normalised=True),
    "ppo, 8 crystals, VecNormalize, smaller steps": Learner(8, normalised=True, learning_rate=3e-5),
    "ppo, 16 crystals, VecNormalize": Learner(16, normalised=True),
}
HEADS = ("learner", "steps", "training seeds", "RMSE of each seed [mm]", "lost of each seed [%]")
COLUMNS = ("learner", "seed", "steps", "rmse_mm", "lost")
ABOUT = """# Stock learners: stable-baselines3 on the environment as it comes

{crystals} validation crystals of `randomized` a training seed. The re-tuned PID, on the same crystals: {pid:.3f} mm."""


def train(name: str, seed: int) -> list[tuple[Any, ...]]:
    """Rows of :data:`COLUMNS`: one learner, one training seed, at each million steps."""
    torch.set_num_threads(1)
    learner, config = LEARNERS[name], make_config("randomized")
    env = make_vec_env(learner.crystals)
    env = VecNormalize(env) if learner.normalised else env
    model = PPO("MlpPolicy", env, learner.learning_rate, seed=seed, device="cpu")
    rows = list[tuple[Any, ...]]()
    for steps in (MILLION, 2 * MILLION):
        model.learn(MILLION, reset_num_timesteps=False)
        agent = to_agent(model, "stock", seed, config, model.get_vec_normalize_env(), "stock.onnx")
        judged = validate(agent, config, JUDGING)
        rows.append((name, seed, steps, f"{judged.rmse_mm:.4f}", f"{judged.failure_rate:.4f}"))
    return rows


def report(rows: Sequence[Sequence[str]]) -> str:
    """The table of all runs."""
    groups = dict[tuple[str, str], list[Sequence[str]]]()
    for row in sorted(rows, key=lambda row: (list(LEARNERS).index(row[0]), int(row[2]), int(row[1]))):
        groups.setdefault((row[0], row[2]), []).append(row)
    config = make_config("randomized", None, "measured", action="direct")
    pid = validate(make_controller("paper-tuned", config), config, JUDGING).rmse_mm
    table = [
        (name, f"{int(steps) / MILLION:g} M", str(len(of)), " / ".join(f"{float(row[3]):.3f}" for row in of),
         " / ".join(f"{100.0 * float(row[4]):.1f}" for row in of))
        for (name, steps), of in groups.items()
    ]  # fmt: skip
    return "\n\n".join([ABOUT.format(crystals=len(JUDGING), pid=pid), markdown(HEADS, table)])


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m studies.stock", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("learners", nargs="*", metavar="LEARNER", help=f"of: {'; '.join(LEARNERS)} (default: all)")
    parser.add_argument(
        "--seeds", type=between(1, 100), default=3, help="training seeds of each (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, default=Path("results/stock"), help="folder (default: %(default)s)")
    return parser.run(_main, arguments, "agents")


def _main(given: argparse.Namespace) -> None:
    for name in given.learners:
        if name not in LEARNERS:
            raise CzError(unknown("learner", name, LEARNERS))
    runs, table = given.out / "runs.csv", given.out / "table.md"
    rows = list(csv.reader(runs.read_text().splitlines()))[1:] if runs.exists() else []
    done = {(row[0], row[1]) for row in rows}
    for seed in range(given.seeds):
        for name in given.learners or LEARNERS:
            if (name, str(seed)) not in done:
                rows += [list(map(str, row)) for row in train(name, seed)]
                text = io.StringIO()
                csv.writer(text, lineterminator="\n").writerows([COLUMNS, *rows])
                write_files({runs: text.getvalue().encode(), table: f"{report(rows)}\n".encode()})
    print(table.read_text())


if __name__ == "__main__":
    sys.exit(main())
