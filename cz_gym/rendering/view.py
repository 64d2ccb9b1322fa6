"""The view of an environment with a ``render_mode``: the episode's record, its picture and, for "human", a window."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.error import DependencyNotInstalled, Error, ResetNeeded

from cz_gym.body.process import BODY
from cz_gym.config import Config
from cz_gym.process import Process
from cz_gym.support.errors import CzError, unknown_name_message

from .canvas import MISSING, Frame, available, load
from .picture import DRAWN, Picture, Record, record_for

MODES = ("human", "rgb_array")
FPS = 30
"""Frames a second of a window or a video; each frame is one control interval."""
SMALLEST, LARGEST = 360, 3840
"""Fewest and most pixels along a side."""


def declared_modes(process: Process = BODY) -> list[str]:
    """The render modes that can be drawn here: none without pygame, or of a process that logs less."""
    return list(MODES) if available() and set(process.info) >= DRAWN else []


def check_size(size: Any) -> tuple[int, int]:
    """Width and height of a picture [px]; CzError names what was given and what is allowed."""
    if isinstance(size, Sequence) and len(size) == 2:
        width, height = size
        if all(isinstance(side, int | np.integer) and SMALLEST <= side <= LARGEST for side in size):
            return int(width), int(height)
    raise CzError(f"render_size must be (width, height), whole numbers of {SMALLEST} to {LARGEST} pixels, not {size!r}")


def make_view(render_mode: str | None, size: Any, config: Config) -> "View | None":
    """The view of a render mode, None without one.

    Raises CzError for a mode or size that is not allowed, DependencyNotInstalled where pygame is missing.
    """
    width, height = check_size(size)
    if render_mode is None:
        return None
    if render_mode not in MODES:
        raise CzError(unknown_name_message("render_mode", render_mode, ["None", *MODES]))
    if not available():
        raise DependencyNotInstalled(MISSING)
    if not declared_modes(config.process):
        raise CzError("a picture shows a crystal on its melt: for this process render_mode must be None")
    return View(render_mode, width, height, config)


def record_of(env: Any) -> Record:
    """The record of an environment with a render mode, since its last reset; ResetNeeded before the first."""
    view = env.unwrapped._view
    if view is None or view.record is None:
        raise ResetNeeded("no record before the first reset, or without a render_mode")
    record: Record = view.record
    return record


class View:
    """The record of an episode, drawn when asked or, for "human", at every reset and step."""

    def __init__(self, mode: str, width: int, height: int, config: Config) -> None:
        self.mode, self.size, self.config = mode, (width, height), config
        self.record: Record | None = None
        self._picture: Picture | None = None
        self._window: Any = None
        """Surface of the window; None while there is none."""

    def begin(self, info: npt.NDArray[np.float64], slot: Any, scenario: str) -> None:
        """Begin the record of an episode at its first sample, or at the one where a state was restored."""
        self.record = record_for(self.config, slot, scenario)
        self.add(info, float(slot["valid"]))

    def add(
        self, info: npt.NDArray[np.float64], valid: float, terminated: bool = False, truncated: bool = False
    ) -> None:
        """Add a step to the record."""
        if self.record is not None:
            self.record.add(info, valid, terminated, truncated)
            if self.mode == "human":
                self.render()

    def render(self) -> Frame | None:
        """The picture, shape (height, width, 3), or None once it is in the window.

        Raises ResetNeeded before the first reset, :class:`gymnasium.error.Error` where no window can be opened.
        """
        if self.record is None:
            raise ResetNeeded("cannot render before the first reset(): there is no crystal yet")
        if self._picture is None:
            self._picture = Picture(*self.size)
        picture = self._picture.draw(self.record)
        if self.mode == "rgb_array":
            return picture
        pygame = load()
        if self._window is None:
            self._open(pygame)
        pygame.surfarray.blit_array(self._window, picture.swapaxes(0, 1))
        pygame.event.pump()
        self._clock.tick(FPS)
        pygame.display.flip()
        return None

    def _open(self, pygame: Any) -> None:
        try:
            pygame.display.init()
            self._window = pygame.display.set_mode(self.size)
        except pygame.error as error:
            raise Error(f"cannot open a window: {error}; render_mode='rgb_array' needs none") from None
        pygame.display.set_caption("Cz-v0: Czochralski growth")
        self._clock = pygame.time.Clock()

    def close(self) -> None:
        """Close the window, if there is one; it opens again with the next picture."""
        if self._window is not None:
            load().display.quit()
            self._window = None
