"""NumPy's random streams inside the compiled loops: SeedSequence, PCG64, uniform and normal numbers, bit for bit.

A stream is four 64-bit words, ``(state high, state low, increment high, increment low)``; drawing from it moves the
first two. So a slot's random streams are plain memory: they are copied with the slot, saved with it and continued
exactly, and an episode's noise need not be stored ahead. The oracle is ``numpy.random.Generator``.
"""

from typing import Any

import numpy as np
from numba.np.random._constants import fi_double, ki_double, wi_double, ziggurat_nor_inv_r, ziggurat_nor_r

from cz_gym.jit import jittable

WORDS = 4
"""64-bit words of a stream."""
_U = np.uint64
_LOW, _HALF, _SHIFT = _U(0xFFFFFFFF), _U(32), _U(16)
_ZERO, _ONE = _U(0), _U(1)
_INIT_A, _MULT_A = _U(0x43B0D7E5), _U(0x931E8875)
_INIT_B, _MULT_B = _U(0x8B51F9DD), _U(0x58F38DED)
_MIX_L, _MIX_R = _U(0xCA01F9DD), _U(0x4973F715)
_PCG_HIGH, _PCG_LOW = _U(0x2360ED051FC65DA4), _U(0x4385DF649FCCF645)
_TOP, _ROTATE, _MASK = _U(58), _U(64), _U(63)
_DOUBLE_SHIFT, _DOUBLE = _U(11), 1.0 / 9007199254740992.0
_INDEX, _INDEX_SHIFT, _MANTISSA = _U(0xFF), _U(8), _U(0x000FFFFFFFFFFFFF)


@jittable
def _product_high(a: Any, b: Any) -> Any:
    """High 64 bits of the 128-bit product."""
    a_low, a_high, b_low, b_high = a & _LOW, a >> _HALF, b & _LOW, b >> _HALF
    middle = a_high * b_low + ((a_low * b_low) >> _HALF)
    other = a_low * b_high + (middle & _LOW)
    return a_high * b_high + (middle >> _HALF) + (other >> _HALF)


@jittable
def _moved(high: Any, low: Any, s: Any) -> Any:
    """The state after (high, low): state * multiplier + increment, modulo 2^128."""
    product = low * _PCG_LOW
    moved = product + s[3]
    carry = _ONE if moved < product else _ZERO
    return _product_high(low, _PCG_LOW) + high * _PCG_LOW + low * _PCG_HIGH + s[2] + carry, moved


@jittable
def _output(high: Any, low: Any) -> Any:
    """64 random bits from a state (XSL-RR)."""
    mixed, turn = high ^ low, high >> _TOP
    return (mixed >> turn) | (mixed << ((_ROTATE - turn) & _MASK))


@jittable
def next_word(s: Any) -> Any:
    """The stream's next 64 random bits."""
    s[0], s[1] = _moved(s[0], s[1], s)
    return _output(s[0], s[1])


@jittable
def uniform(s: Any) -> Any:
    """The stream's next number in [0, 1)."""
    return np.int64(next_word(s) >> _DOUBLE_SHIFT) * _DOUBLE


@jittable
def _layer(word: Any) -> Any:
    """NumPy's ziggurat of 256 layers: the layer and place that a word picks, and the number there."""
    layer, word = word & _INDEX, word >> _INDEX_SHIFT
    inside = (word >> _ONE) & _MANTISSA
    x = np.int64(inside) * wi_double[layer]
    return layer, inside, -x if word & _ONE else x


@jittable
def normal(s: Any) -> Any:
    """The stream's next standard normal number."""
    while True:
        layer, inside, x = _layer(next_word(s))
        if inside < ki_double[layer]:
            return x
        if layer == _ZERO:
            return _tail(s, inside)
        if (fi_double[layer - _ONE] - fi_double[layer]) * uniform(s) + fi_double[layer] < np.exp(-0.5 * x * x):
            return x


@jittable
def two_normals(s: Any) -> Any:
    """The stream's next two standard normal numbers; 98 times in 100 both lie inside their layers."""
    high, low = _moved(s[0], s[1], s)
    first, inside_first, x = _layer(_output(high, low))
    last_high, last_low = _moved(high, low, s)
    last, inside_last, y = _layer(_output(last_high, last_low))
    if inside_first < ki_double[first] and inside_last < ki_double[last]:
        s[0], s[1] = last_high, last_low
        return x, y
    x = normal(s)
    return x, normal(s)


@jittable
def _tail(s: Any, inside: Any) -> Any:
    """A normal number beyond the ziggurat's last layer (Marsaglia)."""
    while True:
        x = -ziggurat_nor_inv_r * np.log1p(-uniform(s))
        y = -np.log1p(-uniform(s))
        if y + y > x * x:
            x = ziggurat_nor_r + x
            return -x if (inside >> _INDEX_SHIFT) & _ONE else x


@jittable
def _scrambled(value: Any, constant: Any, factor: Any) -> Any:
    """SeedSequence's hash of a 32-bit word with a running constant."""
    value = ((value ^ constant) * ((constant * factor) & _LOW)) & _LOW
    return value ^ (value >> _SHIFT)


@jittable
def _mixed(x: Any, y: Any) -> Any:
    value = (_MIX_L * x - _MIX_R * y) & _LOW
    return value ^ (value >> _SHIFT)


@jittable
def seed_stream(s: Any, key: Any, number: Any) -> None:
    """Make ``s`` the stream of ``PCG64(SeedSequence(key, spawn_key=(number,)))``; key: two 64-bit words."""
    pool = np.zeros(5, np.uint64)
    used = 0
    for word in range(2):
        pool[used] = key[word] & _LOW
        used += 1
        if key[word] >> _HALF:
            pool[used] = key[word] >> _HALF
            used += 1
    constant = _INIT_A
    for i in range(4):
        pool[i] = _scrambled(pool[i], constant, _MULT_A)
        constant = (constant * _MULT_A) & _LOW
    for source in range(5):
        spawned = _U(number)
        for i in range(4):
            if i != source:
                value = pool[source] if source < 4 else spawned
                pool[i] = _mixed(pool[i], _scrambled(value, constant, _MULT_A))
                constant = (constant * _MULT_A) & _LOW
    _start(s, pool)


@jittable
def _start(s: Any, pool: Any) -> None:
    """SeedSequence's output of four 64-bit words, and PCG64's first steps from them."""
    constant = _INIT_B
    for word in range(WORDS):
        low = _scrambled(pool[(2 * word) % 4], constant, _MULT_B)
        constant = (constant * _MULT_B) & _LOW
        high = _scrambled(pool[(2 * word + 1) % 4], constant, _MULT_B)
        constant = (constant * _MULT_B) & _LOW
        s[word] = low | (high << _HALF)
    first_high, first_low = s[0], s[1]
    s[2], s[3] = (s[2] << _ONE) | (s[3] >> _MASK), (s[3] << _ONE) | _ONE
    high, low = _moved(_ZERO, _ZERO, s)
    low = low + first_low
    high = high + first_high + (_ONE if low < first_low else _ZERO)
    s[0], s[1] = _moved(high, low, s)
