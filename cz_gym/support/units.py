"""Conversions between SI and the units people read: ``0.5 * MM`` enters SI, ``r_c / MM`` leaves it."""

MM = 1e-3
"""One millimetre [m]."""
KILO = 1e3
"""One kilowatt [W]."""
MINUTE = 60.0
"""One minute [s]."""
HOUR = 3600.0
"""One hour [s]."""
MM_PER_MIN = MM / MINUTE
"""One millimetre per minute [m/s]."""
CELSIUS = 273.15
"""Zero degrees Celsius [K]."""
PERCENT = 1e-2
"""One per cent [-]."""
MICRO = 1e-6
"""One microsecond [s]."""
