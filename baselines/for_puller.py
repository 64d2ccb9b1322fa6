"""Controllers for a puller of the user's own: the paper's design, scaled settings, and what was searched for it.

Settings follow from the default puller's in proportion: times to the time scale of the inverse response (one over the
zero of G_m), gains to the plant's, the temperature loop's to the heater's capacity, an LQG's noise to the file's. What
``python -m cz_gym.baselines.tuning --puller my.toml`` has found stands in the puller's folder and goes before them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.baselines.analysis.compensator_design import CUT_OFF, design_compensator
from cz_gym.baselines.lqg.controller import LQG, LQGDesign
from cz_gym.baselines.lqg.designs import SHIPPED as LQGS
from cz_gym.baselines.lqg.designs import TOLD, design_of, family_name, ring_of
from cz_gym.baselines.pid.compensated_pid import SeriesPID
from cz_gym.baselines.pid.filtered_pid import FilteredPID
from cz_gym.baselines.pid.industrial import Industrial
from cz_gym.baselines.pid.settings import settings_of
from cz_gym.config import Config
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.errors import CzError
from cz_gym.physics.linearisation import RadiusModel, radius_model
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.puller import DEFAULT, PullerFile
from cz_gym.task import HEATER_SLACK
from cz_gym.units import MM

PIDS = ("paper-tuned", "pid-conventional", "industrial")
"""PIDs that are searched for a puller."""
FILTER = family_name(0.02)
"""The LQG whose filter is searched; the others have the same filter, and their own weights."""
ON_PULLER = ("paper", "paper-here", *PIDS, *(name for name in LQGS if name != TOLD))
"""Controllers of the default table on a puller."""
JUMP = 1.0 * MM
"""Largest difference of reading and filter that counts on the default puller, where outliers are to be expected [m]."""
LEAST_PULL = 0.1
"""Least weight of the pull speed of an LQG whose drive has a window or a slew rate, which its regulator does not know:
with less it swings between them until the crystal is lost [-]."""
ERROR_SHARE = 0.5
"""Share of such a drive's window that the radius error alone may ask for [-]."""


class Scale(NamedTuple):
    """A puller relative to the default one."""

    time: float
    """Its time scale."""
    gain: float
    """A PID's gain."""
    compensator: float
    """The compensator's gain."""
    lead: float
    """The ring's lead coefficient."""
    heat: float
    """The heater's capacity."""
    trim: float
    """The melt temperature that changes growth by v_0."""


def models(config: Config) -> tuple[RadiusModel, RadiusModel]:
    """Model I of the default puller and of an environment's."""
    return radius_model(make_puller()), radius_model(make_puller(config.parameters, 1.0, config.meniscus))


def scale_of(config: Config) -> Scale:
    """The environment's puller relative to the default one."""
    default, own = models(config)
    time = default.zero / own.zero
    gains = [design_compensator(model, CUT_OFF / slower).gain for model, slower in ((own, time), (default, 1.0))]
    return Scale(
        time,
        gain=default.numerator / own.numerator / time**2,
        compensator=gains[0] / gains[1],
        lead=own.lead / default.lead,
        heat=config.parameters.C_1 / DEFAULT.parameters.C_1,
        trim=_trim(make_puller(config.parameters)) / _trim(make_puller()),
    )


def _trim(p: Puller) -> float:
    """Temperature of the melt that changes the growth rate by v_0 [K]."""
    return p.v_0 * p.rho_dH * p.h_0 / p.k_l


def paper_here(config: Config) -> FilteredPID:
    """The paper's controller by its own procedure on this puller's linear model.

    Compensator: the stable part of G_p (1 - G_m) behind a high-pass, whose cut-off lies as far below the zero as the
    paper's. PID: Table 1 with its times in units of the zero's, and the gain that gives the same crossover in units of
    the zero: on the default puller the printed numbers, up to the differences of both linear models. What the paper
    does not say is that of ``paper-tuned`` (measurement filter, anti-windup, heater): with tight drives the printed
    controller winds up.
    """
    (_, own), pid = models(config), _slower(SeriesPID(), scale_of(config))
    compensator = design_compensator(own, CUT_OFF / scale_of(config).time)
    known = scaled_pid("paper-tuned", config)
    assert isinstance(known, FilteredPID)
    return replace(known, pid=pid, compensator=compensator, ring_lead=0.0, K_ff=0.0)


def _slower(pid: SeriesPID, scale: Scale) -> SeriesPID:
    """A PID for a puller of that scale."""
    return replace(pid, K_p=scale.gain * pid.K_p, T_i=scale.time * pid.T_i, T_d=scale.time * pid.T_d)


def scaled_pid(name: str, config: Config) -> FilteredPID | Industrial:
    """A PID's settings for the default puller, in proportion to this one."""
    scale, known = scale_of(config), settings_of(name, RANDOMIZED)
    times, loop = ("T_i", "T_pull", "T_mean"), known.heater
    slower = {each: scale.time * getattr(loop, each) for each in times}
    heater = replace(
        loop, K=scale.heat * loop.K, K_pull=scale.trim * loop.K_pull, limit=scale.trim * loop.limit, **slower
    )
    if isinstance(known, Industrial):
        return replace(known, gain=scale.gain * known.gain, heater=heater).for_config(config)
    compensator = known.compensator
    outliers = any(each.sensor.outlier_probability for each in config.scenario.scenarios)
    return replace(
        known,
        pid=_slower(known.pid, scale),
        compensator=compensator
        and replace(
            compensator,
            gain=scale.compensator * compensator.gain,
            fast=compensator.fast / scale.time,
            slow=compensator.slow / scale.time,
        ),
        **{each: scale.time * getattr(known, each) for each in ("T_f", "T_start", "T_track")},
        jump=config.puller.scale * JUMP if outliers else known.jump,
        ring_lead=scale.lead * known.ring_lead,
        heater=heater,
    ).for_config(config)


def scaled_design(name: str, config: Config) -> LQGDesign:
    """An LQG's design for the default puller, with this one's camera, sensor noise and melt fluctuation."""
    known, scenario = design_of(name, RANDOMIZED), config.scenario.scenarios[0]
    melt, sensor = scenario.interface, scenario.sensor
    fluctuation = _rms(melt.sd) / _rms(RANDOMIZED.interface.sd)
    noise = replace(
        known.noise,
        fast_sd=fluctuation * known.noise.fast_sd,
        slow_sd=fluctuation * known.noise.slow_sd,
        fast_tau=melt.tau_fast,
        slow_tau=melt.tau_slow,
        pyrometer_sd=_rms(sensor.pyrometer_noise) / _rms(RANDOMIZED.sensor.pyrometer_noise) * known.noise.pyrometer_sd,
        camera_sd=max(float(np.mean(sensor.camera_noise)), known.noise.camera_sd_range[0]),
        heater_walk=known.noise.heater_walk * config.heater_range / DEFAULT.power_range,
        start_radius_sd=max(scenario.pullers.start_radius_sd, known.noise.start_radius_sd),
    )
    drives = scenario.actuators
    limited = math.isfinite(drives.pull_window) or math.isfinite(drives.pull_slew)
    weights = known.weights._replace(pull=max(known.weights.pull, LEAST_PULL)) if limited else known.weights
    error_pull = ERROR_SHARE * min(drives.pull_window, config.parameters.v_0) if limited else None
    slack = HEATER_SLACK * drives.heater_step
    return replace(known, noise=noise, weights=weights, ring=ring_of(sensor), heater_slack=slack, error_pull=error_pull)


def _rms(sd: tuple[float, float]) -> float:
    """Root mean square of a standard deviation that is uniform in a range."""
    low, high = sd
    return float(np.sqrt((low * low + low * high + high * high) / 3.0)) or 1e-3


def found_for(puller: PullerFile, name: str) -> Mapping[str, float]:
    """The values that a search has chosen for a puller, by their paths; empty if there are none.

    CzError if they were chosen for other numbers of the puller.
    """
    path = tuned_folder(puller) / f"{name}.json"
    if puller.file is None or not path.is_file():
        return {}
    try:
        kept = json.loads(path.read_text("utf-8"))
        values: dict[str, float] = kept.get("chosen", {"values": {}})["values"]
        if kept["puller"] != puller.label:
            raise CzError(f"{path}: found for puller {kept['puller']}, not for {puller.label}: tune again")
    except (KeyError, TypeError, ValueError) as error:
        raise error if isinstance(error, CzError) else CzError(f"{path}: no choice of a search, or damaged") from None
    return values


def tuned_folder(puller: PullerFile) -> Path:
    """The folder of what was found for a puller: beside its file, with its name."""
    return (puller.file or Path(f"{puller.name}.toml")).with_suffix("")


def with_values(settings: Any, values: Mapping[str, float]) -> Any:
    """The settings with other numbers, by their paths."""
    for path, value in values.items():
        settings = with_value(settings, path, value)
    return settings


def with_value(settings: Any, path: str, value: float) -> Any:
    """The settings with another value at a path; settings are dataclasses or NamedTuples."""
    head, _, rest = path.partition(".")
    new = with_value(getattr(settings, head), rest, value) if rest else value
    change = settings._replace if hasattr(settings, "_replace") else partial(replace, settings)
    return change(**{head: new})


def pid(name: str, config: Config) -> FilteredPID | Industrial:
    """The PID of that name for a puller: what was found for it, or scaled."""
    settings: FilteredPID | Industrial = with_values(scaled_pid(name, config), found_for(config.puller, name))
    return settings


def lqg(name: str, config: Config) -> LQG:
    """The LQG of that name for a puller: with the filter that was found for it, or a scaled one."""
    found = found_for(config.puller, FILTER)
    filter_alone = {path: value for path, value in found.items() if name == FILTER or path.startswith("noise.")}
    return LQG(design=with_values(scaled_design(name, config), filter_alone)).for_config(config)
