"""The samples of one episode so far, from which its pictures are drawn."""

from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.body.task import HEIGHT_MAX_IN_A, HEIGHT_MIN
from cz_gym.config import Config
from cz_gym.crystal import recipe, task
from cz_gym.crystal.process import CRYSTAL

DRAWN = frozenset({"r_c", "r_ref", "r_br", "r_br_measured", "h_c", "v_p", "Q_H", "T_1", "T_1_ref", "T_b"})
"""Rows of ``info`` that a picture shows; a process without them has none."""
Floats = npt.NDArray[np.float64]


class Ending(Enum):
    """How an episode ended, in words for a picture."""

    FROZEN = "FROZEN: meniscus too low"
    DETACHED = "DETACHED: meniscus too high"
    LOST = "RADIUS LOST: too far off"
    COLD = "FROZEN: melt below its melting point"
    HORIZON = "END OF THE RUN"
    DONE = "GROWN: the length is reached"


class Record:
    """The samples of one episode, oldest first: signals of ``info`` in SI units, and quantities derived from them."""

    def __init__(self, config: Config, slot: Any, scenario: str) -> None:
        self.config, self.scenario = config, scenario
        self.puller = config.process.Constants(*slot["puller"].tolist())
        self.ending: Ending | None = None
        """How the episode ended; None while it goes on."""
        self._first = int(slot["k"])
        self._column = {name: column for column, name in enumerate((*config.process.info, "valid"))}
        self._samples, self._count = np.zeros((config.steps + 1, len(self._column))), 0

    def __len__(self) -> int:
        return self._count

    def add(self, info: Floats, valid: float, terminated: bool = False, truncated: bool = False) -> None:
        """Add a sample: the row of info, and 1 if the camera's reading is valid."""
        row = self._samples[self._count]
        row[:-1], row[-1] = info, valid
        self._count += 1
        if terminated:
            self.ending = self._end()
        elif truncated:
            self.ending = Ending.HORIZON

    def column(self, name: str) -> Floats:
        """All values of a signal of ``info``, or of "valid", shape (samples,)."""
        return self._samples[: self._count, self._column[name]]

    def last(self, name: str) -> float:
        """The newest value of a :meth:`column`."""
        return float(self._samples[self._count - 1, self._column[name]])

    @property
    def t(self) -> Floats:
        """Time of every sample since the episode began [s]."""
        samples: Floats = self._first + np.arange(self._count, dtype=np.float64)
        return samples * self.config.control_interval

    @property
    def error(self) -> Floats:
        """True radius error of every sample [m]."""
        return self.column("r_c") - self.column("r_ref")

    @property
    def nominal(self) -> tuple[float, float, float]:
        """Nominal pull speed [m/s], heater power [W] and melt temperature [K] now."""
        return self.puller.v_0, self.puller.Q_H_0, self.puller.T_b_0

    @property
    def ring_bias(self) -> Any:
        """What the operator takes off the ring [m]."""
        return self.puller.ring_bias

    @property
    def lowest(self) -> float:
        """Lowest meniscus before it freezes [m]."""
        return HEIGHT_MIN

    @property
    def camera_error(self) -> Floats:
        """Radius error of every sample by the camera, its operator's bias subtracted [m]; NaN without a reading."""
        radius = self.column("r_br_measured") - self.ring_bias
        return np.where(self.column("valid") > 0.0, radius, np.nan) - self.column("r_ref")

    @property
    def length(self) -> Floats:
        """Length grown at every sample since the record began [m]: what was pulled less what the meniscus rose."""
        pulled: Floats = np.cumsum(self.column("v_p")) - self.column("v_p")[0]
        length: Floats = pulled * self.config.control_interval - (self.column("h_c") - self.column("h_c")[0])
        return length

    def surface(self, height: float = np.inf) -> tuple[Floats, Floats, Floats]:
        """The grown surface: radius, reference [m] and height above the melt [m], newest (lowest) first.

        A ring that solidified at length L is now at the height h_c + (L_now - L). The surface ends just above
        ``height`` [m] over the triple point.
        """
        length = self.length
        # Crystal that was melted back again is left out: the length was smaller at a later sample.
        remains = length <= np.minimum.accumulate(length[::-1])[::-1]
        inside = np.flatnonzero(remains & (length >= length[-1] - height))
        remains[: max(int(inside[0]) - 1, 0)] = False
        z = self.last("h_c") + (length[-1] - length[remains])
        return self.column("r_c")[remains][::-1], self.column("r_ref")[remains][::-1], z[::-1]

    def _end(self) -> Ending:
        """The limit that the newest sample broke, or came nearest to where its last substep was discarded."""
        h_c, a = self.last("h_c"), self.puller.a
        room = {
            Ending.FROZEN: (h_c - HEIGHT_MIN) / HEIGHT_MIN,
            Ending.DETACHED: (HEIGHT_MAX_IN_A * a - h_c) / a,
            Ending.LOST: 1.0 - abs(self.error[-1]) / self.config.radius_limit,
        }
        return min(room, key=lambda ending: float(room[ending]))


class CrystalRecord(Record):
    """The samples of a whole crystal: its references are those of the recipe at the length grown."""

    def __init__(self, config: Config, slot: Any, scenario: str) -> None:
        super().__init__(config, slot, scenario)
        self.table = np.array(slot["table"])

    @property
    def nominal(self) -> tuple[float, float, float]:
        """The recipe's pull speed [m/s], heater power [W] and melt temperature [K] now."""
        return self.last("v_p_ref"), self.last("Q_H_ref"), float(self._recipe(recipe._T_b)[-1])

    @property
    def ring_bias(self) -> Any:
        """The recipe's ring less its radius at each sample [m]."""
        return self._recipe(recipe._ring)

    def _recipe(self, column: int) -> Floats:
        """A column of the recipe at each sample's length."""
        place = self.column("L") / recipe.spacing(self.puller) + recipe.MARGIN
        values: Floats = np.interp(place, np.arange(recipe.ROWS), self.table[:, column])
        return values

    @property
    def lowest(self) -> float:
        """Lowest meniscus before it freezes [m]."""
        return task.HEIGHT_MIN

    @property
    def length(self) -> Floats:
        """Length grown since the crown began, at every sample [m]."""
        return self.column("L")

    def _end(self) -> Ending:
        if self.last("succeeded") > 0.0:
            return Ending.DONE
        at = self.config.process.Logged(*self._samples[self._count - 1, :-1])
        rooms = task.room(at, self.config.radius_limit, self.config.parameters)
        return (Ending.FROZEN, Ending.DETACHED, Ending.LOST, Ending.COLD)[int(np.argmin(rooms))]


def record_for(config: Config, slot: Any, scenario: str) -> Record:
    """An empty record for an episode of an environment."""
    return (CrystalRecord if config.process == CRYSTAL else Record)(config, slot, scenario)
