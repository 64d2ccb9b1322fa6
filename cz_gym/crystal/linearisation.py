"""The crystal's plant along its recipe as control engineers write it: deviations from the recipe at each length.

The references run with the length, so a deviation is that from the recipe at the length that has been reached. With L
as clock, x' = f(x, u) and L' = v_g(x), it moves by A = df/dx - (f / v_g) dv_g/dx at the recipe, and so does B.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.plant import hidden_load
from cz_gym.episodes.record import Episode
from cz_gym.physics.linearisation import linearise
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.process import Inputs

from . import recipe
from .parameters import APART
from .plant import NO_DISTURBANCE, State, rates
from .process import CRYSTAL, nominal_recipe
from .signals import weight
from .task import end

Floats = npt.NDArray[np.float64]
STATES = (*State._fields[:5], "M_s")
"""Rows and columns of A: what changes within minutes, and the mass, which a load cell weighs; area and dopant are the
recipe's."""
_ROWS = [State._fields.index(name) for name in STATES]
INPUTS = (*Inputs._fields, "Q_d", "dT_i")
"""Columns of B."""
_POINTS = 256


class Along(NamedTuple):
    """The linearisation at lengths L [m], each of shape (points, ...)."""

    L: Floats
    A: Floats
    """Shape (points, 6, 6)."""
    B: Floats
    """Shape (points, 6, 4)."""
    C: Floats
    """The bright ring [m] and the load cell [N] by the states, shape (points, 2, 6)."""
    load: float
    """Heat load on the melt that comes with a kelvin of drift, which the recipe that is given follows [W/K]."""

    @property
    def a_h(self) -> Floats:
        """Rate with which the height's deviation dies out [rad/s]."""
        return -self.A[:, 1, 1]

    @property
    def c_h(self) -> Floats:
        """The ring by the height [-]."""
        return self.C[:, 0, 1]

    @property
    def zero(self) -> Floats:
        """Zero from pull speed to ring at constant temperature [rad/s]: the inverse response where it is positive."""
        rate: Floats = self.A[:, 0, 0] - self.C[:, 0, 0] * self.A[:, 0, 1] / self.c_h
        return rate


@lru_cache(maxsize=16)
def along(parameters: Any, meniscus: MeniscusModel, lam: float = 1.0) -> Along:
    """Linearise the design puller along its recipe, with this share of conduction [-]."""
    p, table = nominal_recipe(parameters._replace(**dict.fromkeys(APART, 0.0)), meniscus, lam)
    lengths = np.linspace(0.0, end(p), _POINTS)
    points = [_at(float(L), table, p, meniscus) for L in lengths]
    load = float(hidden_load(0.5, p) - hidden_load(-0.5, p))
    A, B, C = (np.stack(each) for each in zip(*points, strict=True))
    return Along(lengths, A, B, C, load)


def _at(L: float, table: Floats, p: Any, m: MeniscusModel) -> tuple[Floats, Floats, Floats]:
    """A, B and C at a length."""
    row, share = recipe.place(L, p)
    x = State(*map(float, recipe.state_at(L, table, p, Episode())))
    u = Inputs(*(float(recipe.look_up(table, row, share, at)) for at in (recipe._v_p, recipe._Q_H)))

    def seen(x: Any, u: Any, d: Any) -> Any:
        return x.r_c + m.ring_offset(x.r_c, x.h_c, p), weight(x, 0.0, p)

    model = linearise(CRYSTAL, p, m, (x, u, NO_DISTURBANCE), INPUTS[2:], seen)
    moves, length = np.array(rates(x, u, NO_DISTURBANCE, p, m)), State._fields.index("L")
    drift = moves / moves[length]
    A, B = model.A - np.outer(drift, model.A[length]), model.B - np.outer(drift, model.B[length])
    return A[np.ix_(_ROWS, _ROWS)], B[_ROWS], model.C[:, _ROWS]
