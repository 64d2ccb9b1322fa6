"""The page on which a visitor pulls a crystal, docs/_root/play.html: ``python -m studies.play`` writes its crystals.

The page has the plant in a script of its own, which a test compares with the environment. The crystals are the first
test crystals of ``randomized`` (puller, ramps, random series) and how two controllers grew them.
"""

import argparse
import base64
import json
import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.clairvoyant import pullers_of
from cz_gym.body import signals
from cz_gym.config import Config, make_config
from cz_gym.engine.batch import first_key
from cz_gym.episodes.draw import episode_from_key, new_series
from cz_gym.episodes.scenario import GRID
from cz_gym.evaluation.metrics import metrics, radius_error
from cz_gym.evaluation.protocol import TEST_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.plant import HEIGHT_MAX_IN_A, HEIGHT_MIN
from cz_gym.support.errors import CzError
from cz_gym.support.files import name_file_in_errors, write_files
from cz_gym.support.units import MINUTE, MM, MM_PER_MIN
from cz_gym.tools.registry import make_controller

from . import StudyParser

PAGE = Path("docs/_root/play.html")
SEEDS = TEST_SEEDS[:5]
RIVALS = ("paper", "lqg")
PLACE = re.compile(r'(?<=<script type="application/json" id="data">\n).*?(?=</script>)', re.DOTALL)
"""The part of the page that this command writes."""
SHOWN = 6
"""Steps between points of a controller's curves."""
CAMERA_UNIT, PYROMETER_UNIT = 2e-6, 0.005
"""Units of the written noise of the ring [m] and of the pyrometer [K]."""
PULL_UNIT = 1e-3 * MM_PER_MIN
"""Unit of the written pull speed [m/s]."""


def content(config: Config, seeds: Sequence[int], rivals: Sequence[str] = RIVALS) -> dict[str, Any]:
    """Content of the page about these crystals: numbers in SI units, arrays as base64 of little-endian numbers."""
    speed, power = config.ranges
    task = {
        "interval": config.control_interval, "steps": config.steps, "grid": GRID, "scenario": config.scenario.name,
        "radius_limit": config.radius_limit, "height_min": HEIGHT_MIN, "height_max_in_a": HEIGHT_MAX_IN_A,
        "speed": speed, "power": power,
        "weights": list(config.weights), "scales": list(signals.SCALES),
        "pull_tolerance": signals.PULL_TOLERANCE, "pull_memory": signals.PULL_MEMORY,
        "camera_unit": CAMERA_UNIT, "pyrometer_unit": PYROMETER_UNIT, "pull_unit": PULL_UNIT, "shown": SHOWN,
    }  # fmt: skip
    crystals = [_crystal(config, seed) for seed in seeds]
    for name in rivals:
        for crystal, recording in zip(crystals, _recordings(config, seeds, name), strict=True):
            crystal["rivals"][name] = recording
    return {"task": task, "crystals": crystals}


def _crystal(config: Config, seed: int) -> dict[str, Any]:
    """A crystal's puller, ramps and random series."""
    points = round(config.steps * config.control_interval / GRID) + 1
    series = new_series(points, config.steps + 1)
    episode = episode_from_key(config.sole_scenario, first_key(seed), series)
    noise = np.clip(np.rint(series.noise / (CAMERA_UNIT, PYROMETER_UNIT)), -127, 127)
    return {
        "seed": seed,
        "puller": pullers_of(config, [seed])[0]._asdict(),
        "episode": {name: value if math.isfinite(value) else None for name, value in episode._asdict().items()},
        "dT_i": _packed(series.interface, "<f8"),
        "camera": _packed(noise[:, 0], "i1"),
        "pyrometer": _packed(noise[:, 1], "i1"),
        "rivals": {},
    }


def _recordings(config: Config, seeds: Sequence[int], name: str) -> list[dict[str, Any]]:
    """Curves of a controller on each crystal: true radius error, pull speed, RMSE and cost so far."""
    run = rollout(make_controller(name, config), config, seeds)
    final, error, s = metrics(run), radius_error(run), run.signals
    limit = config.process.cost_terms(signals.Cost(config.radius_limit, 0.0, 0.0, 0.0), config.weights).radius
    per_step = sum(getattr(s, f"term_{term}") for term in signals.Cost._fields)
    counts, minute = np.arange(1, config.steps + 1)[:, None], round(MINUTE / config.control_interval)
    lost = run.failed & (counts >= run.alive.sum(axis=0))
    rmse = np.sqrt(np.cumsum(np.square(error), axis=0) / counts) / MM
    cost = np.cumsum(np.where(lost, limit, per_step), axis=0) / counts
    every, minutes = slice(SHOWN - 1, None, SHOWN), slice(minute - 1, None, minute)
    return [
        {
            "rmse_mm": float(final.rmse_mm[i]),
            "cost": float(final.cost[i]),
            "lost_at": int(run.alive[:, i].sum()) if run.failed[i] else None,
            "rmse_so_far": _packed(rmse[minutes, i], "<f4"),
            "cost_so_far": _packed(cost[minutes, i], "<f4"),
            "error": _packed(np.rint(error[every, i] / (1e-3 * MM)), "<i2"),
            "v_p": _packed(np.rint(s.v_p[every, i] / PULL_UNIT), "<i2"),
        }
        for i in range(len(seeds))
    ]


def _packed(values: npt.NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode()


def to_text(data: dict[str, Any]) -> str:
    """The page's data as JSON, a line for the task and one for each crystal."""
    lines = ",\n".join(json.dumps(crystal, allow_nan=False) for crystal in data["crystals"])
    return f'{{"task": {json.dumps(data["task"])}, "crystals": [\n{lines}\n]}}\n'


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return StudyParser("play", __doc__, str(PAGE)).run(_main, arguments)


def _main(given: argparse.Namespace) -> None:
    with name_file_in_errors(PAGE):
        page = PAGE.read_text("utf-8")
    if not PLACE.search(page):
        raise CzError(f"{PAGE}: no place for crystals")
    text = to_text(content(make_config("randomized", None, "measured", action="direct"), SEEDS))
    write_files({given.out: PLACE.sub(lambda _: text, page, count=1).encode()})
    print(f"wrote {given.out}")


if __name__ == "__main__":
    sys.exit(main())
