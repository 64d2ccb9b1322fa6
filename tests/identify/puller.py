"""A puller whose hot zone differs from the default's."""

from dataclasses import replace

from cz_gym import CzEnv, Parameters
from cz_gym.episodes.scenario import Pullers
from cz_gym.episodes.scenarios import RANDOMIZED

TRUTH = Parameters()._replace(C_1=8e4, C_2=7.5e4, kappa_12=3.4e-8, G_1a=24.0, G_2b=250.0, eps=0.25, sigma=0.75)
OWN = replace(RANDOMIZED, name="own", pullers=Pullers(start_radius_sd=2e-4))


def puller_env(horizon: float = 10_800.0) -> CzEnv:
    given = {"observation": "measured", "action": "direct", "info": "all"}
    return CzEnv(scenario=OWN, model=0.5, horizon=horizon, parameters=TRUTH, **given)
