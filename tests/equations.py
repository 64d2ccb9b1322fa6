"""The plant's equations written a second time, its random series as a whole, and a controller on its true state."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from cz_gym.episodes.draw import episode_from_key, new_series


class Truth(NamedTuple):
    """Constant inputs of the plant."""

    v_p: float
    Q_H: float
    Q_d: float = 0.0
    dT_i: float = 0.0
    melt: float = 1.0


def design_rates(x: np.ndarray, u: Truth, p: Any) -> np.ndarray:
    """The design's equations, written a second time from its text: arcsin and arctan, powers of four."""
    r_c, h_c, T_1, T_2, T_b = x
    A, B = h_c / (2 * r_c), 1 - h_c**2 / p.a**2
    theta = np.arcsin(B / np.sqrt(1 + A**2)) - np.arctan(A)
    alpha_c = theta - np.arctan2(p.sin_alpha_0, p.cos_alpha_0)
    R = p.layer / p.k_l
    through = p.lam / (h_c / p.k_l + R) + (1 - p.lam) / (p.h_0 / p.k_l + R)
    Phi_l = (T_b + u.dT_i - p.T_m) * through
    v_g = (p.Phi_s - Phi_l) / p.rho_dH
    link = p.kappa_12 * (T_1**4 - T_2**4)
    wall = p.G_2b * (T_2 - T_b)
    kappa_b = p.emission * np.pi * (p.R_cr**2 - r_c**2)
    return np.array(
        [
            v_g * np.tan(alpha_c),
            u.v_p - v_g,
            (u.Q_H - link - p.G_1a * (T_1 - p.T_a)) / p.C_1,
            (link - wall) / p.C_2,
            (wall - kappa_b * (T_b**4 - p.T_e**4) - np.pi * r_c**2 * Phi_l + u.Q_d) / (p.C_b * u.melt),
        ]
    )


def integrated(x: Any, u: Truth, p: Any, dt: float, **options: Any) -> Any:
    """SciPy's solution of them by DOP853 at tight tolerances, from x over dt [s]."""
    settings: dict[str, Any] = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-16 * np.abs(x), **options}
    return solve_ivp(lambda _, y: design_rates(y, u, p), (0.0, dt), np.array(x), **settings)


def fields(record: Any) -> Any:
    """The fields of a NumPy record as floats, by name."""
    return SimpleNamespace(**dict(zip(record.dtype.names, record.item(), strict=True)))


def drawn(env: Any) -> Any:
    """The random series of a scalar environment's episode, drawn from its key as a whole."""
    config = env.config
    series = new_series(int(config.horizon // 5.0) + 2, config.steps + 1)
    episode_from_key(config.sole_scenario, tuple(env.get_state().slot.slot["key"].tolist()), series)
    return series


def hold(info: dict[str, Any], h_0: Any) -> Any:
    """Pull action that holds any crystal, from its true state and nominal height [m]: poles near 0.01 rad/s."""
    return 1000 * (info["r_c"] - info["r_ref"]) - 700 * (info["h_c"] - h_0)
