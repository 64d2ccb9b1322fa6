"""Algorithms side by side: ``python -m studies.algorithms`` trains each for as many steps on the same observations.

PPO, recurrent PPO and SAC from nothing, and ``ppo-quiet``, which begins with an imitation. All learn for the
environment's reward. They are judged on the crystals of :mod:`studies.comparison.runs`, validation that selects
nothing. Finished runs are kept; the same command goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cz_gym.agents.training.recipes import PPO, RECIPES, Choice, Clone, CostWeights, Recipe
from cz_gym.commands import OneLineParser, guarded
from cz_gym.config import make_config
from studies.ablation.rows import Row

PROG = "python -m studies.algorithms"


def _row(name: str, about: str, meaning: str) -> Row:
    return Row(name, about, meaning, RECIPES[name])


ROWS = (
    _row("ppo-scratch", "from nothing", "PPO; the critic also sees the true state"),
    _row("ppo-recurrent", "from nothing", "PPO of an LSTM, actor and critic (sb3-contrib); both see what is measured"),
    _row("sac", "from nothing", "soft actor-critic; both see what is measured"),
    Row(
        "ppo-quiet",
        "from an imitation",
        "imitates lqg-quiet, then PPO; the critic also sees the true state (the shipped recipe of that name imitates"
        " one that is told)",
        PPO("ppo-quiet", Recipe(weights=CostWeights(), clone=Clone("lqg-quiet"))),
    ),
)
"""Every row, in the order of the table."""
WEIGHTS = CostWeights()
"""Of the cost that all learn for and are judged by: the environment's reward."""


def plant_steps(choice: Choice, steps: int) -> int:
    """Control intervals that the plant is run for: those learned from, the imitation's, and those of the pair."""
    clone = choice.recipe.clone
    shown = clone.rounds * clone.episodes * make_config(choice.recipe.scenario).steps if clone else 0
    return shown + steps * (2 if isinstance(choice, PPO) and choice.paired else 1)


def to_markdown(lines: Sequence[Any], curves: Mapping[str, Sequence[Any]], steps: int, lqgs: Any) -> str:
    """``table.md``."""
    from cz_gym.agents.training.validation import JUDGING
    from studies.ablation.table import at_equal_activity
    from studies.comparison.lqg_family import rivals_table

    heads = ("algorithm", "begins", "training seeds", "RMSE [mm]", "worst seed [mm]", "lost [%]", "pull steps [mm/min]",
             "at equal activity", "reward's cost", "before learning [mm]",
             "plant steps [million]", "minutes a run")  # fmt: skip
    found = [
        "# Algorithms side by side",
        "",
        f"{steps:,} environment steps of learning a run, the same reward and the same 72 channels of history, judged"
        f" on {len(JUDGING)} validation crystals of `randomized` that select nothing: of each run the agent that did"
        " best on those that select."
        " In brackets: 95 % intervals, bootstrap over training seeds and crystals. A lost crystal counts 8 mm."
        " *At equal activity*: RMSE over what the LQG's frontier has at those pull steps; 1 is as good."
        " Plant steps count the imitation and the teacher's twin of each crystal too.",
        "",
        "| " + " | ".join(heads) + " |",
        "|---|---" + "|--:" * (len(heads) - 2) + "|",
    ]
    for line in lines:
        runs = curves[line.row.name]
        rmse, cost = line.cells["best", "rmse_mm"].mean, line.cells["best", "reward_cost"].mean
        start = line.cells.get(("start", "rmse_mm"))
        minutes = sum(run["validations"][-1]["seconds"] for run in runs) / len(runs) / 60.0
        worst = max(sum(run["stages"]["best"]["rmse_mm"]) / len(JUDGING) for run in runs)
        cells = (
            line.row.name,
            line.row.about,
            f"{len(line.seeds)}",
            f"{rmse.mean:.3f} [{rmse.ci95[0]:.3f}, {rmse.ci95[1]:.3f}]",
            f"{worst:.3f}",
            f"{100.0 * line.cells['best', 'failure_rate'].mean.mean:.1f}",
            f"{line.cells['best', 'pull_step_rms_mm_per_min'].mean.mean:.4f}",
            at_equal_activity(line, lqgs),
            f"{cost.mean:.3f} [{cost.ci95[0]:.3f}, {cost.ci95[1]:.3f}]",
            f"{start.mean.mean:.3f}" if start else "-",
            f"{1e-6 * plant_steps(line.row.choice, steps):.1f}",
            f"{minutes:.0f}",
        )
        found.append("| " + " | ".join(cells) + " |")
    found += ["", *(f"- **{line.row.name}**: {line.row.meaning}" for line in lines)]
    found += ["", "The LQG's settings on the same crystals:", "", *rivals_table(lqgs)]
    return "\n".join(found) + "\n"


def curve_figure(curves: Mapping[str, Sequence[Any]]) -> bytes:
    """Validation RMSE while learning, a line a run; ``curves`` holds the kept runs by row."""
    from cz_gym.evaluation.report.canvas import canvas, png, styles

    figure = canvas(6.4, 3.8)
    axis = figure.subplots()
    for (name, runs), style in zip(curves.items(), styles(tuple(curves)).values(), strict=True):
        for i, run in enumerate(runs):
            steps = [each["steps"] / 1e3 for each in run["validations"]]
            error = [each["validation_rmse_mm"] for each in run["validations"]]
            axis.plot(
                steps, error, color=style.colour, marker=style.marker, ms=3.5, lw=1.3, label=name if not i else None
            )
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter(lambda value, position: f"{value:g}")
    axis.set_xlabel("environment steps [thousand]")
    axis.set_ylabel("validation RMSE of the radius [mm]")
    figure.legend(loc="outside lower center", ncols=len(curves), frameon=False, fontsize=9)
    figure.suptitle("Learning, one line a training seed", fontsize=11)
    return png(figure)


def _write(plan: Any, seeds: Sequence[int]) -> None:
    from cz_gym.atomic_files import write_files
    from studies.ablation.table import tabulate, to_csv
    from studies.comparison.lqg_family import rivals
    from studies.comparison.runs import path_of, read_all

    runs = read_all(plan, ROWS, seeds)
    if not runs:
        return
    lines = tabulate(ROWS, runs)
    told = {
        line.row.name: [json.loads(path_of(plan, line.row, seed).read_bytes()) for seed in line.seeds] for line in lines
    }
    files = {
        "table.csv": to_csv(lines).encode(),
        "table.md": to_markdown(lines, told, plan.steps, rivals(plan)).encode(),
        "curves.png": curve_figure(told),
    }
    write_files({plan.out / name: content for name, content in files.items()})


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog=PROG, description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, default=3, help="training seeds a row (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=400_000, help="environment steps a run (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="runs at once (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("results/algorithms"), help="results (default: %(default)s)")
    parser.add_argument(
        "--work", type=Path, default=Path("runs/algorithms"), help="unfinished runs (default: %(default)s)"
    )
    args = parser.parse_args(arguments)
    left = "finished runs are kept, and the same command goes on from the others' checkpoints"
    return guarded(PROG, lambda: _main(args), "agents,benchmark", left)


def _main(args: argparse.Namespace) -> int:
    for name, most in (("seeds", 100), ("steps", 10**9), ("jobs", 64)):
        if not 1 <= getattr(args, name) <= most:
            raise ValueError(f"--{name} must be between 1 and {most}, not {getattr(args, name)}")
    from cz_gym.atomic_files import check_writable, locked
    from studies.comparison.jobs import missing, run_all
    from studies.comparison.runs import Plan

    plan, seeds = Plan(args.steps, args.out, args.work, WEIGHTS), range(args.seeds)
    check_writable(plan.out)
    with locked(plan.work):
        # Seed by seed, so that a stopped comparison holds every algorithm.
        tasks = missing(plan, [(row, seed) for seed in seeds for row in ROWS])
        run_all(plan, tasks, args.jobs, lambda: _write(plan, seeds))
        _write(plan, seeds)
    print(f"wrote {args.out / 'table.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
