"""The golden trajectories; ``python -m tests.golden.trajectories`` writes them anew, after a meant change of physics.

Every scenario under both models: a fixed feedback on the true state with a fixed dither, 40 min at 10 s, written out
every 20 min: state, ring as measured, references, and the sum of the rewards so far.
"""

import json
from pathlib import Path

import numpy as np

from cz_gym import SCENARIOS, CzEnv, Parameters
from tests.observed import PLAIN

FILE = Path(__file__).with_name("trajectories.json")
SIGNALS = ("r_c", "h_c", "T_1", "T_b", "Q_H", "r_br_measured", "r_ref", "T_1_ref", "v_g")
SEED, STEPS, EVERY = 12, 240, 120


def trajectory(scenario: str, model: str, parameters: Parameters | None = None) -> list[list[float]]:
    """A row every 20 min: the signals in SI units, and the return so far."""
    env = CzEnv(scenario, model, control_interval=10.0, horizon=2400.0, parameters=parameters, info="all", **PLAIN)
    _, info = env.reset(seed=SEED)
    rows, earned, begun = [], 0.0, info["h_c"]
    for k in range(STEPS):
        dither = 0.05 * np.sin(0.13 * k), 0.3 * np.sin(0.05 * k)
        pull = 400.0 * (info["r_c"] - info["r_ref"]) - 300.0 * (info["h_c"] - begun) + dither[0]
        _, gained, terminated, _, info = env.step(np.array([pull, dither[1]]))
        earned += gained
        if terminated:
            raise AssertionError(f"{scenario}, {model}: the golden crystal failed at step {k}")
        if (k + 1) % EVERY == 0:
            rows.append([*(info[name] for name in SIGNALS), earned])
    return rows


def trajectories() -> dict[str, list[list[float]]]:
    """All of them, by scenario and model."""
    return {f"{name}, {model}": trajectory(name, model) for name in SCENARIOS for model in ("I", "II")}


if __name__ == "__main__":
    lines = [f"{json.dumps(name)}: {json.dumps(rows)}" for name, rows in trajectories().items()]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")
