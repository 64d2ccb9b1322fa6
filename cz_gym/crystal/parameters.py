"""The parameters of a whole crystal: a puller's, its recipe's, and the part of the crystal that is grown."""

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any, NamedTuple

from cz_gym.errors import CzError
from cz_gym.jit.compile import labelled
from cz_gym.physics.parameters import Parameters, Recipe, check_numbers, check_parameters
from cz_gym.support.names import unknown
from cz_gym.support.units import MM

STAGES = ("crown", "body", "tail", "whole")
"""The parts of a crystal that an episode can grow."""
APART = (*STAGES, "begins", "heater_max")
"""Parameters that say which part is grown, and what the heater can do: the plant does not depend on them."""
DRAWN = -1.0
"""Value of ``begins`` where each stage begins at its own length."""
CrystalParameters: Any = NamedTuple(  # type: ignore[misc]
    "CrystalParameters", [(name, float) for name in (*Parameters._fields, *Recipe._fields, *APART)]
)
"""A puller's :class:`~cz_gym.physics.parameters.Parameters`, its :class:`~cz_gym.physics.parameters.Recipe`, the share
of episodes [-] that grow each of the :data:`STAGES`, the length [m] at which they begin, or :data:`DRAWN`, and the
heater's largest power [W]."""


def complete(parameters: Any, machine: Any, stage: Any = None) -> Any:
    """:data:`CrystalParameters` of a puller, the recipe in its file, and a stage, by default the crown.

    A stage is a name, names with their shares of the episodes, or the length [m] at which three hours of growth begin.
    Parameters that are complete keep their recipe, and without a stage their own.
    """
    if isinstance(parameters, CrystalParameters):
        return parameters if stage is None else parameters._replace(**_shares(stage, parameters))
    given = check_parameters(parameters)
    check_numbers("recipe's", machine.recipe)
    power = math.inf if machine.heater_max is None else machine.heater_max
    whole = CrystalParameters(*given, *map(float, machine.recipe), 1.0, 0.0, 0.0, 0.0, DRAWN, power)  # type: ignore[call-arg]
    return check_shape(whole if stage is None else whole._replace(**_shares(stage, whole)))


def check_shape(q: Any) -> Any:
    """Return the parameters; raise CzError for a crystal that has no such shape, or not in this crucible."""
    if q.body_length < 2.0 * q.crown_length:
        raise CzError(
            f"a tail needs a body: body_length_mm = {q.body_length / MM:g} must be at least twice crown_length_mm = "
            f"{q.crown_length / MM:g}"
        )
    if q.r_start >= q.r_0:
        raise CzError(f"start_radius_mm = {q.r_start / MM:g} must be less than radius_mm = {q.r_0 / MM:g}")
    return q


def _shares(stage: Any, q: Any) -> dict[str, float]:
    """The stages' shares and where they begin, as fields of the parameters."""
    fields: dict[str, Any] = dict.fromkeys(STAGES, 0.0) | {"begins": DRAWN}
    if isinstance(stage, Real) and not isinstance(stage, bool):
        end = q.crown_length + q.body_length + q.tail_length
        if not 0.0 <= stage < end:  # type: ignore[operator]
            raise CzError(f"stage = {float(stage):g} m begins outside of the crystal, which is {end:g} m long")
        return fields | {"body": 1.0, "begins": float(stage)}
    shares = {stage: 1.0} if isinstance(stage, str) else stage
    if not (isinstance(shares, Mapping) and shares):
        raise CzError(
            f"stage must be one of {', '.join(STAGES)}, a dict of them with shares, or a length, not {stage!r}"
        )
    for name, share in shares.items():
        if name not in STAGES:
            raise CzError(unknown("stage", name, STAGES, ", or a length in metres"))
        if not (isinstance(share, Real) and not isinstance(share, bool) and 0.0 < share < math.inf):  # type: ignore[operator]
            raise CzError(f"the share of stage {name!r} must be a positive number, not {share!r}")
    total = math.fsum(map(float, shares.values()))
    return fields | {name: float(share) / total for name, share in shares.items()}


def named(text: str) -> Any:
    """A stage as a command line has it: a name, or a length [m]."""
    try:
        return float(text)
    except ValueError:
        return text


def parts(q: Any) -> tuple[Parameters, Recipe]:
    """The puller's and the recipe's numbers in the parameters."""
    return labelled(Parameters, q), labelled(Recipe, q)
