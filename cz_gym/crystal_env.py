"""The environment of a whole crystal: ``gym.make("CzCrystal-v0")``, scalar and as a native batch."""

from typing import Any

from cz_gym.crystal.process import CRYSTAL
from cz_gym.env import CzEnv
from cz_gym.vector import CzVectorEnv


class CzCrystalEnv(CzEnv):
    """A whole Czochralski crystal: crown, body and tail along a recipe, seeing only the camera's bright ring.

    ## Action Space
    That of ``Cz-v0``, about the recipe's pull speed and heater power at the length grown: an action of zero follows the
    recipe.

    ## Observation Space
    "measured" (17 channels, :class:`cz_gym.crystal.signals.Measured`): ring, temperature and drives against the
    recipe's values at the length grown and 5 and 25 mm later, cone angle, length, weight. "history" (78), the default,
    adds the past, "state" (21) is the true state.

    ## Rewards
    Those of ``Cz-v0``, with the radius of the recipe at this length as reference, and the mean pull speed against the
    recipe's, relative to v_0.

    ## Starting State
    A state on the recipe of the drawn puller where the stage begins, the radius off by N(0, 0.2 mm) on "randomized".

    ## Episode End
    Terminated with ``info["succeeded"] = 1`` when the stage's length is reached. Terminated and lost when
    |r_c - r_ref| > 8 mm (12 mm in crown and tail), r_c < 2 mm, h_c < 0.6 mm or > 1.24 a, or the melt is below T_m.
    Truncated after 1.3 times the recipe's time of the longest stage.

    ## Arguments
    ``stage``: "crown" (from 10 mm radius to 60 mm of body), "body" (3 h from a drawn length), "tail" (from 50 mm before
    it), "whole", a dict of these with their shares of the episodes, or the length [m] at which three hours begin. The
    others are those of :class:`cz_gym.CzEnv`; ``puller``'s table ``[recipe]`` is the crystal.
    """

    def __init__(self, stage: Any = "crown", **settings: Any) -> None:
        super().__init__(process=CRYSTAL, stage=stage, **settings)


class CzCrystalVectorEnv(CzVectorEnv):
    """Many whole crystals at once; arguments of :class:`CzCrystalEnv` and :class:`cz_gym.CzVectorEnv`."""

    def __init__(self, num_envs: int = 1, stage: Any = "crown", **settings: Any) -> None:
        super().__init__(num_envs, process=CRYSTAL, stage=stage, **settings)
