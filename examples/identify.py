"""From a puller's log to a report and a controller: ``python -m cz_gym.examples.identify LOG.csv start.toml my.toml``.

Without arguments a simulated puller makes the log. docs/your-puller.md explains each step.
"""

import sys
from pathlib import Path

from cz_gym import CzEnv, Parameters
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.puller.file import PullerFile, find_puller
from cz_gym.support.files import write_files
from cz_gym.tools.identify import Excited, identify, read_log, record_log
from cz_gym.tools.identify.command import puller_text, report
from cz_gym.tools.registry import make_controller


def make_log(path: str) -> str:
    """Log a simulated puller whose heater is not what the default file says."""
    other = PullerFile("other", Parameters(C_1=8e4, G_1a=24.0))
    env = CzEnv("randomized", observation="measured", action="direct", info="all", puller=other)
    record_log(env, Excited(make_controller("pid-conventional", env.config)), path, seed=1)
    return path


def main(log_file: str, start: str = "default", out: str = "runs/my.toml") -> float:
    """Write the puller file and its report; return the radius error of an LQG designed for it [mm]."""
    log = read_log(log_file)
    identified = identify(log, find_puller(start))
    pages = report(identified, log, log_file, Path(out).with_suffix(".md"))
    write_files(pages | {Path(out): puller_text(identified, log_file, Path(out).stem).encode()})
    config = make_config("randomized", observation="measured", action="direct", puller=out)
    return float(metrics(rollout(make_controller("lqg", config), config, range(20))).rmse_mm.mean())


if __name__ == "__main__":
    words = sys.argv[1:] or [make_log("runs/log.csv")]
    print(f"LQG for this puller: radius error {main(*words):.3f} mm")
