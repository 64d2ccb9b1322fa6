"""The loop of plant and controller from their frequency responses, opened where it is to be judged.

Timing as in the environment: measure at t_k, act at once; the v_p and Q_H read at t_k are those applied before. The
same places as in the controllers' design table: at the camera, where the plant alone is uncertain, and at the pull
speed, where what a controller knows of its own pull speed counts as plant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.physics.linearisation import StateSpace

from .linear_agent import Complex, Floats

RING, PYROMETER = 0, 1


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
        """Drives by the ring, the pyrometer held: the controller with what it knows of itself, shape (points, 2)."""
        return _solve(np.eye(2) - self._recalled, self.controller[:, :, RING])

    def _without_camera(self) -> Complex:
        """Drives by what the camera is made to say, the pyrometer's loop closed, shape (points, 2)."""
        around = self._recalled + self.controller[:, :, PYROMETER, None] * self.plant[:, None, PYROMETER]
        return _solve(np.eye(2) - around, self.controller[:, :, RING])

    def closed(self) -> Complex:
        """Drives by the camera's noise, every loop closed, shape (points, 2)."""
        found: Complex = self._without_camera() / (1.0 + self.opened("camera"))[:, None]
        return found

    def opened(self, at: str) -> Complex:
        """Minus the way round the loop opened at "camera" or at "v_p", shape (points,)."""
        if at == "camera":
            camera: Complex = -np.einsum("ki,ki->k", self.plant[:, RING], self._without_camera())
            return camera
        if at != "v_p":
            raise ValueError(f"a loop is opened at camera or v_p, not {at!r}")
        around = self._recalled + self.controller[:, :, :2] @ self.plant
        heater = around[:, 1, 0] / (1.0 - around[:, 1, 1])
        pull: Complex = -(around[:, 0, 0] + around[:, 0, 1] * heater)
        return pull


def response(system: StateSpace, dt: float, omega: Floats) -> Complex:
    """Frequency response of a discrete state space of moderate order, shape (points, outputs, inputs)."""
    A, B, C, D = system
    z = np.exp(1j * omega * dt)
    found: Complex = C @ np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, np.broadcast_to(B, (len(z), *B.shape)))
    return found + D


def after_one(A: Floats, B: Floats, C: Floats, D: Floats, samples: int) -> Floats:
    """Outputs of a discrete system after one unit of its only input at t = 0, shape (samples, outputs)."""
    x, found = B[:, 0], [D[:, 0]]
    for _ in range(samples - 1):
        found.append(C @ x)
        x = A @ x
    return np.array(found)


def _solve(matrices: npt.NDArray[np.complex128], rights: npt.NDArray[np.complex128]) -> Complex:
    found: Complex = np.linalg.solve(matrices, rights[..., None])[..., 0]
    return found
