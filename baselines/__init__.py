"""Classical controllers, all through the method ``predict`` on "measured" observations."""

if __name__ != "cz_gym.baselines":
    raise ImportError("import cz_gym.baselines: the folder baselines is that package, under no other name")

from .pid import CompensatedPID, Compensator, SeriesPID
from .policy import OpenLoop, Policy

__all__ = ["CompensatedPID", "Compensator", "OpenLoop", "Policy", "SeriesPID"]
