"""Camera and pyrometer of a slot: frames, latency, noise, drop-outs and freezes."""

from typing import Any

import numpy as np

from cz_gym.episodes.record import FREEZES
from cz_gym.episodes.schedule import bias_offset, pyrometer_drift, ripple
from cz_gym.jit.compile import jittable

_EPS = 1e-9


@jittable
def photograph(slot: Any, frames: Any, t: Any, ring: Any, h_c: Any) -> None:
    """Store ring [m] and meniscus height [m] as the camera frame taken at t [s]."""
    at = slot.frames % frames.shape[0]
    frames[at, 0] = t
    frames[at, 1] = ring
    frames[at, 2] = h_c
    slot.frames = slot.frames + 1


@jittable
def _delivered(slot: Any, frames: Any, t: Any) -> Any:
    """Index of the newest frame that is at least as old as the latency, or else of the oldest frame."""
    depth = frames.shape[0]
    index = slot.frames - 1
    oldest = max(slot.frames - depth, 0)
    while index > oldest and frames[index % depth, 0] > t - slot.episode.latency + _EPS:
        index -= 1
    return index % depth


@jittable
def _freezes(slot: Any, t: Any) -> Any:
    """Whether the camera is frozen at t [s], and whether it is flagged as such."""
    frozen, flagged = False, False
    for which in range(FREEZES):
        if slot.freezes[which, 0] <= t < slot.freezes[which, 1]:
            frozen = True
            flagged = flagged or which < FREEZES - 1
    return frozen, flagged


@jittable
def _filtered(slot: Any, T_1: Any, t: Any) -> Any:
    """The true temperature [K] through the pyrometer's filter: exact for one that moves straight between samples."""
    tau = slot.episode.pyrometer_filter
    if slot.k == 0:
        slot.T_filtered = T_1
    else:
        interval = t / slot.k
        lead = (T_1 - slot.T_1_before) * (tau / interval)
        slot.T_filtered = T_1 - lead + (slot.T_filtered - slot.T_1_before + lead) * np.exp(-interval / tau)
    slot.T_1_before = T_1
    return slot.T_filtered


@jittable
def sense(slot: Any, camera: Any, pyrometer: Any, frames: Any, t: Any, seen: Any) -> None:
    """Read pyrometer and camera at t; ``seen`` is what sensors without latency see (:class:`cz_gym.process.Seen`).

    ``camera`` [m] (NaN: the sample drops out) and ``pyrometer`` [K] are the sample's noise. A frozen or dropped sample
    shows the last reading again.
    """
    e = slot.episode
    T_1 = _filtered(slot, seen.T_1, t) if e.pyrometer_filter > 0.0 else seen.T_1
    slot.T_1 = T_1 + pyrometer_drift(t, e) + pyrometer
    lost = np.isnan(camera)
    frozen, flagged = _freezes(slot, t)
    slot.valid = 0.0 if lost or flagged else 1.0
    taken, ring, h_c = t, seen.reading, seen.h_c
    if e.latency > 0.0:
        photograph(slot, frames, t, ring, h_c)
        at = _delivered(slot, frames, t)
        taken, ring, h_c = frames[at, 0], frames[at, 1], frames[at, 2]
    if slot.k == 0 or not (lost or frozen):
        slot.ring = ring + bias_offset(t, e)
        slot.h_seen, slot.k_seen = h_c, slot.k
        if e.ripple_amplitude > 0.0:
            slot.ring = slot.ring + ripple(taken, e)
        if not lost:
            slot.ring = slot.ring + camera
