"""A Czochralski puller by somebody else: NumPy and the standard library, nothing of cz_gym.

The equations are those of the project's design, in an arrangement of their own: Newton's method inverts Hurle's
meniscus, Heun's moves the states. Numbers are SI inside; readings, setpoints and logs have a plant's units.
"""

import csv
import math
from types import SimpleNamespace

import numpy as np

ZONE = {
    "r_0": 0.1, "v_0": 1.5e-5, "dT_0": 5.02, "lam": 0.5, "phi_b": math.radians(3.5), "alpha_0": math.radians(11.0),
    "sigma": 0.72, "rho_l": 2570.0, "rho_s": 2330.0, "k_l": 62.0, "dH": 1.8e6, "T_m": 1685.0, "g": 9.81,
    "sigma_SB": 5.670374419e-8, "eps": 0.2, "R_cr": 0.3, "T_a": 350.0, "T_e": 1300.0,
    "C_1": 7e4, "C_2": 1.2e5, "C_b": 1.1e5, "kappa_12": 3.3e-8, "G_1a": 33.0, "G_2b": 230.0,
}  # fmt: skip
"""A puller of 200 mm crystals [SI]."""
QUIRKS = {
    "interval": 2.0, "heater_lag": 0.0, "heater_slew": math.inf, "heater_step": 0.0, "pull_slew": math.inf,
    "pull_window": math.inf, "pyrometer_noise": 0.1, "camera_noise": 0.03,
    "heater_dead": 0.0, "pyrometer_lag": 0.0, "pyrometer_step": 0.0, "pull_scale": 1.0, "pull_dead": 0.0, "ripple": 0.0,
    "deep_melt": math.inf, "warming": 0.0, "bursts": 0.0,
}  # fmt: skip
"""What the machine does: [s], heater in [W] and [W/s], pull in [mm/min] and [mm/min per s], pyrometer in [K], camera in
[mm]; conductance between the two halves of the melt [W/K], warming of the shield [K/s], bursts of the melt [K]."""
SLOW = {
    "heater_slew": 1e3 / 60.0, "heater_step": 50.0, "pull_slew": 0.2 / 60.0, "pull_window": 0.3, "camera_noise": 0.05,
}  # fmt: skip
"""Quirks of slow drives: 1 kW/min in steps of 50 W, 0.3 mm/min, 0.2 mm/min in a minute."""
ODD = {
    "heater_lag": 45.0, "heater_dead": 6.0, "pyrometer_lag": 20.0, "pyrometer_step": 0.2, "pull_scale": 0.98,
    "pull_dead": 0.01, "ripple": 0.1, "deep_melt": 2e3, "warming": 5.0 / 3600.0, "bursts": 0.5,
}  # fmt: skip
"""Quirks of another structure than any puller file has."""
TURN, BURST = 5.0, (1200.0, 40.0)
"""Time of a revolution; time between bursts and length of one [s]."""
REACH, MELT = 1e4, ((30.0, 0.25), (780.0, 0.25))
"""The heater's range about nominal [W]; times [s] and deviations [K] of the melt's fluctuations."""
COLUMNS = "time_s", "ring_radius_mm", "pull_speed_mm_per_min", "heater_power_kW", "T_1_K"


class ForeignPuller:
    """One crystal; ``step`` takes setpoints and returns the readings after one interval."""

    def __init__(self, zone=(), seed=0, **quirks):
        assert not (unknown := (set(dict(zone)) - set(ZONE)) | (set(quirks) - set(QUIRKS))), unknown
        self.z = z = SimpleNamespace(**ZONE | dict(zone))
        self.q = q = SimpleNamespace(**QUIRKS | quirks)
        self.random = np.random.default_rng(seed)
        self.a2, self.rho_dH = 2 * z.sigma / z.rho_l / z.g, z.rho_s * z.dH
        self.h_0, melt = self._height(z.alpha_0, z.r_0), z.T_m + z.dT_0
        flux = z.k_l * z.dT_0 / self.h_0
        self.solid_flux = self.rho_dH * z.v_0 + flux
        through = self._loss(z.r_0, melt) + math.pi * z.r_0**2 * flux
        deep = melt + through / q.deep_melt
        T_2 = deep + through / z.G_2b
        self.T_1_0 = (T_2**4 + through / z.kappa_12) ** 0.25
        self.power_0 = through + z.G_1a * (self.T_1_0 - z.T_a)
        self.x = np.array([z.r_0 + 2e-4 * self.random.standard_normal(), self.h_0, self.T_1_0, T_2, melt, deep])
        self.asked = self.power = self.heat = self.power_0
        self.seen_T_1, self.late = self.T_1_0, []
        self.told = z.v_0 / q.pull_scale
        self.pull, self.time, self.fluctuation = z.v_0, 0.0, [0.0, 0.0]
        self.parts, self.lost = math.ceil(q.interval), False
        self.ring_bias = self._ring(z.r_0, self.h_0)
        self.frame = self._frame()

    def _height(self, theta, r):
        m = self.a2 * math.cos(theta) / (4 * r)
        return math.sqrt(m * m + self.a2 * (1 - math.sin(theta))) - m

    def _angle(self, h, r):
        theta = self.z.alpha_0
        for _ in range(20):
            slope = (self._height(theta + 1e-6, r) - self._height(theta - 1e-6, r)) / 2e-6
            step = (self._height(theta, r) - h) / slope
            theta -= step
            if abs(step) < 1e-12:
                break
        return theta

    def _ring(self, r, h):
        M = (1 / self.a2 + math.cos(self._angle(h, r)) / (2 * r * h)) ** -0.5

        def reach(z):
            return M / math.sqrt(2) * math.acosh(math.sqrt(2) * M / z) - math.sqrt(2 * M * M - z * z)

        return reach(M * math.sqrt(1 - math.cos(self.z.phi_b))) - reach(h)

    def _loss(self, r, T_b):
        z = self.z
        return z.eps * z.sigma_SB * math.pi * (z.R_cr**2 - r * r) * (T_b**4 - z.T_e**4)

    def _slopes(self, x):
        z, q, (r, h, T_1, T_2, T_b, deep) = self.z, self.q, x
        burst = q.bursts * (self.time % BURST[0] > BURST[0] - BURST[1])
        flux = z.k_l * (T_b + sum(self.fluctuation) + burst - z.T_m) * (z.lam / h + (1 - z.lam) / self.h_0)
        growth, radiated = (self.solid_flux - flux) / self.rho_dH, z.kappa_12 * (T_1**4 - T_2**4)
        two = math.isfinite(q.deep_melt)
        wall = z.G_2b * (T_2 - (deep if two else T_b))
        mixed = q.deep_melt * (deep - T_b) if two else wall
        halves = (0.5, 0.5) if two else (1.0, 1.0)
        gained = self._loss(r, T_b) - z.eps * z.sigma_SB * math.pi * (z.R_cr**2 - r * r) * self._warmed()
        return np.array([
            growth * math.tan(self._angle(h, r) - z.alpha_0), self.pull - growth,
            (self.heat - radiated - z.G_1a * (T_1 - z.T_a)) / z.C_1, (radiated - wall) / z.C_2,
            (mixed - gained - math.pi * r * r * flux) / z.C_b / halves[0], (wall - mixed) / z.C_b / halves[1],
        ])  # fmt: skip

    def _warmed(self):
        """What the shield radiates back beyond its first temperature [K4]."""
        return (self.z.T_e + self.q.warming * self.time) ** 4 - self.z.T_e**4

    def _frame(self):
        r, h = self.x[:2]
        ripple = self.q.ripple * math.sin(2.0 * math.pi * self.time / TURN)
        return self.time, (r + self._ring(r, h)) * 1e3 + ripple + self.q.camera_noise * self.random.standard_normal()

    def _drives(self, setpoints):
        q, v_0, dt = self.q, self.z.v_0 * 6e4 / self.q.pull_scale, self.q.interval

        def move(tag, now, middle, room, most, unit=1.0):
            wanted = np.clip(setpoints[tag] * unit, middle - room, middle + room)
            return float(np.clip(wanted, now - most, now + most))

        pull = self.told * 6e4, v_0, min(q.pull_window, v_0), q.pull_slew * dt
        if abs(setpoints["pull_speed_setpoint_mm_per_min"] - self.told * 6e4) >= q.pull_dead:
            self.told = move("pull_speed_setpoint_mm_per_min", *pull) / 6e4
        self.pull = q.pull_scale * self.told
        heater = self.asked, self.power_0, REACH, q.heater_slew * dt
        self.asked = move("heater_power_setpoint_kW", *heater, 1e3)
        self.power = round(self.asked / q.heater_step) * q.heater_step if q.heater_step else self.asked

    def step(self, setpoints):
        """Apply setpoints for one interval; the readings after it, by the names of a plant's tags."""
        self._drives(setpoints)
        q, dt = self.q, self.q.interval / self.parts
        follow = 1 - math.exp(-dt / q.heater_lag) if q.heater_lag else 1.0
        for _ in range(self.parts):
            self.late.append(self.power)
            power = self.late.pop(0) if len(self.late) > round(q.heater_dead / dt) else self.power_0
            self.heat += follow * (power - self.heat)
            first = self._slopes(self.x)
            self.x = self.x + dt / 2 * (first + self._slopes(self.x + dt * first))
            for i, (tau, sd) in enumerate(MELT):
                keep = math.exp(-dt / tau)
                kick = sd * math.sqrt(1 - keep * keep) * self.random.standard_normal()
                self.fluctuation[i] = keep * self.fluctuation[i] + kick
            self.time += dt
            self.seen_T_1 += (1 - math.exp(-dt / q.pyrometer_lag) if q.pyrometer_lag else 1.0) * (
                self.x[2] - self.seen_T_1
            )
            r, h = self.x[:2]
            self.lost = not (abs(r - self.z.r_0) < 8e-3 and 1.2e-3 < h < 1.24 * math.sqrt(self.a2))
            if self.lost:
                return self.readings()
        self.frame = self._frame()
        return self.readings()

    def readings(self):
        """What a control computer sees."""
        (at, ring), r_ref = self.frame, self.z.r_0 * 1e3
        T_1 = self.seen_T_1 + self.q.pyrometer_noise * self.random.standard_normal()
        T_1 = round(T_1 / self.q.pyrometer_step) * self.q.pyrometer_step if self.q.pyrometer_step else T_1
        seen = dict(zip(COLUMNS, (self.time, ring, self.told * 6e4, self.power / 1e3, T_1), strict=True))
        for ahead in ("", "_1min", "_5min"):
            seen |= {f"r_ref{ahead}_mm": r_ref, f"T_1_ref{ahead}_K": self.T_1_0}
        return seen | {"ring_time_s": at, "valid": 1.0}


class Operator:
    """A slow PID by hand, and small moves up and down in a random order on both drives (shares of nominal)."""

    def __init__(self, puller, seed=0, moves=(0.025, 0.025)):
        self.chips = moves * np.random.default_rng([9, seed]).choice((-1.0, 1.0), (1000, 2))
        self.puller, self.smooth, self.trim = puller, None, 0.0

    def setpoints(self, seen):
        """Setpoints for readings."""
        p, dt, v_0 = self.puller, self.puller.q.interval, self.puller.z.v_0 * 6e4
        error = seen["ring_radius_mm"] - 1e3 * p.ring_bias - seen["r_ref_mm"]
        last = self.smooth = error if self.smooth is None else self.smooth
        self.smooth += dt / 60.0 * (error - self.smooth)
        pull = v_0 * (0.1 * self.smooth + 25.0 * (self.smooth - last) / dt)
        self.trim += dt / 1800.0 * 2.0 * pull
        kick = 1 + self.chips[int(seen["time_s"] / 60.0) % 1000]
        heater = p.power_0 * kick[1] / 1e3 + 0.5 * (p.T_1_0 + self.trim - seen["T_1_K"])
        return {"pull_speed_setpoint_mm_per_min": v_0 * kick[0] + pull, "heater_power_setpoint_kW": heater}


def drive(puller, setpoints, hours=3.0):
    """Rows of readings, with the setpoints that follow each of them; ``setpoints`` is a function of readings."""
    rows, seen = [], puller.readings()
    while len(rows) < round(hours * 3600 / puller.q.interval) and not puller.lost:
        asked = setpoints(seen)
        rows.append(seen | asked | {"true_radius_mm": puller.x[0] * 1e3})
        seen = puller.step(asked)
    return rows


def write_log(path, rows, seed=0, second=0.0, jitter=0.0, missing_rows=0.0, missing_drives=0.0, digits=()):
    """Write rows as a PLC historian does, stamps in multiples of ``second``, ``digits`` decimals of the readings."""
    random = np.random.default_rng([7, seed])
    with open(path, "w", newline="") as file:
        out = csv.writer(file)
        out.writerow(COLUMNS)
        for row in rows:
            time, *values = (row[name] for name in COLUMNS)
            time += jitter * random.uniform(-1, 1)
            time = round(time / second) * second if second else time
            values = [round(value, places) for value, places in zip(values, digits, strict=True)] if digits else values
            for j in (1, 2):
                values[j] = "" if random.random() < missing_drives and row is not rows[0] else values[j]
            if random.random() >= missing_rows or row is rows[0]:
                out.writerow([time, *values])
    return path
