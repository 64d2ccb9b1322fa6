"""Controllers near rest, and their loops with the plant, opened where margins are taken.

Timing as in the environment: measure at t_k, act at once; the v_p and Q_H read at t_k are those applied before. The
same places as in the controllers' design table: at the camera, where the plant alone is uncertain, and at the pull
speed, where what a controller knows of its own pull speed counts as plant.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.signal import dimpulse
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from cz_gym.baselines.analysis import frequency, sampled_loop
from cz_gym.errors import CzError
from cz_gym.physics.linearisation import Floats, StateSpace
from cz_gym.physics.plant import make_puller
from cz_gym.units import HOUR, KILO, MM, MM_PER_MIN

from .linear_agent import AT
from .step_tests import MIX, Interface

Complex = npt.NDArray[np.complex128]
RING, PYROMETER = 0, 1
A_CRYSTAL = 3.0 * HOUR
"""How long a crystal is grown [s]."""
BANDS = (1e-4, 1e-3, 1e-2, 0.1, 0.3)
"""Edges of the bands of frequency [rad/s] in which local gains are compared."""
READING_SAMPLES, NOISE_POINTS = 120, 20_000
"""Length of the answer to one reading; frequencies that a variance is summed over."""


class Contender(NamedTuple):
    """A controller, and what it is near rest."""

    name: str
    interface: Interface
    make: Callable[[Any], Any]
    """Builds it for an environment's settings."""
    system: StateSpace
    """Readings of MEASURED to v_p [m/s] and Q_H [W]."""

    def loop(self, omega: Floats, lam: float, dt: float) -> Responses:
        """With a nominal puller, at some frequencies."""
        plant = sampled_loop.sampled_plant(make_puller(lam=lam), dt)
        own = response(self.system, dt, omega)[:, :, AT]
        return Responses(omega, own, response(plant, dt, omega)[:, 1:, :2], dt)


class Responses(NamedTuple):
    """Controller and plant at some frequencies."""

    omega: Floats
    """[rad/s], shape (points,)."""
    controller: Complex
    """Drives asked for [m/s, W] by ring [m], pyrometer [K] and applied drives [m/s, W], shape (points, 2, 4)."""
    plant: Complex
    """Ring [m] and pyrometer [K] by the applied drives, shape (points, 2, 2)."""
    dt: float
    """Control interval [s]."""

    @property
    def _recalled(self) -> Complex:
        """Drives asked for by drives applied, one sample later."""
        late = np.exp(-1j * self.omega * self.dt)
        found: Complex = self.controller[:, :, 2:] * late[:, None, None]
        return found

    def drives(self) -> Complex:
        """Drives by the ring, pyrometer constant: the controller with what it knows of itself, shape (points, 2)."""
        return _solve(np.eye(2) - self._recalled, self.controller[:, :, RING])

    def _without_camera(self) -> Complex:
        """Drives by an error of the camera, the pyrometer's loop closed, shape (points, 2)."""
        around = self._recalled + self.controller[:, :, PYROMETER, None] * self.plant[:, None, PYROMETER]
        return _solve(np.eye(2) - around, self.controller[:, :, RING])

    def closed(self) -> Complex:
        """Drives by the camera's noise, every loop closed, shape (points, 2)."""
        return self._without_camera() / (1.0 + self.opened("camera"))[:, None]

    def opened(self, at: str) -> Complex:
        """Minus the way round the loop opened at "camera" or at "v_p", shape (points,)."""
        if at == "camera":
            camera: Complex = -np.einsum("ki,ki->k", self.plant[:, RING], self._without_camera())
            return camera
        if at != "v_p":
            raise CzError(f"a loop is opened at camera or v_p, not {at!r}")
        around = self._recalled + self.controller[:, :, :2] @ self.plant
        heater = around[:, 1, 0] / (1.0 - around[:, 1, 1])
        return -(around[:, 0, 0] + around[:, 0, 1] * heater)


def response(system: StateSpace, dt: float, omega: Floats) -> Complex:
    """Frequency response of a discrete state space, which may be large if it is sparse, (points, outputs, inputs)."""
    A, B, C, D = csc_array(system.A), system.B.astype(np.complex128), system.C, system.D
    one = csc_array(np.eye(len(B)))
    return np.stack([C @ splu(z * one - A).solve(B) + D for z in np.exp(1j * omega * dt)])


def _solve(matrices: Any, rights: Any) -> Complex:
    found: Any = np.linalg.solve(matrices, rights[..., None])
    return np.asarray(found[..., 0], np.complex128)


def one_reading(contender: Contender, dt: float) -> Floats:
    """Drives after one reading of the ring that is a metre too large, loop closed, shape (samples, 2)."""
    loop = sampled_loop.close(contender.system, make_puller(lam=MIX), dt)
    parts = (loop.pick(drive, ("camera",)) for drive in ("v_p", "Q_H"))
    return np.hstack([dimpulse((*part, dt), n=READING_SAMPLES)[1][0] for part in parts])


def margins(contender: Contender, omega: Floats, dt: float) -> list[dict[str, Any]]:
    """Margins at both places on both models; NaN where something grows within a crystal.

    ``growth`` is the time in which what grows fastest in the closed loop grows by e [s], infinite if nothing does. What
    grows more slowly than a crystal is a network's use of its integral: no crystal feels it, and margins leave it out.
    """
    rows = []
    for plant, lam in (("Model I", 1.0), ("Model II", 0.0)):
        growth = sampled_loop.close(contender.system, make_puller(lam=lam), dt).growth
        loop = contender.loop(omega, lam, dt)
        for at in ("camera", "v_p"):
            found = frequency.margins_of(loop.opened(at), omega, dt, growth > A_CRYSTAL)
            row = {"controller": contender.name, "plant": plant, "at": at, "growth": growth}
            rows.append(row | found._asdict())
    return rows


def noise_gains(contender: Contender, dt: float) -> dict[str, float]:
    """RMS of the drives and of the pull speed's steps per white camera noise RMS, both models' mean puller."""
    omega = (np.arange(NOISE_POINTS) + 0.5) * np.pi / dt / NOISE_POINTS
    pull, heater = contender.loop(omega, MIX, dt).closed().T
    step = pull * (1.0 - np.exp(-1j * omega * dt))
    return {
        name: float(np.sqrt(np.mean(np.abs(values) ** 2)) * MM / unit)
        for name, values, unit in (
            ("pull_mm_per_min_per_mm", pull, MM_PER_MIN),
            ("pull_step_mm_per_min_per_mm", step, MM_PER_MIN),
            ("heater_kw_per_mm", heater, KILO),
        )
    }


def apart(contender: Contender, other: Contender, dt: float) -> dict[str, list[float]]:
    """Largest relative deviation of one's local gains from the ring from another's, by drive, in each of BANDS.

    The pyrometer is constant, and each knows what it asked of its own drives.
    """
    found: dict[str, list[float]] = {"pull speed": [], "heater": []}
    for low, high in pairwise(BANDS):
        omega = np.geomspace(low, high, 200)
        mine, its = (each.loop(omega, MIX, dt).drives() for each in (contender, other))
        for drive, deviation in zip(found, np.abs(mine / its - 1.0).max(axis=0), strict=True):
            found[drive].append(float(deviation))
    return found
