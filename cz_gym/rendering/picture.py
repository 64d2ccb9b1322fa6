"""The picture of a growing crystal: an episode's record, the triple point to scale, the numbers beside it, the window.

The triple point is where crystal, melt and gas meet. Above it stands the surface that has grown, beside the reference:
the history of the radius, drawn at the size that it has.
"""

import math
from collections.abc import Sequence
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.error import DependencyNotInstalled, Error, ResetNeeded

from cz_gym.body.process import BODY
from cz_gym.config import Config
from cz_gym.crystal import recipe, sight
from cz_gym.crystal.process import CRYSTAL
from cz_gym.episodes.draw import Episode
from cz_gym.physics.meniscus import MeniscusModel, profile, profile_scale
from cz_gym.physics.plant import HEIGHT_MAX_IN_A, HEIGHT_MIN, Puller
from cz_gym.process import Process
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from . import canvas as palette
from .canvas import MISSING, Box, Canvas, Colour, Frame, available, load

DRAWN = frozenset({"r_c", "r_ref", "r_br", "r_br_measured", "h_c", "v_p", "Q_H", "T_1", "T_1_ref", "T_b"})
"""Rows of ``info`` that a picture shows; a process without them has none."""
Floats = npt.NDArray[np.float64]
MODES = ("human", "rgb_array")
FPS = 30
"""Frames a second of a window or a video; each frame is one control interval."""
SMALLEST, LARGEST = 360, 3840
"""Fewest and most pixels along a side."""


class Ending(Enum):
    """Ending of an episode, in words for a picture."""

    FROZEN = "FROZEN: meniscus too low"
    DETACHED = "DETACHED: meniscus too high"
    LOST = "RADIUS LOST: too far off"
    COLD = "FROZEN: melt below its melting point"
    HORIZON = "END OF THE RUN"
    DONE = "GROWN: the length is reached"


class Record:
    """The samples of one episode, oldest first: signals of ``info`` in SI units, and quantities derived from them."""

    def __init__(self, config: Config, slot: Any, scenario: str) -> None:
        self.config, self.scenario = config, scenario
        self.puller = config.process.Constants(*slot["puller"].tolist())
        self.episode = Episode(*slot["episode"].tolist())
        self.ending: Ending | None = None
        """Ending of the episode; None while it goes on."""
        self._first = int(slot["k"])
        self._column = {name: column for column, name in enumerate((*config.process.info, "valid"))}
        self._samples, self._count = np.zeros((config.steps + 1, len(self._column))), 0

    def __len__(self) -> int:
        return self._count

    def add(self, info: Floats, valid: float, terminated: bool = False, truncated: bool = False) -> None:
        """Add a sample: the row of info, and 1 if the camera's reading is valid."""
        row = self._samples[self._count]
        row[:-1], row[-1] = info, valid
        self._count += 1
        if terminated:
            self.ending = self._end()
        elif truncated:
            self.ending = Ending.HORIZON

    def column(self, name: str) -> Floats:
        """All values of a signal of ``info``, or of "valid", shape (samples,)."""
        return self._samples[: self._count, self._column[name]]

    def last(self, name: str) -> float:
        """The newest value of a :meth:`column`."""
        return float(self._samples[self._count - 1, self._column[name]])

    @property
    def t(self) -> Floats:
        """Time of every sample since the episode began [s]."""
        samples: Floats = self._first + np.arange(self._count, dtype=np.float64)
        return samples * self.config.control_interval

    @property
    def error(self) -> Floats:
        """True radius error of every sample [m]."""
        return self.column("r_c") - self.column("r_ref")

    @property
    def nominal(self) -> tuple[float, float, float]:
        """Nominal pull speed [m/s], heater power [W] and melt temperature [K] now."""
        return self.puller.v_0, self.puller.Q_H_0, self.puller.T_b_0

    @property
    def ring_bias(self) -> Any:
        """Bright ring minus radius by the operator's bias [m]."""
        return self.puller.ring_bias

    @property
    def lowest(self) -> float:
        """Lowest meniscus before it freezes [m]."""
        return HEIGHT_MIN

    @property
    def camera_error(self) -> Floats:
        """Radius error of every sample by the camera, its operator's bias subtracted [m]; NaN without a reading."""
        radius = self.column("r_br_measured") - self.ring_bias
        return np.where(self.column("valid") > 0.0, radius, np.nan) - self.column("r_ref")

    @property
    def camera_sees(self) -> str:
        """Reading that the camera has now: "ring", "edge", or "" for none."""
        return "ring" if self.last("valid") > 0.0 else ""

    @property
    def length(self) -> Floats:
        """Length grown at every sample since the record began [m]: what was pulled less what the meniscus rose."""
        pulled: Floats = np.cumsum(self.column("v_p")) - self.column("v_p")[0]
        length: Floats = pulled * self.config.control_interval - (self.column("h_c") - self.column("h_c")[0])
        return length

    def ring(self, z_b: float) -> tuple[float, float, str]:
        """Distance from the axis and height above the melt [m] of the ring to be drawn, and its name.

        That of a body is the effective point, at the height z_b [m], from which its reading follows: no camera's edge.
        """
        return self.last("r_br"), z_b, "effective ring"

    def surface(self, height: float = np.inf) -> tuple[Floats, Floats, Floats]:
        """The grown surface: radius, reference [m] and height above the melt [m], newest (lowest) first.

        A ring that solidified at length L is now at the height h_c + (L_now - L). The surface ends just above
        ``height`` [m] over the triple point.
        """
        length = self.length
        # Crystal that was melted back again is left out: the length was smaller at a later sample.
        remains = length <= np.minimum.accumulate(length[::-1])[::-1]
        inside = np.flatnonzero(remains & (length >= length[-1] - height))
        remains[: max(int(inside[0]) - 1, 0)] = False
        z = self.last("h_c") + (length[-1] - length[remains])
        return self.column("r_c")[remains][::-1], self.column("r_ref")[remains][::-1], z[::-1]

    def _end(self) -> Ending:
        """The limit that the newest sample broke, or came nearest to where its last substep was discarded."""
        h_c, a = self.last("h_c"), self.puller.a
        room = {
            Ending.FROZEN: (h_c - HEIGHT_MIN) / HEIGHT_MIN,
            Ending.DETACHED: (HEIGHT_MAX_IN_A * a - h_c) / a,
            Ending.LOST: 1.0 - abs(self.error[-1]) / self.config.radius_limit,
        }
        return min(room, key=lambda ending: float(room[ending]))


class CrystalRecord(Record):
    """The samples of a whole crystal: its references are those of the recipe at the length grown."""

    def __init__(self, config: Config, slot: Any, scenario: str) -> None:
        super().__init__(config, slot, scenario)
        self.table = np.array(slot["table"])

    @property
    def nominal(self) -> tuple[float, float, float]:
        """The recipe's pull speed [m/s], heater power [W] and melt temperature [K] now."""
        return self.last("v_p_ref"), self.last("Q_H_ref"), float(self._recipe(recipe._T_b)[-1])

    @property
    def ring_bias(self) -> Any:
        """The recipe's ring less its radius at each sample [m]."""
        return self._recipe(recipe._ring)

    def _recipe(self, column: int) -> Floats:
        """A column of the recipe at each sample's length."""
        place = self.column("L") / recipe.spacing(self.puller) + recipe.MARGIN
        values: Floats = np.interp(place, np.arange(recipe.ROWS), self.table[:, column])
        return values

    @property
    def lowest(self) -> float:
        """Lowest meniscus before it freezes [m]."""
        return recipe.HEIGHT_MIN

    def ring(self, z_b: float) -> tuple[float, float, str]:
        """Outer edge of the mirrored wall that this puller's camera sees, or where it sees none the crystal's edge."""
        r_c, h_c = self.last("r_c"), max(self.last("h_c"), self.lowest)
        if sight.shows_ring(r_c, h_c, self.puller):
            edge = sight.ring_edge(r_c, h_c, self.puller)
            return float(edge.r), float(edge.z), "bright ring"
        return r_c, h_c, "no ring: edge"

    @property
    def camera_error(self) -> Floats:
        """Radius error of every sample by ring or edge, whichever the camera reads [m]; NaN without a reading."""
        edge = self.column("edge_measured") - self.column("r_ref")
        return np.where(self.column("edge_valid") > 0.0, edge, super().camera_error)

    @property
    def camera_sees(self) -> str:
        """Reading that the camera has now: "ring", "edge", or "" for none."""
        return "edge" if self.last("edge_valid") > 0.0 else super().camera_sees

    @property
    def length(self) -> Floats:
        """Length grown since the crown began, at every sample [m]."""
        return self.column("L")

    def _end(self) -> Ending:
        if self.last("succeeded") > 0.0:
            return Ending.DONE
        at = self.config.process.Logged(*self._samples[self._count - 1, :-1])
        margins = recipe.relative_margin(at, self.config.radius_limit, self.config.parameters)
        return (Ending.FROZEN, Ending.DETACHED, Ending.LOST, Ending.COLD)[int(np.argmin(margins))]


def record_for(config: Config, slot: Any, scenario: str) -> Record:
    """An empty record for an episode of an environment."""
    return (CrystalRecord if config.process == CRYSTAL else Record)(config, slot, scenario)


# The triple point to scale: crystal edge with the grown surface above it, meniscus, melt, bright ring.

INSIDE = 11.0 * MM
"""Distance that the panel shows inside r_0, at least [m]; crystals are lost at 8 mm."""
WIDER, LEAST_WIDTH, DEEP = 1.45, 14.0 * MM, 0.2
"""Width of a whole crystal's panel in largest radii [-], the least radius that counts [m], and the melt's share of the
panel's height [-]."""
BELOW, ABOVE = 9.0 * MM, 24.0 * MM
"""Heights that the panel shows below the melt's surface, and above it at least [m]."""
POINTS = 48
"""Points of a drawn meniscus."""
LOWEST = 1e-3
"""Height at which a drawn meniscus ends, far out where it is flat [meniscus heights]."""
EDGE_MARK: Colour = (0, 30, 60)
"""The mark of the crystal's radius on the melt, dark because the melt is bright."""


class Scale(NamedTuple):
    """A linear map from radii and heights [m] to nominal pixels; heights run up, pixels down."""

    x_0: float
    """Pixel of the crystal's axis."""
    y_0: float
    """Pixel of the melt's surface."""
    per_metre: float
    """Pixels per metre."""

    def x(self, r: Any) -> Any:
        """Pixels across of radii [m]."""
        return self.x_0 + r * self.per_metre

    def y(self, z: Any) -> Any:
        """Pixels down of heights [m]."""
        return self.y_0 - z * self.per_metre


def scale_of(box: Box, record: Record) -> Scale:
    """The panel's scale: from 11 mm inside r_0 to 11 mm outside the nominal ring, at least; of a whole crystal from its
    axis outwards, wider while the crown grows.
    """
    if isinstance(record, CrystalRecord):
        per_metre = box.w / (WIDER * max(record.column("r_ref").max(), LEAST_WIDTH))
        return Scale(box.x, box.bottom - DEEP * box.h, per_metre)
    across = 2.0 * INSIDE + record.puller.ring_bias
    per_metre = min(box.w / across, box.h / (BELOW + ABOVE))
    axis = box.x + 0.5 * box.w - (record.puller.r_0 + 0.5 * record.puller.ring_bias) * per_metre
    return Scale(axis, box.bottom - BELOW * per_metre, per_metre)


def meniscus_curve(
    r_c: float, h_c: float, p: Puller, model: MeniscusModel, phi_b: float, lowest: float = HEIGHT_MIN
) -> tuple[Floats, Floats, float]:
    """Radius and height [m] along Hurle's profile, from the triple point outwards, and the height of its ring.

    The profile is Hurle's whatever the model; its slope at the triple point is the model's own. Heights are clipped to
    their limits, as the ring of a failed state is measured.
    """
    h = min(max(h_c, lowest), HEIGHT_MAX_IN_A * p.a)
    M = float(profile_scale(r_c, h, model.slope(r_c, h, p)[1], p.a))
    z = h * LOWEST ** np.linspace(0.0, 1.0, POINTS)
    return r_c + profile(z, M) - profile(h, M), z, M * math.sqrt(1.0 - math.cos(phi_b))


def draw(canvas: Canvas, box: Box, record: Record) -> None:
    """Draw the cross-section of crystal edge, meniscus and melt."""
    scale = scale_of(box, record)
    r_c, r_ref, z = record.surface(max((scale.y_0 - box.y) / scale.per_metre - record.last("h_c"), 0.0))
    x, y = scale.x(r_c), scale.y(z)
    with canvas.clip(box):
        # Crystal and melt fill the panel; then the gas is cut out.
        canvas.rectangle(palette.CRYSTAL, box)
        canvas.rectangle(palette.MELT, Box(box.x, scale.y_0, box.w, box.bottom - scale.y_0))
        detached = record.ending is Ending.DETACHED
        if detached:
            canvas.polygon(palette.GAS, np.r_[x, x[-1], box.right, box.right], np.r_[y, box.y, box.y, y[0]])
            canvas.rectangle(palette.GAS, Box(box.x, y[0], box.w, scale.y_0 - y[0]))
        else:
            config, h_c = record.config, record.last("h_c")
            r, h, z_b = meniscus_curve(
                r_c[0], h_c, record.puller, config.meniscus, config.parameters.phi_b, record.lowest
            )
            out, down, right, level = scale.x(r), scale.y(h), box.right + 9, scale.y_0 + 1
            gas_x, gas_y = np.r_[x[::-1], out, right, right, x[-1]], np.r_[y[::-1], down, down[-1], box.y, box.y]
            canvas.polygon(palette.GAS, gas_x, gas_y)
            canvas.polygon(palette.MELT, np.r_[out, right, box.x, box.x], np.r_[down, level, level, down[0]])
        canvas.lines(palette.REFERENCE, scale.x(np.r_[r_ref[0], r_ref]), scale.y(np.r_[0.0, z]), 0.8)
        canvas.lines(palette.TRUE, x, y, 2.2)
        if not detached:
            ring, height, words = record.ring(z_b)
            _draw_ring(canvas, box, scale, (scale.x(ring), scale.y(height)), (out[0], down[0]), words)
        canvas.dot(palette.INK, x[0], y[0], 3.2)
        canvas.dot(palette.TRUE, x[0], y[0], 2.2)
    _draw_axis(canvas, box, scale)
    canvas.text(box.x + 7, box.y + 30, "crystal", size=10)
    canvas.text(box.x + 7, scale.y_0 + 24, "melt", palette.ON_MELT, bold=True)
    canvas.text(scale.x(r_ref[-1]) + 5, box.y + 30, "reference")


def _draw_ring(
    canvas: Canvas, box: Box, scale: Scale, ring: tuple[float, float], edge: tuple[float, float], words: str
) -> None:
    """The bright ring, and vertical marks of its radius and the crystal's; pixels of both."""
    x, bottom = ring[0], box.bottom - 21
    canvas.dot(palette.CAMERA, *ring, 3.2)
    canvas.lines(palette.CAMERA, x, [ring[1], bottom])
    canvas.lines(EDGE_MARK, edge[0], [edge[1], bottom])
    room, anchor = (5, 0.0) if x + 64 < box.right else (-5, 1.0)
    canvas.text(x + room, scale.y_0 + 8, words, palette.ON_MELT, 9.5, anchor, True)
    canvas.text(edge[0] - 5, scale.y_0 + 8, "r_c", EDGE_MARK, 9.5, 1.0, True)


def _draw_axis(canvas: Canvas, box: Box, scale: Scale) -> None:
    """Radii in mm along the lower edge."""
    y, per_mm = box.bottom - 16, scale.per_metre * MM
    canvas.rectangle(palette.PANEL, Box(box.x, y, box.w, 16.0))
    step = next((step for step in (5.0, 10.0, 20.0) if step >= box.w / per_mm / 9.0), 50.0)
    first, last = ((x - scale.x_0) / per_mm / step for x in (box.x, box.right))
    for number in range(math.ceil(first), math.floor(last) + 1):
        x = scale.x_0 + number * step * per_mm
        canvas.lines(palette.FAINT, x, [y, y + 3])
        if box.x + 8 < x < box.right - 52:
            canvas.text(x, y + 4, f"{number * step:g}", palette.FAINT, 9.0, 0.5)
    canvas.text(box.right - 4, y + 4, "r [mm]", palette.FAINT, 9.0, 1.0)


# The whole picture, in any size: a header, the triple point, and numbers beside it.


class Picture:
    """Draws records as pictures of one size."""

    def __init__(self, width: int, height: int) -> None:
        self.canvas = Canvas(width, height)
        self.box = self.canvas.box.inner(6.0, 34.0, 162.0, 6.0)
        """The triple point's part of the picture."""

    def draw(self, record: Record) -> Frame:
        """The picture of a record's newest sample, shape (height, width, 3)."""
        canvas = self.canvas
        canvas.begin()
        _draw_header(canvas, record)
        draw(canvas, self.box, record)
        _draw_numbers(canvas, self.box, record)
        if record.ending is not None:
            band = Box(self.box.x, self.box.y + 6, self.box.w, 20)
            fine = record.ending in (Ending.HORIZON, Ending.DONE)
            canvas.rectangle(palette.RIM if fine else palette.ALARM, band)
            canvas.text(band.x + band.w / 2.0, band.y + 3.5, record.ending.value, size=11, anchor=0.5, bold=True)
        return canvas.finish()


def _draw_header(canvas: Canvas, record: Record) -> None:
    """Scenario, time, length grown, and whether the crystal grows."""
    hours, rest = divmod(round(float(record.t[-1])), round(HOUR))
    minutes, seconds = divmod(rest, round(MINUTE))
    canvas.text(10, 7, record.config.process.name, size=14, bold=True)
    canvas.text(14 + 9 * len(record.config.process.name), 10, record.scenario, palette.FAINT, 11)
    time, grown = f"{hours}:{minutes:02d}:{seconds:02d}", f"{record.length[-1] / MM:.1f} mm"
    for x, name, value in ((204, "time", time), (312, "grown", grown)):
        canvas.text(x, 10, name, palette.FAINT, 11)
        canvas.text(x + 42, 7.5, value, size=13, bold=True)
    status, colour = ("growing", palette.WELL) if record.ending is None else ("ended", palette.ALARM)
    if record.ending is None and not record.camera_sees:
        status, colour = "camera: no reading", palette.CAMERA
    canvas.text(canvas.box.right - 10, 10, status, colour, 11, 1.0, True)


def numbers(record: Record) -> list[list[tuple[str, str, Colour]]]:
    """Names, values and colours for a record's newest sample: of each group a signal, then its reference."""
    last, (v_p, Q_H, T_b) = record.last, record.nominal
    radius, sees = record.camera_error[-1] + last("r_ref"), record.camera_sees
    return [
        [(f"by the {sees or 'camera'}", f"{radius / MM:.2f} mm" if sees else "no reading", palette.CAMERA),
         ("reference", f"{last('r_ref') / MM:.2f}", palette.REFERENCE)],
        [("pull speed", f"{last('v_p') / MM_PER_MIN:.2f} mm/min", palette.DRIVE),
         ("nominal", f"{v_p / MM_PER_MIN:.2f}", palette.FAINT)],
        [("heater", f"{last('Q_H') / KILO:.2f} kW", palette.DRIVE), ("nominal", f"{Q_H / KILO:.2f}", palette.FAINT)],
        [("heater T_1", f"{last('T_1'):.2f} K", palette.TEMPERATURE),
         ("recipe", f"{last('T_1_ref'):.2f}", palette.FAINT)],
        [("melt T_b", f"{last('T_b'):.2f} K", palette.TEMPERATURE), ("nominal", f"{T_b:.2f}", palette.FAINT)],
    ]  # fmt: skip


def _draw_numbers(canvas: Canvas, box: Box, record: Record) -> None:
    """The true radius error in large figures, then the groups of numbers, at the right of a panel."""
    left, right, y = box.right + 12, canvas.box.right - 12, box.y + 45
    canvas.text(left, box.y + 5, "true radius error", palette.FAINT)
    canvas.text(0.5 * (left + right), box.y + 18, f"{record.error[-1] / MM:+.2f} mm", palette.TRUE, 19, 0.5, True)
    for group in numbers(record):
        for name, value, colour in group:
            canvas.text(left, y, name, palette.FAINT)
            canvas.text(right, y, value, colour, 9.5, 1.0, name == group[0][0])
            y += 13
        y += 9


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
