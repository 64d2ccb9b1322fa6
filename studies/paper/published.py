"""What Part II prints: Bukhari, Hovd and Winkler, "Inverse response behaviour in the bright ring radius measurement of
the Czochralski process II: Mitigation by control", Journal of Crystal Growth. The controller's own numbers are the
defaults it is built with.
"""

from __future__ import annotations

from cz_gym.baselines.pid.compensated_pid import Compensator, SeriesPID
from cz_gym.physics.linearisation import RadiusModel

MODEL_I = RadiusModel(numerator=-0.0047626, poles=(8.78e-6, -1.684e-3), lead=-47.1864, constant=1.0041)
"""G_p,I and G_m,I, section on the linearised model."""
MODEL_II = RadiusModel(numerator=-0.0048849, poles=(4.63e-7, 7.602e-6), lead=-46.0050, constant=1.0043)
"""G_p,II and G_m,II."""
PUBLISHED = {"I": MODEL_I, "II": MODEL_II}
"""The same by model."""
ZERO = 0.021
"""Right half plane zero of both models, as rounded in the text [rad/s]."""
COMPENSATOR = Compensator()
"""G_pc,real."""
ODE = (1.884e-3, 3.368e-7)
"""The same as a differential equation in time: coefficients of y_pc' [rad/s] and y_pc [(rad/s)^2]."""
PID = SeriesPID()
"""Table 1."""
CROSSOVER = 0.03275
"""Table 1 [rad/s]."""
PHASE_MARGIN_DEG = 74.0
"""Text below Table 1, "around 74 degrees for both models" [degrees]."""
