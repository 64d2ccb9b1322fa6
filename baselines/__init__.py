"""Classical controllers, all through the ``predict`` seam on "measured" observations."""

from __future__ import annotations

from .compensated_pid import CompensatedPID, Compensator, SeriesPID
from .open_loop import OpenLoop
from .policy import Policy

__all__ = ["CompensatedPID", "Compensator", "OpenLoop", "Policy", "SeriesPID"]
