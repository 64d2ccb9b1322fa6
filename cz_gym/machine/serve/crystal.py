"""The puller behind the tags of a whole crystal, along the recipe of its file."""

import pkgutil
from types import SimpleNamespace
from typing import Any

import numpy as np

from cz_gym.crystal.parameters import STAGES
from cz_gym.crystal.process import CRYSTAL
from cz_gym.crystal.recipe import _Q_H, _ring, _v_p, value
from cz_gym.machine.export.controllers import REGISTRY
from cz_gym.machine.export.ports import SETPOINTS
from cz_gym.observation import Measured, decode
from cz_gym.support.units import KILO, MM, MM_PER_MIN

from .machine import TAGS, Machine, Tag

LATER = {
    "_1min": "_5mm", "_5min": "_25mm", "in 1 minute": "5 mm later", "in 5 minutes": "25 mm later",
    " now": " at this length", "at nominal": "at this length",
}  # fmt: skip
"""Words in the tags of ``Cz-v0``, where references run with time, and those of a crystal."""


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
    """A puller with one whole crystal or a part of it; the controller ``compensated`` takes over."""

    tags = (*(t._replace(name=by_length(t.name), meaning=by_length(t.meaning)) for t in TAGS[:-1]), *OWN_TAGS, TAGS[-1])

    @property
    def nominal(self) -> Any:
        """The recipe's drives in the step that begins now [mm/min, kW]."""
        u = CRYSTAL.nominal(SimpleNamespace(L=self._record.last("L")), self._record, self.interval)
        return np.array([u.v_p / MM_PER_MIN, u.Q_H / KILO])

    def _settings(self) -> dict[str, Any]:
        """Those of ``Cz-v0``, with the least and the largest drives that the recipe and their ranges allow."""
        drives = self._record.table[:, [_v_p, _Q_H]] / (MM_PER_MIN, KILO)
        room = np.minimum(self._units, (self.config.puller.pull_room / MM_PER_MIN, np.inf))
        limits = np.maximum(drives.min(axis=0) - room, 0.0), drives.max(axis=0) + room
        names = [name.replace("setpoint", end) for end in ("min", "max") for name in SETPOINTS]
        return super()._settings() | dict(zip(names, np.ravel(limits).tolist(), strict=True))

    def _in_plant_units(self, seen: Any) -> dict[str, Any]:
        units = super()._in_plant_units(Measured(*seen[: len(Measured._fields)]))
        return {by_length(name): reading for name, reading in units.items()}

    def _read(self) -> dict[str, Any]:
        seen, last = decode(self._observation, *self._ranges, CRYSTAL), self._record.last
        bias = value(last("L"), self._record, _ring)
        own = STAGES[int(last("stage"))], last("L") / MM, last("weight") / self.puller.g, *self.nominal
        seen = seen._replace(ring_error=seen.ring_error + bias - self.puller.ring_bias)
        drives = {"v_p": seen.v_p + seen.v_p_ref, "Q_H": seen.Q_H + seen.Q_H_ref}
        shown = dict(zip((tag.name for tag in OWN_TAGS), own, strict=True)) | {"ring_bias_mm": bias / MM}
        return self._in_plant_units(seen._replace(**drives)) | shown

    def _make_fallback(self) -> Any:
        return pkgutil.resolve_name(f"{REGISTRY}:make_controller")("compensated", self.config)

    def _rest(self) -> Any:
        return self._fallback.predict(self._observation)[1]

    def _fall_back(self) -> list[float]:
        action, self._memory = self._fallback.predict(self._observation, self._memory)
        setpoints: list[float] = np.maximum(self.nominal + np.asarray(action) * self._units, 0.0).tolist()
        return setpoints
