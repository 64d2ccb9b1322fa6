"""Excitation: a pseudo-random binary sequence on both drives, added to any controller.

A log of a controller alone cannot tell what the pull speed does, because every move answers a reading. Small moves that
answer nothing make it identifiable.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.signal import max_len_seq

from cz_gym.action import HEATER_RANGE, drives_of, mark
from cz_gym.body.plant import make_puller
from cz_gym.errors import CzError
from cz_gym.observation import DRIVE_CHANNELS, decode
from cz_gym.physics.parameters import Parameters
from cz_gym.support.units import MM

BITS = 7
CHIPS = 2**BITS - 1
"""Length of the sequence [chips]; the heater's is the same, half of it later."""
SEQUENCE = 2.0 * max_len_seq(BITS)[0] - 1.0


class Memory(NamedTuple):
    """What an excited policy remembers."""

    inner: Any
    step: npt.NDArray[np.int64]
    """Number of samples, shape (n,)."""
    added: npt.NDArray[np.float64]
    """Deviation of the drives by the excitation, in shares of their ranges, shape (n, 2)."""
    stopped: npt.NDArray[np.bool_]
    """Whether the radius error has ended the excitation, shape (n,)."""


@dataclass(frozen=True)
class Excited:
    """A policy whose drives also follow a maximal-length binary sequence.

    It ends for good where the ring is further than ``limit`` from its reference. The policy does not see the moves that
    are added, else one that moves from the applied drives would keep them. The drives' limits are those of the
    environment or plant. Takes "measured" observations, and "history" ones (whose past shows the excitation).
    """

    policy: Any
    pull: float = 0.025
    """Amplitude in shares of v_0 [-]; 0 for none."""
    heater: float = 0.025
    """Amplitude in shares of the nominal power [-]; 0 for none."""
    clock: float = 60.0
    """Length of a chip [s]."""
    limit: float = 1.5 * MM
    """Largest radius error, as the ring shows it [m]."""

    def __post_init__(self) -> None:
        if not (0.0 <= self.pull <= 0.1 and 0.0 <= self.heater <= 0.1):
            raise CzError(f"amplitudes of the excitation lie in 0 to 0.1, not {self.pull!r} and {self.heater!r}")
        if getattr(self.made_for, "puller", "default") != "default" and not hasattr(self.policy, "heater_range"):
            name = type(self.policy).__name__
            raise CzError(f"{name} does not say its puller's numbers: excite a controller that does")
        if not self.clock >= self.interval:
            raise CzError(f"the clock {self.clock!r} s must be at least the control interval of {self.interval:g} s")

    @property
    def interval(self) -> float:
        """Control interval [s]."""
        return float(getattr(self.policy, "control_interval", 5.0))

    @property
    def heater_range(self) -> float:
        """What an action of 1 moves the heater by [W]."""
        return float(getattr(self.policy, "heater_range", HEATER_RANGE))

    @property
    def made_for(self) -> Any:
        """What the policy was made for."""
        return getattr(self.policy, "made_for", None)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Memory]:
        """Return the action and the next memory; arguments as of :class:`cz_gym.baselines.policy.Policy`."""
        shown = np.array(observation, np.float64)
        seen, single = np.atleast_2d(shown), shown.ndim == 1
        n, parameters = len(seen), getattr(self.policy, "parameters", Parameters())
        begins = np.zeros(n, np.bool_) if episode_start is None else np.asarray(episode_start, np.bool_)
        if state is None:
            begins = np.ones(n, np.bool_)
        last = state or Memory(None, np.zeros(n, np.int64), np.zeros((n, 2)), begins)
        step, before = np.where(begins, 0, last.step), np.where(begins[:, None], 0.0, last.added)
        error = decode(seen, parameters.v_0, self.heater_range).ring_error
        stopped = (last.stopped & ~begins) | (np.abs(error) > self.limit)
        chip = (step * self.interval / self.clock + 1e-9).astype(np.int64)
        size = self.pull, self.heater * make_puller(parameters).Q_H_0 / self.heater_range
        signs = np.stack([SEQUENCE[chip % CHIPS], SEQUENCE[(chip + CHIPS // 2) % CHIPS]], axis=1)
        wanted = np.where(stopped[:, None], 0.0, size * signs)
        seen[:, list(DRIVE_CHANNELS)] -= before
        action, inner = self.policy.predict(shown.astype(np.float32), last.inner, episode_start, deterministic)
        drives = drives_of(str(getattr(self.made_for or self.policy, "action", "direct")), self.interval)
        given = np.atleast_2d(np.asarray(action, np.float64))
        out = np.clip(given + drives.asked(wanted, before), -1.0, 1.0)
        added = drives.keep * before + (out - given) * (drives.pull, drives.heater)
        marked = mark((out[0] if single else out).astype(np.float32), self.made_for)
        return marked, Memory(inner, step + 1, added, stopped)
