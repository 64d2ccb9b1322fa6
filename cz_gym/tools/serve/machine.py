"""The virtual puller: one crystal behind tags, its setpoints, its clock, and its files.

:class:`Machine` advances the crystal by a control interval and shows it as :data:`TAGS`; :class:`Clock` steps it in
real time; :class:`CrystalMachine` is that of a whole crystal. :class:`LogFile` and :class:`StateFile` are whole
however the process ends.
"""

import io
import json
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from enum import IntFlag
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.signals import Measured
from cz_gym.config import Config, Identity
from cz_gym.crystal.plant import STAGES
from cz_gym.crystal.process import CRYSTAL
from cz_gym.crystal.recipe import _Q_H, _ring, _v_p, value
from cz_gym.engine.batch import SlotState
from cz_gym.env import CzEnv, EnvState
from cz_gym.rendering.canvas import Frame
from cz_gym.rendering.picture import record_of
from cz_gym.spaces import CLIP, decode
from cz_gym.support.errors import CzError, leaves, map_arrays
from cz_gym.support.files import check_writable, name_file_in_errors, write_files
from cz_gym.support.units import HOUR, KILO, MM, MM_PER_MIN
from cz_gym.tools.export.block import INPUTS, OUTPUTS, SETPOINT_NAMES, in_plant_units, settings_of
from cz_gym.tools.export.controllers import FALLBACK, make_block
from cz_gym.tools.identify.log import RECORDED
from cz_gym.tools.registry import make_controller

SYNC = 0.5
"""Time after which a log waits for the disk, which takes longer than a step [s]."""


class LogFile:
    """A CSV log, up to the last second if the power fails.

    The file is made with the first row. Once it has ``largest`` bytes, rows go on in a file of the next number:
    ``log.csv``, ``log-2.csv``.
    """

    def __init__(self, path: str | Path, largest: float = math.inf) -> None:
        self.path, self.largest = Path(path), largest
        self._part, self._size, self._synced, self._file = 1, 0, 0.0, -1

    def begin(self, resumed_at: float | None) -> None:
        """Check that rows can be written; a crystal that was resumed at a time [s] loses the rows of later times.

        CzError if the log of another crystal exists.
        """
        check_writable(self.path.absolute().parent)
        if resumed_at is None:
            for path in filter(Path.exists, map(self._name, (1, 2))):
                raise CzError(f"{path}: File exists")
            return
        while self._name(self._part + 1).exists():
            self._part += 1
        if (path := self._name(self._part)).exists():
            with name_file_in_errors(path):
                head, *rows = path.read_text("utf-8").splitlines(keepends=True)
            before = [row for row in rows if float(row.split(",")[0]) <= resumed_at]
            write_files({path: "".join([head, *before]).encode()})
            self._open(os.O_APPEND)

    def add(self, *rows: Mapping[str, Any]) -> None:
        """Write rows, each whole, and wait for the disk unless that was done within the last second."""
        if self._file < 0:
            self._open(os.O_APPEND | os.O_CREAT | os.O_EXCL)
            self._write(",".join(RECORDED))
        for row in rows:
            self._write(",".join(f"{float(row[name]):.10g}" for name in RECORDED))
        full = self._size >= self.largest
        if full or time.monotonic() >= self._synced + SYNC:
            os.fsync(self._file)
            self._synced = time.monotonic()
        if full:
            os.close(self._file)
            self._file, self._part = -1, self._part + 1

    def _name(self, part: int) -> Path:
        return self.path if part == 1 else self.path.with_stem(f"{self.path.stem}-{part}")

    def _open(self, flags: int) -> None:
        with name_file_in_errors(path := self._name(self._part)):
            self._file = os.open(path, os.O_WRONLY | flags, 0o644)
            self._size = os.fstat(self._file).st_size

    def _write(self, line: str) -> None:
        self._size += os.write(self._file, f"{line}\n".encode())


class State(NamedTuple):
    """A saved crystal with the numbers and attributes of its machine."""

    env: EnvState
    memory: npt.NDArray[np.float64]
    """Numbers of the fallback's memory, one after the other."""
    attributes: dict[str, Any]
    """Attributes of the machine."""
    tags: dict[str, Any]
    """The newest tags."""


class StateFile:
    """The file of the newest state, from which a server that was killed goes on: NumPy arrays and JSON, no code."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def load(self) -> State | None:
        """The state, or None if there is no file yet; CzError for a file of something else."""
        check_writable(self.path.absolute().parent)
        if not self.path.exists():
            return None
        with name_file_in_errors(self.path):
            content = self.path.read_bytes()
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as file:
                arrays = dict(file)
            facts, memory = json.loads(arrays.pop("facts").item()), arrays.pop("memory")
            identity: Any = (tuple(each) if isinstance(each, list) else each for each in facts["identity"])
            slot = SlotState(Identity(*identity), scenario=facts["scenario"], **arrays)
            return State(EnvState(slot, facts["random"]), memory, facts["attributes"], facts["tags"])
        except Exception:  # a damaged file can raise anything
            raise CzError(f"{self.path}: no state of a virtual puller, or one of another version") from None

    def save(self, state: State) -> None:
        """Replace the file at once, without waiting for the disk."""
        arrays = dict(vars(state.env.slot))
        facts = {name: arrays.pop(name) for name in ("identity", "scenario")} | {"random": state.env.random}
        facts |= {"attributes": state.attributes, "tags": state.tags}
        new = self.path.with_name(f".{self.path.name}.new")
        with open(new, "wb") as file:
            np.savez(file, facts=np.array(json.dumps(facts)), memory=state.memory, **arrays)
        os.replace(new, self.path)


SIZE = (640, 480)
"""Width and height of the picture [px]."""


class PullerAlarm(IntFlag):
    """The bits of ``alarms``."""

    CAMERA = 1
    """The ring reading is not valid; the last valid one is shown."""
    HELD = 2
    """The setpoints were not renewed for this control interval."""
    FALLBACK = 4
    """The fallback controls, because the setpoints were not renewed within the watchdog time."""
    MANUAL = 8
    """The operator's setpoints hold; clients are refused."""
    LATE = 16
    """The server ran more than one control interval behind its clock, and catches up."""
    ENDED = 32
    """The crystal was lost, or the run is over."""


class Tag(NamedTuple):
    """A value that clients see."""

    name: str
    """The quantity, ending in its unit."""
    kind: type
    meaning: str
    writable: bool = False


SHOWN_SETTINGS = {
    "ring_bias_mm",
    *(f"nominal_{name}" for name in ("radius_mm", "pull_speed_mm_per_min", "heater_power_kW", "T_1_K")),
    *(f"pull_speed_{end}_mm_per_min" for end in ("min", "max")),
    *(f"heater_power_{end}_kW" for end in ("min", "max")),
}
"""The settings of an exported block that clients see as tags."""
TAGS = (
    Tag("time_s", float, "time since the crystal's start"),
    Tag("state", str, "growing, or how the crystal ended"),
    Tag("control", str, "who sets the drives: client, held, fallback or manual"),
    Tag("alarms", int, "sum of the alarm bits"),
    *(Tag(port.name, bool if port.logical else float, port.meaning) for port in INPUTS[2:-1]),
    *(Tag(port.name, float, port.meaning, True) for port in OUTPUTS[:2]),
    Tag("watchdog", int, "number of the step that the setpoints answer; writing it makes them act", True),
    *(Tag(port.name, float, port.meaning) for port in settings_of(Config()) if port.name in SHOWN_SETTINGS),
    Tag("control_interval_s", float, "length of a step"),
    Tag("watchdog_s", float, "time after which setpoints that are not renewed give way to the fallback"),
    Tag("scenario", str, "the scenario"),
    Tag("puller", str, "name and hash of the puller file, or default"),
    Tag("step", int, "number of the control interval that begins now; it changes after all other tags"),
)
"""Every tag, in the order of writing; readings, setpoints and settings are those of the exported blocks."""
TOLERANCE = 1e-6
"""Rounding in single precision that is forgiven at a setpoint's limits, relative [-]."""
SAVED = ("k", "answered", "manual", "_renewed", "_active", "_pending")
"""Attributes of a machine that its state holds beside the environment's and the fallback's memory."""


class Machine:
    """A puller with one crystal, which :meth:`step` advances by one control interval.

    Setpoints act from the step that begins now. Those of a client are held when it does not renew them, and after
    ``watchdog`` seconds the fallback controls; those of the operator need no renewal. All methods may be called from
    any thread. With a state file that exists, the crystal goes on that was saved there; CzError if it has ended, or
    grew under other settings.
    """

    tags: tuple[Tag, ...] = TAGS

    def __init__(
        self, config: Config, seed: int, watchdog: float, log: LogFile | None = None, state: StateFile | None = None
    ) -> None:
        self.env = CzEnv.from_config(config, "rgb_array", SIZE)
        self.config, self.watchdog = config, watchdog
        self.interval, self._ranges = config.control_interval, config.ranges
        self._units = np.divide(self._ranges, (MM_PER_MIN, KILO))
        saved = state.load() if state else None
        self._observation, _ = self.env.reset(seed=seed, options=saved and {"state": saved.env})
        self._record: Any = record_of(self.env)
        self._log, self._state, self._lock = log, state, threading.RLock()
        own, told = self._record.puller, self._record.episode
        self.puller = own._replace(Q_H_0=own.Q_H_0 + told.told_power, T_1_0=own.T_1_0 + told.told_temperature)
        """Constants of the puller, with the nominal values that controllers are told."""
        self._fallback = self._make_fallback()
        self._memory = self._rest()
        self._fixed = self._settings()
        self.limits = {
            name: [self._fixed[name.replace("setpoint", e)] for e in ("min", "max")] for name in SETPOINT_NAMES
        }
        self._fixed |= {"control_interval_s": self.interval, "watchdog_s": watchdog, "puller": config.puller.label}
        self._fixed["scenario"] = self._record.scenario
        self.k, self.answered, self.late, self.manual, self._renewed = 0, -1, False, False, -math.inf
        self._active: list[float] = self.nominal.tolist()
        self._pending = dict(zip(SETPOINT_NAMES, self._active, strict=True))
        self.committed = threading.Condition(self._lock)
        self.hour: deque[dict[str, Any]] = deque(maxlen=int(HOUR / self.interval) + 1)
        """The tags of the last hour."""
        if saved:
            self._resume(saved)
        else:
            self._publish()
        if log:
            log.begin(self.k * self.interval if saved else None)

    @property
    def nominal(self) -> Any:
        """The drives at an action of zero [mm/min, kW]."""
        return np.array([self.puller.v_0 / MM_PER_MIN, self.puller.Q_H_0 / KILO])

    def _settings(self) -> dict[str, Any]:
        return {port.name: port.default for port in settings_of(self.config, self.puller)}

    def _make_fallback(self) -> Any:
        return make_block(FALLBACK, self.config)

    def _rest(self) -> Any:
        """The fallback's memory before it takes over."""
        return self._fallback.start(1)

    @property
    def spans(self) -> dict[str, tuple[float, float]]:
        """Ranges of readings and drives by their tags: readings outside of theirs count as implausible."""
        process, size = self.config.process, len(self._observation)
        ends = (decode(np.full(size, end), *self._ranges, process) for end in (-CLIP, CLIP))
        low, high = map(self._in_plant_units, ends)
        limits = {name: tuple(span) for name, span in self.limits.items()}
        spans = {name: (low[name], high[name]) for name in low if name != "valid"}
        return spans | limits | dict(zip(SETPOINT_NAMES.values(), limits.values(), strict=True))

    def _resume(self, saved: State) -> None:
        """Go on from a saved state."""
        kinds = {name: type(value) for name, value in saved.tags.items()}
        sound = kinds == {tag.name: tag.kind for tag in self.tags} and saved.memory.shape == self._numbers.shape
        if not sound or set(saved.attributes) != set(SAVED):
            raise CzError("this state was saved by another version of cz_gym, or damaged")
        if saved.tags["alarms"] & PullerAlarm.ENDED:
            raise CzError(f"the crystal of this state has ended ({saved.tags['state']}): name another file")
        numbers = iter(saved.memory)
        memory = map_arrays(lambda like: np.array([next(numbers) for _ in like.flat]).reshape(like.shape), self._memory)
        vars(self).update(saved.attributes, _memory=memory)
        self.hour.append(saved.tags)

    @property
    def _numbers(self) -> Any:
        """The numbers of the fallback's memory, one after the other."""
        return np.concatenate([np.ravel(each) for each in leaves(self._memory).values()])

    def write_setpoints(self, writes: dict[str, Any]) -> dict[str, str]:
        """Take a client's values, all or none, and return the reasons of those that are refused.

        Setpoints are stored. They act once the client writes the number of the step that they answer to ``watchdog``.
        """
        with self._lock:
            reasons = {name: reason for name, value in writes.items() if (reason := self._refusal(name, value))}
            if not reasons:
                self._pending |= {
                    n: float(np.clip(v, *self.limits[n])) for n, v in writes.items() if n in SETPOINT_NAMES
                }
                if "watchdog" in writes:
                    self.answered = writes["watchdog"]
                    self._act()
                    self.committed.notify_all()
            return reasons

    def set_manual(self, setpoints: dict[str, float]) -> dict[str, str]:
        """Give the operator control with these setpoints, or, with none, give it back to the clients.

        Returns the reasons of those that are refused.
        """
        with self._lock:
            before, self.manual = self.manual, False
            reasons = self.write_setpoints(setpoints)
            self.manual = before if reasons else bool(setpoints)
            if not reasons:
                self._act()
                self._renewed -= not setpoints  # held until a client comes
            return reasons

    def _refusal(self, name: str, value: Any) -> str:
        if self.manual:
            return "the operator has control"
        if name in SETPOINT_NAMES:
            low, high = self.limits[name]
            rounding = TOLERANCE * high
            return "" if low - rounding <= value <= high + rounding else f"outside {low:.6g} to {high:.6g}"
        return "" if self.answered < value <= self.k else f"step {self.k} is the newest, {self.answered} was answered"

    def _act(self) -> None:
        """Let the stored setpoints act."""
        self._active, self._renewed = [self._pending[name] for name in SETPOINT_NAMES], self.k

    @property
    def control(self) -> str:
        """The source of the drives in the step that begins now: manual, client, held or fallback."""
        if self.manual:
            return "manual"
        if self._renewed == self.k:
            return "client"
        return "held" if (self.k - self._renewed) * self.interval < self.watchdog else "fallback"

    @property
    def over(self) -> bool:
        """True if the crystal has ended."""
        return self._record.ending is not None

    def step(self) -> dict[str, Any]:
        """Advance by one control interval with the newest setpoints, and return the tags."""
        with self._lock:
            control, before = self.control, self.hour[-1]
            if control == "fallback":
                self._active = self._fall_back()
            else:
                self._memory = self._rest()
            self._observation, *_ = self.env.step((self._active - self.nominal) / self._units)
            self.k += 1
            tags = self._publish(control)
            if self._log is not None:
                self._log.add(*([before] if self.k == 1 else []), tags)
            if self._state is not None:
                attributes = {name: getattr(self, name) for name in SAVED}
                self._state.save(State(self.env.get_state(), self._numbers, attributes, tags))
            return tags

    def _fall_back(self) -> list[float]:
        """The fallback's setpoints for the step that begins now."""
        given = self.hour[-1] | {"ring_time_s": self.k * self.interval, "automatic": True}
        outputs, self._memory = self._fallback.run(given, self._memory)
        return [float(outputs[name][0]) for name in SETPOINT_NAMES]

    def _in_plant_units(self, seen: Any) -> dict[str, Any]:
        return in_plant_units(seen, self.puller)

    def _read(self) -> dict[str, Any]:
        """The newest values of the tags that a step changes."""
        return self._in_plant_units(decode(self._observation, *self._ranges))

    def _publish(self, control: str = "held") -> dict[str, Any]:
        """Add the tags to the last hour's, and return them."""
        ending, values = self._record.ending, self._fixed | self._read()
        bits = {
            PullerAlarm.CAMERA: values["valid"] < 0.5, PullerAlarm.HELD: control == "held",
            PullerAlarm.FALLBACK: control == "fallback", PullerAlarm.MANUAL: control == "manual",
            PullerAlarm.LATE: self.late, PullerAlarm.ENDED: ending is not None,
        }  # fmt: skip
        values |= dict(zip(SETPOINT_NAMES, self._active, strict=True)) | {
            "time_s": self.k * self.interval, "state": "growing" if ending is None else ending.value.lower(),
            "control": control, "alarms": sum(bit for bit, holds in bits.items() if holds),
            "valid": values["valid"] > 0.5, "watchdog": max(self.answered, 0), "step": self.k,
        }  # fmt: skip
        for applied, limits in zip(SETPOINT_NAMES.values(), self.limits.values(), strict=True):
            values[applied] = np.clip(values[applied], *limits)  # actions are in single precision
        tags = {tag.name: tag.kind(values[tag.name]) for tag in self.tags}
        self.hour.append(tags)
        return tags

    def picture(self) -> Frame:
        """The picture of the crystal as it is now."""
        with self._lock:
            frame = self.env.render()
        assert frame is not None  # it has the mode "rgb_array"
        return frame


class Clock(threading.Thread):
    """Steps a machine in real time times ``speed``, in a thread of its own that no client can delay.

    Step k ends at the start plus k intervals, whatever happened before: the clock does not drift, and steps that were
    missed follow at once. With ``waits``, time begins with a client's first setpoints. At a speed of 0, every step
    waits for its setpoints.
    """

    def __init__(
        self, machine: Machine, speed: float, waits: bool, published: Callable[[dict[str, Any]], object]
    ) -> None:
        super().__init__(name="plant", daemon=True)
        self.machine, self.speed, self.waits, self.published = machine, speed, waits or not speed, published
        self.stopped = threading.Event()
        self.error: BaseException | None = None

    def run(self) -> None:
        """Step until the crystal ends or the clock is stopped."""
        try:
            if self.waits:
                self._answered(0)
            start, first = time.monotonic(), self.machine.k
            while not (self.stopped.is_set() or self.machine.over):
                if self.speed:
                    period = self.machine.interval / self.speed
                    due = start + (self.machine.k - first + 1) * period
                    self.stopped.wait(max(due - time.monotonic(), 0.0))
                    self.machine.late = time.monotonic() > due + period
                else:
                    self._answered(self.machine.k)
                if not self.stopped.is_set():
                    self.published(self.machine.step())
        except BaseException as error:
            self.error = error
            self.published({})

    def _answered(self, step: int) -> None:
        """Wait until a client has answered the step."""
        with self.machine.committed:
            while not (self.stopped.is_set() or self.machine.answered >= step):
                self.machine.committed.wait(0.2)


LATER = {
    "_1min": "_5mm", "_5min": "_25mm", "in 1 minute": "5 mm later", "in 5 minutes": "25 mm later",
    " now": " at this length", "at nominal": "at this length",
}  # fmt: skip
"""Words in the tags of ``Cz-v0``, where references run with time, and their words for a whole crystal."""


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
        """Settings of ``Cz-v0``, with the least and the largest drives that the recipe and their ranges allow."""
        drives = (self._record.table[:, [_v_p, _Q_H]] + (0.0, self._record.episode.told_power)) / (MM_PER_MIN, KILO)
        reach = np.minimum(self._units, (self.config.puller.pull_room / MM_PER_MIN, np.inf))
        limits = np.maximum(drives.min(axis=0) - reach, 0.0), drives.max(axis=0) + reach
        names = [name.replace("setpoint", end) for end in ("min", "max") for name in SETPOINT_NAMES]
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
        return make_controller("compensated", self.config)

    def _rest(self) -> Any:
        return self._fallback.predict(self._observation)[1]

    def _fall_back(self) -> list[float]:
        action, self._memory = self._fallback.predict(self._observation, self._memory)
        setpoints: list[float] = np.maximum(self.nominal + np.asarray(action) * self._units, 0.0).tolist()
        return setpoints
