"""A canvas of shapes and text at twice the picture's resolution; the mean of four pixels gives smooth edges."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.jit.compile import kernel

from .backend import load
from .palette import BACK, INK, PANEL, Colour

if TYPE_CHECKING:
    from pygame import Surface

Frame = npt.NDArray[np.uint8]
FINE = 2
"""Drawn pixels along each side of a pixel of the picture, which is their mean."""
FONTS = Path(__file__).parent / "fonts"
TIMES = "\N{MULTIPLICATION SIGN}"
BASE = (640, 480)
"""Width and height [px] at which text and lines have their nominal size."""


_TWO = np.uint32(2)


class Box(NamedTuple):
    """A rectangle of the picture [px]; y runs down."""

    x: float
    y: float
    w: float
    h: float

    @property
    def right(self) -> float:
        """The right edge."""
        return self.x + self.w

    @property
    def bottom(self) -> float:
        """The lower edge."""
        return self.y + self.h

    def inner(self, left: float, top: float, right: float, bottom: float) -> Box:
        """The box without margins of these widths [px]."""
        return Box(self.x + left, self.y + top, self.w - left - right, self.h - top - bottom)


class Canvas:
    """A picture of a given width and height [px]. Coordinates are pixels of the picture, as floats.

    Widths of lines and sizes of text are in nominal pixels: :attr:`unit` pixels of the picture each.
    """

    def __init__(self, width: int, height: int) -> None:
        self.pygame = load()
        self.width, self.height = width, height
        self.unit = min(width / BASE[0], height / BASE[1])
        self._fine: Surface = self.pygame.Surface((FINE * width, FINE * height), 0, 32)

    def begin(self, panels: tuple[Box, ...]) -> None:
        """Begin a new picture with these panels on it."""
        self._fine.fill(BACK)
        for box in panels:
            self.rectangle(PANEL, box)

    def finish(self) -> Frame:
        """The picture, shape (height, width, 3), an array of the caller's own."""
        frame = np.empty((self.height, self.width, 3), np.uint8)
        rows = np.asarray(self._fine.get_view("2")).T
        _mean_of_four(rows.view(np.uint8).reshape(*rows.shape, 4), frame)
        return frame

    @contextmanager
    def clip(self, box: Box) -> Iterator[None]:
        """Draw inside the box only."""
        self._fine.set_clip(_fine_box(box))
        try:
            yield
        finally:
            self._fine.set_clip(None)

    def rectangle(self, colour: Colour, box: Box) -> None:
        """A filled rectangle."""
        self._fine.fill(colour, _fine_box(box))

    def polygon(self, colour: Colour, points: npt.ArrayLike) -> None:
        """A filled polygon, points of shape (n, 2); nothing for fewer than three."""
        fine = _fine_points(points)
        if len(fine) > 2:
            self.pygame.draw.polygon(self._fine, colour, fine)

    def lines(self, colour: Colour, points: npt.ArrayLike, width: float = 1.5) -> None:
        """Straight lines from point to point, shape (n, 2); nothing for a single point."""
        fine = _fine_points(points)
        if len(fine) > 1:
            self.pygame.draw.lines(self._fine, colour, False, fine, self._thickness(width))

    def dot(self, colour: Colour, at: tuple[float, float], radius: float) -> None:
        """A filled circle."""
        centre = (round(at[0] * FINE), round(at[1] * FINE))
        self.pygame.draw.circle(self._fine, colour, centre, self._thickness(radius))

    def text(
        self,
        x: float,
        y: float,
        text: str,
        size: float = 9.5,
        colour: Colour = INK,
        anchor: str = "left",
        bold: bool = False,
    ) -> None:
        """Text whose top is at y and whose left, centre or right (``anchor``) is at x."""
        image = _text(text, FINE * max(7, round(size * self.unit)), colour, bold)
        left = {"left": 0.0, "centre": 0.5, "right": 1.0}[anchor] * image.get_width()
        self._fine.blit(image, (round(FINE * x - left), round(FINE * y)))

    def _thickness(self, width: float) -> int:
        """A width in nominal pixels as drawn pixels."""
        return max(1, round(width * self.unit * FINE))


def _mean(fine: Any, frame: Any) -> None:
    """Each pixel becomes the rounded mean of four: (2 h, 2 w, 4) of blue, green, red and nothing, to (h, w, 3)."""
    for i in range(frame.shape[0]):
        for j in range(frame.shape[1]):
            for channel in range(3):
                total = _TWO
                for k in range(4):
                    total += np.uint32(fine[2 * i + k // 2, 2 * j + k % 2, 2 - channel])
                frame[i, j, channel] = total >> _TWO


_mean_of_four = kernel(_mean)


def _fine_box(box: Box) -> tuple[int, int, int, int]:
    left, top = round(box.x * FINE), round(box.y * FINE)
    return left, top, round(box.right * FINE) - left, round(box.bottom * FINE) - top


def _fine_points(points: npt.ArrayLike) -> list[list[float]]:
    """Points as pygame takes them; those far outside are clipped, because its integers would overflow."""
    scaled = np.asarray(points) * float(FINE)
    fine: list[list[float]] = np.minimum(np.maximum(scaled, -20_000.0), 20_000.0).tolist()
    return fine


@lru_cache(maxsize=8)
def _font(size: int, bold: bool) -> Any:
    pygame = load()
    pygame.font.init()
    return pygame.font.Font(FONTS / ("DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"), size)


@lru_cache(maxsize=2048)
def _text(text: str, size: int, colour: Colour, bold: bool) -> Any:
    try:
        return _font(size, bold).render(text, True, colour)
    except load().error:
        # A pygame.quit() anywhere makes every font invalid.
        _font.cache_clear()
        return _font(size, bold).render(text, True, colour)
