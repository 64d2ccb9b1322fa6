"""Figures of the pages: ``make figures`` draws them from the code, into docs/_static."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Polygon, Rectangle
from PIL import Image

from cz_gym import CzEnv, make_puller
from cz_gym.camera.view import Camera
from cz_gym.env import CzCrystalEnv
from cz_gym.evaluation.plots import DRIVE, GREY, INK, RING, TRUE, canvas
from cz_gym.evaluation.protocol import TEST_SEEDS
from cz_gym.physics.meniscus import hurle_slope, profile, profile_scale
from cz_gym.support.units import MINUTE, MM
from cz_gym.tools import bode
from cz_gym.tools.registry import make_controller

FOLDER = Path(__file__).parents[1] / "_static"
MELT, CRYSTAL, HEAT = "#F6A45C", "#B7C4CF", "#D55E00"
SETTINGS = {"svg.hashsalt": "cz", "font.size": 9, "image.composite_image": False}
"""The same text of a picture each time."""


def furnace() -> Figure:
    """A puller in cross-section, and its meniscus to scale."""
    figure = canvas(8.0, 3.4)
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    _chamber(left)
    _meniscus(right)
    return figure


def _chamber(axes: Any) -> None:
    """Draw crystal, melt, crucible, heater, heat shield and the camera's line of sight [mm]."""
    view = Camera()
    r, wall, bare = 87.5, view.crucible_radius / MM, view.wall_height / MM
    axes.add_patch(Rectangle((-wall, -190.0), 2.0 * wall, 190.0, color=MELT))
    body = [(-r, 7.0), (-r, 230.0), (-8.0, 300.0), (-8.0, 420.0), (8.0, 420.0), (8.0, 300.0), (r, 230.0), (r, 7.0)]
    axes.add_patch(Polygon([(-r - 14.0, 0.0), *body, (r + 14.0, 0.0)], facecolor=CRYSTAL, edgecolor=INK, lw=0.8))
    axes.add_patch(Rectangle((-wall - 30.0, -222.0), 2.0 * wall + 60.0, 32.0, color=GREY))
    shield = view.shield_radius / MM
    for side in (-1.0, 1.0):
        axes.add_patch(Rectangle((side * wall, -190.0), side * 30.0, 190.0 + bare, color=GREY))
        axes.add_patch(Rectangle((side * (wall + 48.0), -180.0), side * 22.0, 230.0, color=HEAT))
        axes.plot([side * shield, side * (wall + 20.0)], [bare, bare + 190.0], color=INK, lw=4.0)
        axes.plot(side * (r + 5.0), 3.0, "o", color=RING, ms=6.0, mec=INK, mew=0.5, zorder=5)
    away = np.array([np.sin(view.tilt), np.cos(view.tilt)])
    ring = np.array([r + 5.0, 3.0])
    lens = ring + 470.0 * away
    axes.plot(*np.array([ring, lens]).T, color=RING, lw=1.3)
    axes.plot([ring[0], wall], [ring[1], 0.92 * bare], color=RING, lw=1.3, ls=":")
    axes.plot(*lens, marker=(4, 0, 45.0 - np.degrees(view.tilt)), ms=20.0, color=INK)
    axes.plot([-wall - 70.0, -wall - 185.0], [-60.0, 55.0], color=HEAT, lw=1.3, ls="--")
    axes.annotate("", (0.0, 492.0), (0.0, 425.0), arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.5})
    words = (
        (0.0, 120.0, "crystal", "center"), (0.0, -95.0, "melt", "center"), (14.0, 470.0, "pull speed $v_p$", "left"),
        (lens[0] + 34.0, lens[1], "camera", "left"), (0.0, -206.0, "crucible, susceptor", "center"),
        (-wall - 205.0, 330.0, "heat shield", "left"), (-wall - 225.0, 74.0, "pyrometer $T_1$", "left"),
        (wall + 76.0, -80.0, "heater\n$Q_H$", "left"), (100.0, -22.0, "bright ring", "left"),
        (wall + 36.0, 1.3 * bare, "bare wall,\nmirrored by the ring", "left"),
    )  # fmt: skip
    for x, y, word, side in words:
        axes.text(x, y, word, ha=side, va="center", fontsize=8)
    axes.set(xlim=(-510.0, 520.0), ylim=(-235.0, 500.0), aspect="equal")
    axes.axis("off")
    axes.set_title("a puller, cross-section", fontsize=9)


def _meniscus(axes: Any) -> None:
    """Draw the meniscus at the operating point, with the camera's edge and the plant's ring [mm]."""
    puller = make_puller()
    r, h = puller.r_0, puller.h_0
    _, cosine = hurle_slope(r, h, puller)
    scale = profile_scale(r, h, cosine, puller.a)
    z = np.geomspace(2e-5, h, 200)
    x = r + profile(z, scale) - profile(h, scale)
    melt = [(60.0, -4.0), (60.0, h / MM), *zip(x[::-1] / MM, z[::-1] / MM, strict=True), (125.0, 0.0), (125.0, -4.0)]
    axes.add_patch(Polygon(melt, color=MELT))
    axes.add_patch(Rectangle((60.0, h / MM), r / MM - 60.0, 20.0, facecolor=CRYSTAL, edgecolor=INK, lw=0.8))
    for slope, words, at in (
        (39.3, "edge of the ring\nin a camera", (93.0, 7.6)),
        (3.5, "ring of the plant", (99.0, 3.0)),
    ):
        height = scale * np.sqrt(1.0 - np.cos(np.radians(slope)))
        there = r + profile(height, scale) - profile(h, scale)
        axes.plot(there / MM, height / MM, "o", color=RING, mec=INK, mew=0.5, zorder=5)
        axes.annotate(words, (there / MM, height / MM), at, fontsize=8, arrowprops={"arrowstyle": "-", "lw": 0.6})
    axes.annotate("", (79.0, 0.0), (79.0, h / MM), arrowprops={"arrowstyle": "<->", "lw": 0.8})
    axes.text(78.4, h / MM / 2.0, f"meniscus height\n$h_c$ = {h / MM:.2f} mm", ha="right", va="center", fontsize=8)
    axes.text(75.0, 10.5, "crystal", ha="center", fontsize=8)
    axes.text(75.0, -2.4, "melt", ha="center", fontsize=8)
    axes.axvline(r / MM, 0.0, 0.98, color=INK, lw=0.6, ls=":")
    axes.set(xlim=(64.0, 112.0), ylim=(-4.0, 16.0), aspect="equal", xlabel="distance from the axis [mm]")
    axes.set_yticks([])
    axes.set_title("its meniscus, to scale", fontsize=9)
    axes.spines[["left", "top", "right"]].set_visible(False)


def loop() -> Figure:
    """The paper's loop: plant, compensator, PID, disturbances, camera."""
    figure = canvas(8.0, 3.3)
    axes = figure.subplots()
    boxes = {
        "PID": (1.55, 2.0, "PID", DRIVE), "drives": (3.0, 2.0, "limits of\nthe drive", GREY),
        "meniscus": (4.6, 2.0, "meniscus\nheight $h_c$", TRUE), "radius": (6.2, 2.0, "crystal\nradius $r_c$", TRUE),
        "camera": (5.4, 0.35, "camera: ring $r_{br}$\nof $r_c$ and $h_c$", RING),
        "compensator": (2.6, 0.35, "compensator\n$G_{pc}$", DRIVE),
    }  # fmt: skip
    for x, y, words, colour in boxes.values():
        style = {"boxstyle": "round,pad=0.02", "facecolor": "white", "edgecolor": colour, "lw": 1.6}
        axes.add_patch(FancyBboxPatch((x - 0.55, y - 0.27), 1.1, 0.54, **style))
        axes.text(x, y, words, ha="center", va="center", fontsize=8)
    axes.add_patch(Circle((0.5, 2.0), 0.1, facecolor="white", edgecolor=INK))
    axes.add_patch(Circle((0.5, 0.35), 0.1, facecolor="white", edgecolor=INK))
    paths = (
        ((-0.3, 2.0), (0.4, 2.0)), ((0.6, 2.0), (1.0, 2.0)), ((2.1, 2.0), (2.45, 2.0)), ((3.55, 2.0), (4.05, 2.0)),
        ((5.15, 2.0), (5.65, 2.0)), ((6.75, 2.0), (7.5, 2.0)), ((6.2, 1.73), (6.2, 0.35), (5.95, 0.35)),
        ((4.6, 1.73), (4.6, 1.15), (5.1, 1.15), (5.1, 0.62)), ((3.8, 2.0), (3.8, 0.35), (3.15, 0.35)),
        ((2.05, 0.35), (0.6, 0.35)), ((4.85, 0.35), (4.55, 0.35), (4.55, -0.25), (0.5, -0.25), (0.5, 0.25)),
        ((0.5, 0.45), (0.5, 1.9)), ((4.6, 2.85), (4.6, 2.27)), ((7.0, 0.35), (6.4, 0.35)),
    )  # fmt: skip
    for *before, last in paths[:-1]:
        if len(before) > 1:
            axes.plot(*np.array(before).T, color=INK, lw=1.0)
        axes.annotate(
            "", last, before[-1], arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.0, "shrinkA": 0, "shrinkB": 0}
        )
    words = (
        (-0.3, 2.12, "$r_{ref}$", "left"), (3.83, 2.12, "$v_p$", "center"), (7.5, 2.12, "$r_c$, not seen", "right"),
        (4.72, 2.68, "temperature: fluctuations, drift, recipe error", "left"), (0.33, 2.03, "$-$", "center"),
        (1.5, 0.47, "correction", "center"), (1.5, -0.13, "ring $-$ bias", "center"),
        (0.58, 1.2, "no inverse response here", "left"), (5.2, 1.0, "wrong way first", "left"),
        (6.35, 0.35, "noise,\nlatency", "left"),
    )  # fmt: skip
    for x, y, word, side in words:
        axes.text(x, y, word, ha=side, va="bottom", fontsize=8, color=INK)
    axes.set(xlim=(-0.4, 7.6), ylim=(-0.4, 3.0))
    axes.axis("off")
    return figure


def crown() -> Figure:
    """One crown of ``CzCrystal-v0`` without and with feedback: its outline against the recipe's."""
    figure = canvas(8.0, 3.2)
    for axes, name in zip(figure.subplots(1, 2, sharex=True, sharey=True), ("recipe", "lqg-along"), strict=True):
        env = CzCrystalEnv(stage="crown", scenario="randomized", observation="measured", action="direct", info="all")
        policy, memory, over = make_controller(name, env.config), None, False
        observation, info = env.reset(seed=TEST_SEEDS[11])
        rows = [info]
        while not over:
            action, memory = policy.predict(observation, memory)
            observation, _, ended, cut, info = env.step(action)
            rows.append(info)
            over = ended or cut
        length, radius, reference = (np.array([row[key] for row in rows[::12]]) / MM for key in ("L", "r_c", "r_ref"))
        axes.fill_betweenx(length, -radius, radius, color=CRYSTAL, label="grown")
        for side in (-1.0, 1.0):
            axes.plot(
                side * reference, length, color=INK, lw=1.2, ls="--", label="recipe's radius" if side > 0.0 else None
            )
        end = "held" if info["succeeded"] else f"lost after {len(rows) * env.config.control_interval / MINUTE:.0f} min"
        if not info["succeeded"]:
            axes.plot([0.0], length[-1:], "X", color=HEAT, ms=10.0)
        axes.set_title(f"{name}: {end}", fontsize=9)
        axes.set(xlabel="radius [mm]", ylim=(155.0, -5.0), aspect="equal")
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("length grown [mm]")
    figure.axes[1].legend(fontsize=8, frameon=False, loc="upper right")
    return figure


def camera() -> Figure:
    """Images of the camera: the bright ring of a body, and in the crown the crystal's edge alone."""
    figure = canvas(8.0, 3.3)
    body = CzEnv("nominal", observation="camera")
    widening = CzCrystalEnv(stage=0.05, scenario="nominal", observation="camera")
    for axes, env, title in zip(figure.subplots(1, 2), (body, widening), ("body", "crown, 50 mm grown"), strict=True):
        image, _ = env.reset(seed=1)
        axes.imshow(image[..., 0], cmap="gray", vmin=0, vmax=255, interpolation="nearest")
        axes.set_title(title, fontsize=9)
        axes.axis("off")
        axes.text(80.0, 12.0, "crystal", color="white", ha="center", va="center", fontsize=8)
        axes.text(80.0, 106.0, "melt, a mirror", color="white", ha="center", va="center", fontsize=8)
    for axes, word in zip(figure.axes, ("bright ring", "edge of the crystal"), strict=True):
        axes.annotate(
            word,
            (80.0, 59.0),
            (112.0, 82.0),
            color="white",
            fontsize=8,
            arrowprops={"arrowstyle": "->", "color": "white"},
        )
    return figure


def picture() -> bytes:
    """A crystal as ``render`` draws it, as PNG."""
    env = CzEnv("randomized", render_mode="rgb_array")
    env.reset(seed=1)
    for _ in range(120):
        env.step(np.zeros(2, np.float32))
    file = io.BytesIO()
    Image.fromarray(env.render()).quantize(64).save(file, "PNG", optimize=True)
    return file.getvalue()


FIGURES: dict[str, Callable[[], Figure]] = {each.__name__: each for each in (furnace, loop, crown, camera)}
"""Every figure, by the name of its file."""
BODE = ("paper-tuned", "lqg-at-0.02")
"""Controllers whose Bode plot stands on a page."""


def main() -> None:
    """Draw all."""
    with matplotlib.rc_context(SETTINGS):
        for name, draw in FIGURES.items():
            draw().savefig(FOLDER / f"{name}.svg", facecolor="white", metadata={"Date": None})
    (FOLDER / "picture.png").write_bytes(picture())
    for name in BODE:
        bode.main([name, "--out", str(FOLDER / f"bode-{name}.png")])


if __name__ == "__main__":
    main()
