"""A canvas: shapes at twice the picture's resolution, so that their edges are smooth, and text on top."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .backend import load
from .geometry import paired
from .palette import BACK, INK, PANEL, Colour
from .pixels import halve

if TYPE_CHECKING:
    from pygame import Surface

FINE = 2
"""Drawn pixels along each side of a pixel of the picture, which is their mean."""
FONTS = Path(__file__).parent / "fonts"
TIMES = "\N{MULTIPLICATION SIGN}"
BASE = (640, 480)
"""Width and height [px] at which text and lines have their nominal size."""


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
        self._picture: Surface = self.pygame.Surface((width, height), 0, 32)
        self._on_top: list[tuple[Surface, tuple[int, int]]] = []
        """Text and covers with their upper left corners [px], drawn when the picture is finished."""

    def begin(self, panels: tuple[Box, ...]) -> None:
        """Begin a new picture with these panels on it."""
        self._on_top = []
        self._fine.fill(BACK)
        for box in panels:
            self.rectangle(PANEL, box)

    def finish(self) -> Surface:
        """The picture; the next one is drawn into the same surface."""
        halve(self._fine, self._picture)
        self._picture.blits(self._on_top, False)
        return self._picture

    @contextmanager
    def clip(self, box: Box) -> Iterator[None]:
        """Draw shapes inside the box only, and inside the box of a clip around this one."""
        before = self._fine.get_clip()
        self._fine.set_clip(before.clip(_fine_box(box)))
        try:
            yield
        finally:
            self._fine.set_clip(before)

    def rectangle(self, colour: Colour, box: Box, line: float | None = None) -> None:
        """A rectangle, filled or with a rim of that width."""
        if line is None:
            self._fine.fill(colour, _fine_box(box))
        else:
            self.pygame.draw.rect(self._fine, colour, _fine_box(box), self._thickness(line))

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

    def dashes(
        self, colour: Colour, points: npt.ArrayLike, width: float = 1.2, dash: float = 5.0, gap: float = 4.0
    ) -> None:
        """Dashed lines from point to point, with lengths of dash and gap along the line."""
        x, y = np.asarray(points, np.float64).T
        along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
        starts = np.arange(0.0, along[-1], (dash + gap) * self.unit)
        ends = np.minimum(starts + dash * self.unit, along[-1])
        at = np.stack([starts, ends], axis=1).ravel()
        fine = _fine_points(paired(np.interp(at, along, x), np.interp(at, along, y)))
        for start, end in zip(fine[::2], fine[1::2], strict=True):
            self.pygame.draw.line(self._fine, colour, start, end, self._thickness(width))

    def dot(self, colour: Colour, at: tuple[float, float], radius: float) -> None:
        """A filled circle."""
        centre = (round(at[0] * FINE), round(at[1] * FINE))
        self.pygame.draw.circle(self._fine, colour, centre, self._thickness(radius))

    def glow(self, colour: Colour, at: tuple[float, float], radius: float) -> None:
        """Light around a point, fading over the radius."""
        size = self._thickness(radius)
        corner = (round(at[0] * FINE) - size, round(at[1] * FINE) - size)
        self._fine.blit(_glow(colour, size), corner, special_flags=self.pygame.BLEND_RGB_ADD)

    def shade(self, box: Box, top: Colour, bottom: Colour) -> None:
        """A box whose colour runs from top to bottom."""
        x, y, w, h = _fine_box(box)
        self._fine.blit(_gradient(w, h, top, bottom), (x, y))

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
        """Text whose top is at y and whose left, centre or right (``anchor``) is at x; it lies above all shapes."""
        image = _text(text, max(7, round(size * self.unit)), colour, bold)
        left = {"left": 0.0, "centre": 0.5, "right": 1.0}[anchor] * image.get_width()
        self._on_top.append((image, (round(x - left), round(y))))

    def cover(self, colour: Colour, box: Box) -> None:
        """A filled rectangle above all shapes and the text so far."""
        image = self.pygame.Surface((round(box.w), round(box.h)), 0, 32)
        image.fill(colour)
        self._on_top.append((image, (round(box.x), round(box.y))))

    def _thickness(self, width: float) -> int:
        """A width in nominal pixels as drawn pixels."""
        return max(1, round(width * self.unit * FINE))


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


@lru_cache(maxsize=16)
def _glow(colour: Colour, size: int) -> Any:
    pygame = load()
    at = np.arange(-size, size) + 0.5
    light = np.clip(1.0 - np.hypot(at[:, None], at) / size, 0.0, 1.0) ** 2.2
    image = pygame.Surface(light.shape, 0, 32)
    pygame.surfarray.blit_array(image, (light[..., None] * np.array(colour)).astype(np.uint8))
    return image


@lru_cache(maxsize=16)
def _gradient(width: int, height: int, top: Colour, bottom: Colour) -> Any:
    pygame = load()
    ends = pygame.Surface((1, 2), 0, 32)
    ends.set_at((0, 0), top)
    ends.set_at((0, 1), bottom)
    return pygame.transform.smoothscale(ends, (width, height))
