"""Tuned settings of the PID controllers."""

from __future__ import annotations

from cz_gym.baselines.tuned_for import tuned
from cz_gym.episodes.scenario import Scenario

from .filtered_pid import FilteredPID
from .industrial import Industrial

START: dict[str, FilteredPID | Industrial] = {
    "paper-filtered": FilteredPID(),
    "paper-tuned": FilteredPID(T_track=300.0),
    "pid-conventional": FilteredPID(compensator=None, T_track=300.0),
    "industrial": Industrial(),
}
"""What no search chose, by controller."""


def settings_of(controller: str, scenario: Scenario) -> FilteredPID | Industrial:
    """The controller with its tuned settings for that scenario."""
    settings: FilteredPID | Industrial = tuned(START[controller], controller, scenario)
    return settings
