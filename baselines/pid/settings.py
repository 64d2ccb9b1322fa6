"""Tuned settings of the PID controllers (``python -m cz_gym.baselines.tuning``); histories are in results/tuning.

Each was searched on training seeds and chosen on validation seeds of its scenario. Other scenarios have the settings of
the tuned one that contains what they contain (:func:`cz_gym.baselines.tuned_for.tuned_scenario`).
"""

from __future__ import annotations

from dataclasses import replace

from cz_gym.baselines.tuned_for import tuned_scenario
from cz_gym.config import Config
from cz_gym.episodes.scenario import Scenario

from .compensated_pid import Compensator, SeriesPID
from .filtered_pid import FilteredPID
from .industrial import Industrial
from .temperature_loop import TemperatureLoop

_CONVENTIONAL = FilteredPID(
    pid=SeriesPID(K_p=0.001757, T_i=376.4, T_d=1069.0, N=25.27),
    compensator=None,
    T_f=10.37,
    T_start=624.3,
    T_track=300.0,
    ring_lead=-23.76,
    K_ff=0.2872,
    heater=TemperatureLoop(K=1975.0, T_i=301.3, share=0.2966, K_pull=9.476, T_pull=1049.0, T_mean=286.7),
)

SHIPPED: dict[tuple[str, str], FilteredPID | Industrial] = {
    ("paper-filtered", "randomized"): FilteredPID(T_f=53.88),
    ("paper-filtered", "puller"): FilteredPID(T_f=17.97, jump=0.0004818, T_track=1320.0),
    ("paper-filtered", "sensor-fault"): FilteredPID(T_f=165.2, jump=0.0002365, T_track=168.2),
    ("paper-tuned", "randomized"): FilteredPID(
        pid=SeriesPID(K_p=0.01626, T_i=2842.0, T_d=488.1, N=8.861),
        compensator=Compensator(gain=-0.4655, fast=0.005218, slow=0.001746),
        T_f=39.15,
        T_start=180.8,
        T_track=300.0,
        ring_lead=-3.669,
        K_ff=1.215,
        heater=TemperatureLoop(K=386.0, T_i=157.3, share=0.1457, K_pull=1.707, T_pull=180.0, T_mean=81.49),
    ),
    ("paper-tuned", "puller"): FilteredPID(
        pid=SeriesPID(K_p=0.02777, T_i=1701.0, T_d=441.3, N=11.91),
        compensator=Compensator(gain=-0.5952, fast=0.001781, slow=0.005267),
        T_f=78.27,
        jump=0.002,
        T_start=187.6,
        T_track=301.5,
        ring_lead=18.3,
        K_ff=1.004,
        heater=TemperatureLoop(K=507.1, T_i=202.0, share=0.5192, K_pull=5.78, T_pull=444.7, T_mean=42.84),
    ),
    ("paper-tuned", "sensor-fault"): FilteredPID(
        pid=SeriesPID(K_p=0.02233, T_i=839.1, T_d=799.9, N=12.11),
        compensator=Compensator(gain=-0.5563, fast=0.001643, slow=0.005015),
        T_f=78.43,
        jump=0.001873,
        T_start=183.0,
        T_track=349.7,
        ring_lead=19.31,
        K_ff=0.8874,
        heater=TemperatureLoop(K=498.0, T_i=207.3, share=0.5671, K_pull=5.088, T_pull=546.9, T_mean=39.99),
    ),
    ("pid-conventional", "randomized"): _CONVENTIONAL,
    ("pid-conventional", "puller"): FilteredPID(
        pid=SeriesPID(K_p=0.001685, T_i=359.3, T_d=928.6, N=21.89),
        compensator=None,
        T_f=11.74,
        jump=0.002,
        T_start=633.2,
        T_track=316.4,
        ring_lead=-16.17,
        K_ff=0.2693,
        heater=TemperatureLoop(K=2000.0, T_i=330.5, share=0.3082, K_pull=7.7, T_pull=654.2, T_mean=221.7),
    ),
    ("pid-conventional", "sensor-fault"): replace(_CONVENTIONAL, jump=0.002),
    ("industrial", "randomized"): Industrial(
        T_f=1.183,
        heater=TemperatureLoop(K=381.4, T_i=85.5, share=0.7465, K_pull=32.57, T_pull=10800.0, T_mean=1800.0),
    ),
    ("industrial", "puller"): Industrial(
        T_f=1.069,
        heater=TemperatureLoop(K=300.0, T_i=71.63, share=0.964, K_pull=12.23, T_pull=7361.0, T_mean=786.8),
    ),
    ("industrial", "sensor-fault"): Industrial(
        T_f=1.38,
        heater=TemperatureLoop(K=300.0, T_i=66.21, share=0.7286, K_pull=19.71, T_pull=6438.0, T_mean=1049.0),
    ),
}
"""The settings, by controller and scenario."""


def settings_of(controller: str, scenario: Scenario) -> FilteredPID | Industrial:
    """The controller with its tuned settings for that scenario."""
    among = [where for name, where in SHIPPED if name == controller]
    return SHIPPED[controller, tuned_scenario(scenario, among, controller)]


def tuned(controller: str, config: Config) -> FilteredPID | Industrial:
    """The controller with its tuned settings for that environment, on the default puller."""
    return settings_of(controller, config.sole_scenario).for_config(config)
