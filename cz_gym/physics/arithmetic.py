"""Arithmetic of numbers and of labelled tuples: limits, and the integration of any process."""

from typing import Any

from cz_gym.jit.compile import compiled_as, force_inlined, jittable


@jittable
def clip(value: Any, limit: Any) -> Any:
    """The value limited to +-limit, a complex one by its real part; NaN stays NaN."""
    if value.real < -limit:
        return -limit
    return limit if value.real > limit else value


def along(x: Any, s: Any, k: Any) -> Any:
    """The labelled tuple x + s k."""
    return type(x)(*(value + s * rate for value, rate in zip(x, k, strict=True)))


@compiled_as(along)
def _along(x: Any, s: Any, k: Any) -> Any:
    fields = ", ".join(f"x.{name} + s * k.{name}" for name in x.instance_class._fields)
    return [f"return X({fields})"], {"X": x.instance_class}


def plus_product(start: Any, s: Any, k: Any, rows: Any, j: Any) -> Any:
    """``start`` plus the sum of s k times column j of ``rows``, one row for each field of k, in their order."""
    for row, value in enumerate(k):
        start = start + (s * value) * rows[row, j]
    return start


@compiled_as(plus_product)
def _plus_product(start: Any, s: Any, k: Any, rows: Any, j: Any) -> Any:
    terms = (f"(s * k.{name}) * rows[{row}, j]" for row, name in enumerate(k.instance_class._fields))
    return [f"return {' + '.join(['start', *terms])}"], {}


@force_inlined
def rk4(rates: Any, x: Any, u: Any, d: Any, p: Any, dt: Any, m: Any) -> Any:
    """One classical Runge-Kutta step of dt [s], inputs and disturbance held."""
    k_1 = rates(x, u, d, p, m)
    k_2 = rates(along(x, 0.5 * dt, k_1), u, d, p, m)
    k_3 = rates(along(x, 0.5 * dt, k_2), u, d, p, m)
    k_4 = rates(along(x, dt, k_3), u, d, p, m)
    return along(along(along(along(x, dt / 6.0, k_1), dt / 3.0, k_2), dt / 3.0, k_3), dt / 6.0, k_4)
