"""Nobody who can still look at an array given out may see a later one written: every way of looking is tried."""

import gc
import threading

import numpy as np
import pytest

from cz_gym import CzVectorEnv
from cz_gym.engine.slots import SPARES, BufferPool

SHAPE = 64, 64


WAYS = {
    "itself": (lambda array: array, lambda held: held[0, 0]),
    "view of a view": (lambda array: array.T[:1][0][::-1].view(np.int64)[:5], lambda held: held.view(np.float64)[-1]),
    "frombuffer": (lambda array: np.frombuffer(array, array.dtype), lambda held: held[0]),
    "flat": (lambda array: array.flat, lambda held: held[0]),
    "as_strided": (lambda array: np.lib.stride_tricks.as_strided(array, (1,), (8,)), lambda held: held[0]),
    "memoryview": (memoryview, lambda held: held[0, 0]),
    "ctypes pointer": (lambda array: array.ctypes.data_as(array.ctypes._ctypes.POINTER(
        array.ctypes._ctypes.c_double)), lambda held: held[0]),
    "dlpack": (lambda array: np.from_dlpack(array), lambda held: held[0, 0]),
    "capsule": (lambda array: array.__dlpack__(), lambda held: None),
    "torch": (lambda array: pytest.importorskip("torch").from_numpy(array), lambda held: float(held[0, 0])),
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_memory_is_not_reused_while_a_reference_to_it_is_left(way):
    look, read = WAYS[way]
    pool = BufferPool(SHAPE, np.float64)
    array = pool.new()
    array[...] = 7.0
    address = array.ctypes.data
    held = look(array)
    del array
    gc.collect(0)
    later = [pool.new() for _ in range(2 * SPARES)]
    for other in later:
        other[...] = -1.0
    assert address not in {other.ctypes.data for other in later}
    assert read(held) in (7.0, None)
    del held
    gc.collect(0)
    assert pool.new().ctypes.data == address, "let go, the memory is used again"


def test_threads_that_hold_and_let_go_never_see_another_value():
    pool, wrong = BufferPool((2048,), np.float64), []

    def work(number):
        held = []
        for turn in range(300):
            array = pool.new()
            array[...] = number * 1000 + turn
            held = [*held, array[5:]][-3:]
            if any(np.ptp(one) != 0.0 or one[0] // 1000 != number for one in held):
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


@pytest.mark.parametrize("observation", ["measured", "state"])
def test_a_batch_large_enough_to_be_lent_memory_writes_nothing_again(observation):
    env = CzVectorEnv(
        600, "nominal", observation=observation, horizon=40.0, autoreset_mode="SameStep", threads=2, info="all"
    )
    shown, info = env.reset(seed=0)
    looks = [memoryview(shown), info["r_c"][::2], info["h_c"][:1]]
    before = [np.array(look) for look in looks]
    del shown, info
    for step in range(20):
        env.step(np.full((600, 2), 0.02 * step))
    for look, copy in zip(looks, before, strict=True):
        np.testing.assert_array_equal(np.asarray(look), copy)
    env.close()
