"""Compiled loops over pixels: a picture from one of twice its resolution, and its colours as an array.

pygame's own ``smoothscale`` and ``array3d`` take ten times as long: half of a frame's time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.jit.compile import kernel

_RED_BLUE, _GREEN = np.uint32(0xFF00FF), np.uint32(0x00FF00)
_TWO = np.uint32(2)
_HALF_RED_BLUE, _HALF_GREEN = np.uint32(0x020002), np.uint32(0x000200)


def _halve(fine: Any, half: Any) -> None:
    """Each pixel becomes the rounded mean of four; 0xRRGGBB, shapes (2 h, 2 w) and (h, w)."""
    for i in range(half.shape[0]):
        for j in range(half.shape[1]):
            a, b, c, d = fine[2 * i, 2 * j], fine[2 * i, 2 * j + 1], fine[2 * i + 1, 2 * j], fine[2 * i + 1, 2 * j + 1]
            red_blue = (a & _RED_BLUE) + (b & _RED_BLUE) + (c & _RED_BLUE) + (d & _RED_BLUE) + _HALF_RED_BLUE
            green = (a & _GREEN) + (b & _GREEN) + (c & _GREEN) + (d & _GREEN) + _HALF_GREEN
            half[i, j] = ((red_blue >> _TWO) & _RED_BLUE) | ((green >> _TWO) & _GREEN)


def _split(picture: Any, colours: Any) -> None:
    """Red, green and blue of 0xRRGGBB, shapes (h, w) and (h, w, 3)."""
    for i in range(picture.shape[0]):
        for j in range(picture.shape[1]):
            pixel = picture[i, j]
            colours[i, j, 0] = np.uint8((pixel >> np.uint32(16)) & np.uint32(255))
            colours[i, j, 1] = np.uint8((pixel >> np.uint32(8)) & np.uint32(255))
            colours[i, j, 2] = np.uint8(pixel & np.uint32(255))


_halve_loop, _split_loop = kernel(_halve), kernel(_split)


def halve(fine: Any, half: Any) -> None:
    """Draw a surface into one of half its width and height, each pixel the mean of four."""
    _halve_loop(_pixels(fine), _pixels(half))


def colours(surface: Any) -> npt.NDArray[np.uint8]:
    """A surface as an array of its own, shape (height, width, 3)."""
    width, height = surface.get_size()
    found = np.empty((height, width, 3), np.uint8)
    _split_loop(_pixels(surface), found)
    return found


def _pixels(surface: Any) -> npt.NDArray[np.uint32]:
    """The memory of a surface of 32 bits a pixel, 0xRRGGBB, shape (height, width)."""
    return np.asarray(surface.get_view("2")).T.view(np.uint32)
