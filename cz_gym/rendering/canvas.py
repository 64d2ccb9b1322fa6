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
from .palette import BACK, FAINT, INK, PANEL, Colour, mix
from .pixels import halve

if TYPE_CHECKING:
    from pygame import Surface

Points = npt.NDArray[np.float64]
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
    """A picture of a given width and height [px]; all coordinates are pixels of the picture, floats welcome."""

    def __init__(self, width: int, height: int) -> None:
        self.pygame = load()
        self.width, self.height = width, height
        self.unit = min(width / BASE[0], height / BASE[1])
        """Size of a nominal pixel [px]."""
        self._fine: Surface = self.pygame.Surface((FINE * width, FINE * height), 0, 32)
        self._picture: Surface = self.pygame.Surface((width, height), 0, 32)
        self._background: Surface = self._fine.copy()
        self._panels: tuple[Box, ...] | None = None
        self._labels: list[tuple[Surface, tuple[int, int]]] = []
        """Images of text with their upper left corners [px], drawn when the picture is finished."""

    def begin(self, panels: tuple[Box, ...]) -> None:
        """Begin a new picture with these panels on it."""
        if panels != self._panels:  # drawn once: pygame takes long for round corners
            self._background.fill(BACK)
            for box in panels:
                radius = round(6 * self.unit * FINE)
                self.pygame.draw.rect(self._background, PANEL, _rounded(box), border_radius=radius)
            self._panels = panels
        self._fine.blit(self._background, (0, 0))
        self._labels = []

    def finish(self) -> Surface:
        """The picture; the next one is drawn into the same surface."""
        halve(self._fine, self._picture)
        for image, corner in self._labels:
            self._picture.blit(image, corner)
        return self._picture

    @contextmanager
    def clip(self, box: Box) -> Iterator[None]:
        """Draw shapes inside the box only, and inside the box of a clip around this one."""
        before = self._fine.get_clip()
        self._fine.set_clip(before.clip(_rounded(box)))
        try:
            yield
        finally:
            self._fine.set_clip(before)

    def rectangle(self, colour: Colour, box: Box, round_by: float = 0.0, line: int = 0) -> None:
        """A rectangle, its corners rounded by that radius [nominal px]; filled, or a line of that width [fine px]."""
        radius = round(round_by * self.unit * FINE)
        self.pygame.draw.rect(self._fine, colour, _rounded(box), line, border_radius=radius)

    def polygon(self, colour: Colour, points: Points) -> None:
        """A filled polygon, points of shape (n, 2); nothing with fewer than three."""
        if len(points) > 2:
            self.pygame.draw.polygon(self._fine, colour, _fine(points))

    def lines(self, colour: Colour, points: Points, width: float = 1.5) -> None:
        """Straight lines from point to point, shape (n, 2), of that width [nominal px]."""
        if len(points) > 1:
            self.pygame.draw.lines(self._fine, colour, False, _fine(points), self._thickness(width))

    def line(self, colour: Colour, start: tuple[float, float], end: tuple[float, float], width: float = 1.5) -> None:
        """A straight line of that width [nominal px]."""
        ends = [(x * FINE, y * FINE) for x, y in (start, end)]
        self.pygame.draw.line(self._fine, colour, *ends, self._thickness(width))

    def dashes(self, colour: Colour, points: Points, width: float = 1.2, dash: float = 5.0, gap: float = 4.0) -> None:
        """Dashed lines from point to point; dash and gap in nominal px along the line."""
        if len(points) < 2:
            return
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        starts = np.arange(0.0, along[-1], (dash + gap) * self.unit)
        ends = np.minimum(starts + dash * self.unit, along[-1])
        fine = _fine(paired(*(np.interp(np.concatenate([starts, ends]), along, axis) for axis in points.T)))
        for start, end in zip(fine[: len(starts)], fine[len(starts) :], strict=True):
            self.pygame.draw.line(self._fine, colour, start, end, self._thickness(width))

    def dot(self, colour: Colour, at: tuple[float, float], radius: float) -> None:
        """A filled circle of that radius [nominal px]."""
        centre = (round(at[0] * FINE), round(at[1] * FINE))
        self.pygame.draw.circle(self._fine, colour, centre, self._thickness(radius))

    def _thickness(self, width: float) -> int:
        """A width of so many nominal pixels [fine px]."""
        return max(1, round(width * self.unit * FINE))

    def glow(self, colour: Colour, x: float, y: float, radius: float) -> None:
        """Light around a point, fading over that radius [nominal px]."""
        size = max(2, round(radius * self.unit * FINE))
        corner = (round(x * FINE) - size, round(y * FINE) - size)
        self._fine.blit(_glow(colour, size), corner, special_flags=self.pygame.BLEND_RGB_ADD)

    def shade(self, box: Box, top: Colour, bottom: Colour) -> None:
        """A box whose colour runs from top to bottom."""
        x, y, w, h = _rounded(box)
        self._fine.blit(_gradient(w, h, top, bottom), (x, y))

    def text(
        self,
        x: float,
        y: float,
        text: str,
        size: float = 11.0,
        colour: Colour = INK,
        anchor: str = "left",
        bold: bool = False,
    ) -> None:
        """Text whose top is at y and whose left, centre or right (``anchor``) is at x; size in nominal px."""
        image = _glyphs(text, max(7, round(size * self.unit)), colour, bold)
        left = {"left": 0.0, "centre": 0.5, "right": 1.0}[anchor] * image.get_width()
        self._labels.append((image, (round(x - left), round(y))))

    def title(self, box: Box, title: str) -> None:
        """A panel's title."""
        self.text(box.x + 8 * self.unit, box.y + 5 * self.unit, title, 9.5, FAINT)

    def remove_text(self, box: Box) -> None:
        """Remove the text that reaches into a box, which something else will cover."""
        area = self.pygame.Rect(*map(round, box))
        self._labels = [(image, at) for image, at in self._labels if not image.get_rect(topleft=at).colliderect(area)]


def paired(x: npt.ArrayLike, y: npt.ArrayLike) -> Points:
    """Points of coordinates that broadcast to one axis, shape (n, 2)."""
    points = np.empty((np.broadcast(x, y).size, 2))
    points[:, 0], points[:, 1] = x, y
    return points


def _rounded(box: Box) -> tuple[int, int, int, int]:
    left, top = round(box.x * FINE), round(box.y * FINE)
    return left, top, round(box.right * FINE) - left, round(box.bottom * FINE) - top


def _fine(points: Points) -> list[list[float]]:
    """Points as the drawing functions take them; far-off ones are limited, since pygame's integers would overflow."""
    limited: list[list[float]] = np.minimum(np.maximum(points * float(FINE), -20_000.0), 20_000.0).tolist()
    return limited


@lru_cache(maxsize=8)
def _font(size: int, bold: bool) -> Any:
    pygame = load()
    pygame.font.init()
    return pygame.font.Font(FONTS / ("DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"), size)


@lru_cache(maxsize=2048)
def _glyphs(text: str, size: int, colour: Colour, bold: bool) -> Any:
    try:
        return _font(size, bold).render(text, True, colour)
    except load().error:
        # pygame.quit(), called by anybody, makes every font invalid.
        _font.cache_clear()
        return _font(size, bold).render(text, True, colour)


@lru_cache(maxsize=16)
def _glow(colour: Colour, size: int) -> Any:
    at = np.arange(-size, size) + 0.5
    distance = np.hypot(at[:, None], at[None, :]) / size
    light = np.clip(1.0 - distance, 0.0, 1.0) ** 2.2
    return _image((light[..., None] * np.array(colour)).astype(np.uint8))


@lru_cache(maxsize=16)
def _gradient(width: int, height: int, top: Colour, bottom: Colour) -> Any:
    column = np.array([mix(top, bottom, row / max(height - 1, 1)) for row in range(height)], np.uint8)
    return _image(np.broadcast_to(column, (width, height, 3)))


def _image(pixels: npt.NDArray[np.uint8]) -> Any:
    """A surface in the canvas' own format of pixels of shape (width, height, 3)."""
    pygame = load()
    image = pygame.Surface(pixels.shape[:2], 0, 32)
    pygame.surfarray.blit_array(image, pixels)
    return image
