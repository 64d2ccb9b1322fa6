"""What a picture is drawn from: one episode's samples so far, read from the environment and never written back."""

from __future__ import annotations

from enum import Enum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.physics.plant import Puller
from cz_gym.signals import INFO
from cz_gym.task import HEIGHT_MAX_IN_A, HEIGHT_MIN, RADIUS_LIMIT

Floats = npt.NDArray[np.float64]
_READ = ("r_c", "r_br", "r_ref", "h_c", "v_g", "v_p", "Q_H", "T_1", "T_1_ref", "T_b", "r_br_measured")
_ROWS = [INFO.index(name) for name in _READ]


class Sample(NamedTuple):
    """One instant, SI units: signals as the environment's ``info`` has them, then what a picture needs besides."""

    r_c: float
    r_br: float
    r_ref: float
    h_c: float
    v_g: float
    v_p: float
    Q_H: float
    T_1: float
    T_1_ref: float
    T_b: float
    camera: float
    """The camera's radius: the ring it reports minus the operator's bias [m]."""
    valid: float
    """1 if the camera says this reading is good, else 0."""
    t: float
    """Time since the episode's beginning [s]."""
    length: float
    """Length grown since the record began [m]."""


_AT = {name: column for column, name in enumerate(Sample._fields)}


class Ending(Enum):
    """How an episode ended, in words for a picture."""

    FROZEN = "FROZEN: meniscus too low"
    DETACHED = "DETACHED: meniscus too high"
    LOST = "RADIUS LOST: more than 8 mm off"
    HORIZON = "END OF THE RUN"


class Record:
    """The samples of one puller's episode, oldest first."""

    def __init__(self, config: Config, slot: Any, scenario: str) -> None:
        self.config = config
        self.scenario = scenario
        self.puller = Puller(*slot["puller"].tolist())
        self._terminated = self._truncated = False
        self._rows = np.zeros((config.steps + 1, len(Sample._fields)))
        self._read, self._first = 0, int(slot["k"])
        self._said: list[tuple[bytes, float]] = []

    def __len__(self) -> int:
        return len(self._said)

    @property
    def now(self) -> Sample:
        """The newest sample."""
        return Sample(*self._samples()[-1].tolist())

    @property
    def ending(self) -> Ending | None:
        """How the episode ended, None while it goes on."""
        if self._terminated:
            return how_it_failed(self.now, self.puller.a)
        return Ending.HORIZON if self._truncated else None

    def column(self, name: str) -> Floats:
        """All values of a sample's field, shape (samples,); not to be written to."""
        return self._samples()[:, _AT[name]]

    @property
    def error(self) -> Floats:
        """The true radius error of every sample [m], shape (samples,)."""
        return self.column("r_c") - self.column("r_ref")

    @property
    def seen_error(self) -> Floats:
        """The radius error of every sample by the camera [m], shape (samples,); NaN without a reading."""
        return np.where(self.column("valid") > 0.0, self.column("camera"), np.nan) - self.column("r_ref")

    def add(self, info: Floats, valid: float, terminated: bool = False, truncated: bool = False) -> None:
        """Add the sample of info rows (:data:`cz_gym.engine.layout.INFO`) and of the camera's word for its reading.

        It is only kept: what it means is worked out when somebody looks, since most steps are never drawn.
        """
        self._said.append((info.tobytes(), valid))
        self._terminated, self._truncated = terminated, truncated

    def _samples(self) -> Floats:
        """All samples, shape (samples, fields)."""
        while self._read < len(self._said):
            self._rows[self._read] = self._sample(*self._said[self._read])
            self._read += 1
        return self._rows[: self._read]

    def _sample(self, said: bytes, valid: float) -> Sample:
        """The next sample that nobody has looked at.

        The length grown is what the pull took up and the meniscus did not: h_c' = v_p - v_g, integrated exactly.
        """
        values = dict(zip(_READ, np.frombuffer(said)[_ROWS].tolist(), strict=True))
        values["camera"] = values.pop("r_br_measured") - self.puller.ring_bias
        t, length = (self._first + self._read) * self.config.control_interval, 0.0
        if self._read:
            before = Sample(*self._rows[self._read - 1].tolist())
            length = before.length + values["v_p"] * (t - before.t) - (values["h_c"] - before.h_c)
        return Sample(valid=valid, t=t, length=length, **values)

    def surface(self, height: float | None = None) -> tuple[Floats, Floats, Floats]:
        """The grown surface: radius, reference [m] and height above the melt [m], newest (lowest) first.

        What solidified when the crystal was L long is now at h_c + (L_now - L). ``height`` [m] above the triple
        point limits how much is returned.
        """
        now, length = self.now, self.column("length")
        # What was melted back is gone: its length is above one that came later.
        remains = length <= np.minimum.accumulate(length[::-1])[::-1]
        if height is not None:
            inside = np.flatnonzero(remains & (length >= now.length - height))
            remains[: max(int(inside[0]) - 1, 0)] = False
        z = now.h_c + (now.length - length[remains])
        return self.column("r_c")[remains][::-1], self.column("r_ref")[remains][::-1], z[::-1]


def how_it_failed(sample: Sample, a: float) -> Ending:
    """The limit that a failed sample broke, or came nearest to where the last substep was discarded."""
    room = {
        Ending.FROZEN: (sample.h_c - HEIGHT_MIN) / HEIGHT_MIN,
        Ending.DETACHED: (HEIGHT_MAX_IN_A * a - sample.h_c) / a,
        Ending.LOST: (RADIUS_LIMIT - abs(sample.r_c - sample.r_ref)) / RADIUS_LIMIT,
    }
    return min(room, key=lambda ending: room[ending])
