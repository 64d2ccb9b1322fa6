"""The puller behind the tags of a whole crystal, along the recipe of its file."""

import pkgutil
from types import SimpleNamespace
from typing import Any

import numpy as np

from cz_gym.crystal.parameters import STAGES
from cz_gym.crystal.process import CRYSTAL
from cz_gym.crystal.recipe import ROWS, _Q_H, _ring, _v_p, value
from cz_gym.machine.export.controllers import REGISTRY
from cz_gym.machine.export.ports import SETPOINTS, in_plant_units
from cz_gym.observation import Measured, decode
from cz_gym.support.units import KILO, MM, MM_PER_MIN

from .machine import TAGS, Machine, Tag

FALLBACK = "compensated"
"""Name of the controller that takes over."""
LATER = {"_1min": "_5mm", "_5min": "_25mm", "in 1 minute": "5 mm later", "in 5 minutes": "25 mm later"}
"""Words of the tags of ``Cz-v0`` by time, and those of a crystal by length."""


def by_length(text: str) -> str:
    """A tag's name or meaning for references that run with the length."""
    for of_time, of_length in LATER.items():
        text = text.replace(of_time, of_length)
    return text


OWN_TAGS = (
    Tag("stage", str, "crown, body or tail, by the length"),
    Tag("length_mm", float, "length grown since the crown began"),
    Tag("weight_kg", float, "the load cell's reading"),
    Tag("pull_speed_recipe_mm_per_min", float, "the recipe's pull speed at this length"),
    Tag("heater_power_recipe_kW", float, "the recipe's heater power at this length"),
)
"""The tags of a whole crystal that ``Cz-v0`` does not have."""


class CrystalMachine(Machine):
    """A puller with one whole crystal or a stage of it; setpoints are absolute, and the recipe is among the tags.

    The fallback is the controller :data:`FALLBACK`; it holds the drives that it finds, and the recipe's temperature is
    shifted to what the pyrometer shows then.
    """

    tags = (*(t._replace(name=by_length(t.name), meaning=by_length(t.meaning)) for t in TAGS[:-1]), *OWN_TAGS, TAGS[-1])

    @property
    def nominal(self) -> Any:
        """The recipe's drives at the length of the step that begins now [mm/min, kW]."""
        u = CRYSTAL.nominal(SimpleNamespace(L=self._record.last("L")), self._slot, self.interval)
        return np.array([u.v_p / MM_PER_MIN, u.Q_H / KILO])

    @property
    def _slot(self) -> Any:
        """The drawn puller and the table of its recipe."""
        return SimpleNamespace(puller=self.puller, table=self._record.table)

    def _settings(self) -> dict[str, Any]:
        """Those of ``Cz-v0``; the drives' limits are the recipe's least and largest, give or take their ranges."""
        of_recipe = self._record.table[:, [_v_p, _Q_H]]
        room = np.array([min(self._ranges[0], self.config.puller.pull_room), self._ranges[1]])
        low, high = np.maximum(of_recipe.min(axis=0) - room, 0.0), of_recipe.max(axis=0) + room
        names = ("pull_speed_{}_mm_per_min", MM_PER_MIN), ("heater_power_{}_kW", KILO)
        ends = {"min": low, "max": high}
        limits = {
            name.format(end): float(at[i] / unit) for end, at in ends.items() for i, (name, unit) in enumerate(names)
        }
        return super()._settings() | limits

    def _reading_spans(self) -> dict[str, tuple[float, float]]:
        """None: along a crystal readings have no fixed range."""
        return {}

    def _read(self) -> dict[str, Any]:
        """The readings, and the crystal's own tags."""
        seen, last = decode(self._observation, *self._ranges, CRYSTAL), self._record.last
        bias = value(last("L"), self._slot, _ring)
        ring = seen.ring_error + bias - self.puller.ring_bias
        v_p, Q_H = seen.v_p + seen.v_p_ref, seen.Q_H + seen.Q_H_ref
        body = Measured(*seen[: len(Measured._fields)])._replace(ring_error=ring, v_p=v_p, Q_H=Q_H)
        now = STAGES[int(last("stage"))], last("L") / MM, last("weight") / self.puller.g, *self.nominal
        read = {by_length(name): reading for name, reading in in_plant_units(body, self.puller).items()}
        return read | {"ring_bias_mm": bias / MM} | {t.name: each for t, each in zip(OWN_TAGS, now, strict=True)}

    def _make_fallback(self) -> Any:
        return pkgutil.resolve_name(f"{REGISTRY}:make_controller")(FALLBACK, self.config)

    def _rest(self) -> Any:
        """The memory of the fallback that begins with the newest sample."""
        return self._fallback.predict(self._observation[None])[1]

    def _fall_back(self) -> list[float]:
        action, self._memory = self._fallback.predict(self._observation[None], self._memory)
        wanted = self.nominal + np.asarray(action[0]) * self._units
        limits = np.array(list(self.limits.values())).T
        return [float(each) for each in np.clip(wanted, *limits)]
