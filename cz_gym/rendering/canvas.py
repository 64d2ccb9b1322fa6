"""A canvas of shapes and text for pygame, and its colours: Okabe and Ito's, safe for colour-blind readers.

pygame draws at twice the picture's resolution, so that the mean of the drawn pixels has smooth edges.
"""

import contextlib
import importlib
import importlib.util
import io
import warnings
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.error import DependencyNotInstalled

from cz_gym.support.command_line import missing

Colour = tuple[int, int, int]

BACK: Colour = (13, 17, 23)
PANEL: Colour = (22, 27, 36)
RIM: Colour = (56, 66, 82)
INK: Colour = (236, 239, 244)
FAINT: Colour = (150, 160, 176)

TRUE: Colour = (86, 180, 233)
"""Colour of the true crystal."""
CAMERA: Colour = (240, 228, 66)
"""Colour of the bright ring, and of the radius that the camera reads from it."""
REFERENCE: Colour = (255, 255, 255)
DRIVE: Colour = (204, 121, 167)
"""Colour of pull speed and heater."""
TEMPERATURE: Colour = (230, 159, 0)
WELL: Colour = (0, 190, 140)
ALARM: Colour = (213, 94, 0)

GAS: Colour = (15, 19, 27)
MELT: Colour = (242, 138, 66)
ON_MELT: Colour = (60, 20, 0)
"""Colour of words on the bright melt."""
CRYSTAL: Colour = (104, 112, 128)

Frame = npt.NDArray[np.uint8]
MISSING = missing("pygame", "render")
FINE = 2
"""Drawn pixels along each side of a pixel of the picture."""
FONTS = Path(__file__).parent / "fonts"
BASE = (640, 480)
"""Width and height of a picture whose pixels are nominal ones."""
FAR = 20_000.0
"""Drawn pixels beyond which points are clipped, because pygame's integers would overflow."""


def available() -> bool:
    """True if pygame can be found."""
    return importlib.util.find_spec("pygame") is not None


def load() -> Any:
    """The pygame module, loaded without its greeting and warnings when the first picture is drawn.

    Raises :class:`gymnasium.error.DependencyNotInstalled` where it is missing.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return importlib.import_module("pygame")
    except ImportError:
        raise DependencyNotInstalled(MISSING) from None


class Box(NamedTuple):
    """A rectangle of the picture [nominal px]; y runs down."""

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

    def inner(self, left: float, top: float, right: float, bottom: float) -> "Box":
        """The box without margins of these widths [nominal px]."""
        return Box(self.x + left, self.y + top, self.w - left - right, self.h - top - bottom)


class Canvas:
    """A picture of a given width and height [px].

    Coordinates, widths of lines and sizes of text are in nominal pixels: the picture is a ``box`` of at least BASE.
    """

    def __init__(self, width: int, height: int) -> None:
        self.pygame, self._size = load(), (width, height)
        self.unit = min(width / BASE[0], height / BASE[1])
        self.box = Box(0.0, 0.0, width / self.unit, height / self.unit)
        self._fine = self.pygame.Surface((FINE * width, FINE * height), 0, 32)

    def begin(self) -> None:
        """Begin a new picture."""
        self._fine.fill(BACK)

    def finish(self) -> Frame:
        """The picture, shape (height, width, 3), an array of the caller's own."""
        picture = self.pygame.transform.smoothscale(self._fine, self._size)
        pixels = bytearray(self.pygame.image.tostring(picture, "RGB"))
        return np.frombuffer(pixels, np.uint8).reshape(*self._size[::-1], 3)

    @contextlib.contextmanager
    def clip(self, box: Box) -> Iterator[None]:
        """Draw inside the box only."""
        self._fine.set_clip(self._rectangle(box))
        try:
            yield
        finally:
            self._fine.set_clip(None)

    def rectangle(self, colour: Colour, box: Box) -> None:
        """A filled rectangle."""
        self._fine.fill(colour, self._rectangle(box))

    def polygon(self, colour: Colour, x: npt.ArrayLike, y: npt.ArrayLike) -> None:
        """A filled polygon; nothing for fewer than three points."""
        points = self._points(x, y)
        if len(points) > 2:
            self.pygame.draw.polygon(self._fine, colour, points)

    def lines(self, colour: Colour, x: npt.ArrayLike, y: npt.ArrayLike, width: float = 1.0) -> None:
        """Straight lines from point to point; nothing for a single point."""
        points = self._points(x, y)
        if len(points) > 1:
            self.pygame.draw.lines(self._fine, colour, False, points, max(1, self._fine_pixels(width)))

    def dot(self, colour: Colour, x: float, y: float, radius: float) -> None:
        """A filled circle."""
        self.pygame.draw.circle(self._fine, colour, [*map(self._fine_pixels, (x, y))], self._fine_pixels(radius))

    def text(
        self, x: float, y: float, text: str, colour: Colour = INK, size: float = 9.5, anchor: float = 0.0,
        bold: bool = False,
    ) -> None:  # fmt: skip
        """Text whose top is at y; x is at its left, or at the share ``anchor`` of its width: 0.5 centre, 1 right."""
        image = _text(text, FINE * max(7, round(size * self.unit)), colour, bold)
        left, top = self._fine_pixels(x), self._fine_pixels(y)
        self._fine.blit(image, (left - round(anchor * image.get_width()), top))

    def _fine_pixels(self, length: float) -> int:
        """A length or coordinate in drawn pixels."""
        return round(length * self.unit * FINE)

    def _rectangle(self, box: Box) -> tuple[int, int, int, int]:
        left, top, right, bottom = map(self._fine_pixels, (box.x, box.y, box.right, box.bottom))
        return left, top, right - left, bottom - top

    def _points(self, x: npt.ArrayLike, y: npt.ArrayLike) -> list[list[float]]:
        """Points of coordinates that broadcast to one axis, as pygame takes them."""
        points = np.empty((np.broadcast(x, y).size, 2))
        points[:, 0], points[:, 1] = x, y
        fine: list[list[float]] = np.clip(points * (self.unit * FINE), -FAR, FAR).tolist()
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
