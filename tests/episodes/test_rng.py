import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cz_gym.episodes.draw import Stream
from cz_gym.episodes.rng import WORDS, next_word, normal, seed_stream, two_normals, uniform
from cz_gym.jit import kernel

WORD = st.one_of(st.integers(0, 2**64 - 1), st.sampled_from([0, 1, 2**32 - 1, 2**32, 2**64 - 1]))


@kernel
def fill(key, number, words, uniforms, normals):
    s = np.zeros(WORDS, np.uint64)
    seed_stream(s, key, number)
    for i in range(words.size):
        words[i] = next_word(s)
    for i in range(uniforms.size):
        uniforms[i] = uniform(s)
    half = normals.size // 2
    for i in range(half):
        normals[i] = normal(s)
    for i in range(half, normals.size, 2):
        normals[i], normals[i + 1] = two_normals(s)
    return s


def numpys(key, number):
    return np.random.PCG64(np.random.SeedSequence(key, spawn_key=(number,)))


@settings(max_examples=200)
@given(st.tuples(WORD, WORD), st.sampled_from(list(Stream)))
def test_streams_are_numpys_own_bit_for_bit(key, number):
    words, uniforms, normals = np.zeros(3, np.uint64), np.zeros(5), np.zeros(52)
    end = fill(np.array(key, np.uint64), int(number), words, uniforms, normals)
    random = np.random.Generator(numpys(key, number))
    np.testing.assert_array_equal(words, random.bit_generator.random_raw(3))
    np.testing.assert_array_equal(uniforms, random.random(5))
    np.testing.assert_array_equal(normals, random.standard_normal(52))
    state = random.bit_generator.state["state"]
    assert (int(end[0]) << 64 | int(end[1]), int(end[2]) << 64 | int(end[3])) == (state["state"], state["inc"])


@pytest.mark.parametrize("key", [(1, 2), (2**63, 5)])
def test_normals_agree_through_every_branch_of_the_ziggurat(key):
    """200,000 numbers visit the tail beyond the last layer some fifty times."""
    normals = np.zeros(200_000)
    fill(np.array(key, np.uint64), 4, np.zeros(0, np.uint64), np.zeros(0), normals)
    expected = np.random.Generator(numpys(key, 4)).standard_normal(normals.size)
    assert np.count_nonzero(np.abs(expected) > 3.6541528853610088) > 20
    np.testing.assert_array_equal(normals, expected)
