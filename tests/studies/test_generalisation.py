"""Agents on other plants: the table's means, pairing and refusals."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cz_gym.evaluation.files import read_episodes
from studies.generalisation import __main__ as generalisation
from studies.generalisation.__main__ import figures, tabulate

HEAD = "scenario,controller,training_seed,seed,rmse_mm,rmse_observable_mm,failure_rate,pull_step_rms_mm_per_min"


def write(folder: Path, lines: list[str]) -> Path:
    path = folder / "episodes.csv"
    path.write_text("\n".join([HEAD, *lines]) + "\n")
    return path


def sample(folder: Path) -> Path:
    random, lines = np.random.default_rng(0), []
    for row in ("randomized", "puller"):
        level = random.uniform(0.05, 0.2, 6)
        for k in range(6):
            lines.append(f"{row},lqg,,{k},{level[k]},{level[k] / 2},0,0.02")
            lines += [f"{row},ppo,{s},{k},{level[k] + 0.01 * (s + 1)},{level[k] / 2 + 0.03},{s},0.03" for s in (0, 1)]
    return write(folder, lines)


def test_differences_are_paired_and_seeds_pooled(tmp_path: Path) -> None:
    cells = {(cell.row, cell.controller): cell for cell in tabulate(read_episodes(sample(tmp_path), figures), "lqg")}
    ppo = cells["randomized", "ppo"]
    assert ppo.seeds == 2
    assert ppo.apart.mean == pytest.approx(0.015)
    assert ppo.apart.ci95 == pytest.approx((0.01, 0.02))  # the crystals' spread is gone, the training seeds' is not
    assert ppo.lost.mean == 0.5
    assert ppo.worst - ppo.rmse.mean == pytest.approx(0.005)
    assert cells["puller", "ppo"].apart.ci95 == pytest.approx((0.03, 0.03))  # against what sensors can show
    assert cells["puller", "lqg"].apart.mean == 0.0


def test_the_table_is_printed_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample(tmp_path)
    assert generalisation.main([str(tmp_path), "--against", "lqg"]) == 0
    assert capsys.readouterr().out == (tmp_path / "table.md").read_text()
    assert "| randomized | +15 [+10, +20] |" in (tmp_path / "table.md").read_text()


@pytest.mark.parametrize(
    ("lines", "against", "message"),
    [
        ([], "lqg", "every controller and row needs the same crystals"),
        (["randomized,lqg,,0,x,0.1,0,0.02"], "lqg", "no episodes of a benchmark, or damaged"),
        (["randomized,lqg,,0,nan,0.1,0,0.02"], "lqg", "no episodes of a benchmark, or damaged"),
        (["hard,lqg,,0,0.1,0.1,0,0.02"], "paper", "'paper' took no part in 'hard'; choose from lqg"),
        (["hard,lqg,,0,0.1,0.1,0,0.02", "hard,a,,0,1,1,0,1", "hard,a,,1,1,1,0,1"], "lqg", "needs the same crystals"),
    ],
)
def test_what_cannot_be_tabulated_is_one_line(
    tmp_path: Path, lines: list[str], against: str, message: str, refused: Any
) -> None:
    write(tmp_path, lines)
    assert message in refused(generalisation.main, [str(tmp_path), "--against", against])
