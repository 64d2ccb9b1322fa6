"""Three readings of the bright ring of the same crystals, compared and drawn: ``python -m studies.camera``.

They are the plant's closed form, the ring's outer edge traced without pixels, and the detector's, from an image.
"""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.body.plant import make_puller
from cz_gym.camera.image import picture
from cz_gym.camera.rays import make_scene
from cz_gym.camera.ring_detector import ANGLES, RingDetector, wall_edge
from cz_gym.camera.view import COLUMNS, ROWS, Camera, make_view, project
from cz_gym.env import CzEnv
from cz_gym.physics.linearisation import Floats
from cz_gym.physics.meniscus import hurle_ring_offset
from cz_gym.support.atomic_files import check_writable, write_files
from cz_gym.support.command_line import OneLineParser
from cz_gym.support.units import MM

RADII, HEIGHTS = np.linspace(-8.0, 8.0, 17) * MM, np.linspace(-2.0, 2.0, 9) * MM
"""Radii less r_0 and heights less h_0 at which the readings are compared [m]."""
CHANGES = [(change, model) for change in (-0.1, -0.5) for model in ("I", "II")]
"""Sudden changes of the pull speed, share of v_0, and the models they are made on."""
INTERVAL, HORIZON = 2.0, 240.0
"""Time between images, and length of a response [s]."""
VIEW, PULLER = make_view(Camera()), make_puller()


class Response(NamedTuple):
    """A crystal's answer to a sudden change of its pull speed; arrays of shape (images,)."""

    model: str
    change: float
    """Change of the pull speed, share of v_0 [-]."""
    t: Floats
    """Time [s]."""
    r_c: Floats
    """True radius less r_0 [m]."""
    rings: dict[str, Floats]
    """The three readings [m]."""

    @property
    def depths(self) -> dict[str, float]:
        """Largest excursion of each ring in the wrong direction [um]."""
        return {name: 1e3 * float(np.nanmax(ring * np.sign(self.change))) / MM for name, ring in self.rings.items()}

    def recovery(self, ring: Floats) -> float | None:
        """Time after which a ring is back and stays back [s]; None if it never is."""
        back = np.flatnonzero(ring * np.sign(self.change) > 0.0).max(initial=-1) + 1
        return None if back in (0, len(self.t)) or np.isnan(ring[back]) else float(self.t[back])


def read_rings(detector: RingDetector, r_c: Any, h_c: Any, images: Any = None) -> dict[str, Floats]:
    """The readings at radius r_c and height h_c [m], less those at rest, of ``images`` or of traced ones."""
    r, h = np.broadcast_arrays(r_c, h_c)
    pairs = list(zip(r.ravel().tolist(), h.ravel().tolist(), strict=True))
    shown = [picture(*pair, PULLER, VIEW) for pair in pairs] if images is None else images
    traced = np.array([wall_edge(make_scene(*pair, PULLER), VIEW).r for pair in pairs])
    return {
        "closed": r + hurle_ring_offset(r, h, PULLER) - PULLER.ring_bias - PULLER.r_0,
        "traced": traced.reshape(r.shape) - wall_edge(make_scene(PULLER.r_0, PULLER.h_0, PULLER), VIEW).r,
        "detected": np.array([detector.read(image).radius for image in shown]).reshape(r.shape) - PULLER.r_0,
    }


def respond(detector: RingDetector, change: float, model: str) -> Response:
    """Change the pull speed of a crystal at rest, and watch it through ``observation="camera"``."""
    env, over = CzEnv("nominal", model, "camera", INTERVAL, HORIZON, action="direct", info="all"), False
    shown = [env.reset(seed=0)]
    while not over:
        image, _, terminated, truncated, info = env.step(np.array([change, 0.0], np.float32))
        shown.append((image, info))
        over = terminated or truncated
    r_c, h_c = (np.array([info[name] for _, info in shown]) for name in ("r_c", "h_c"))
    rings = read_rings(detector, r_c, h_c, [image for image, _ in shown])
    return Response(model, change, np.linspace(0.0, HORIZON, len(shown)), r_c - PULLER.r_0, rings)


def numbers(detector: RingDetector, responses: Sequence[Response]) -> dict[str, Any]:
    """The content of ``camera.json``; gains are slopes of straight lines through +-1 mm about the operating point."""
    edge, step = wall_edge(make_scene(PULLER.r_0, PULLER.h_0, PULLER), VIEW), np.linspace(-1.0, 1.0, 41) * MM
    grid = read_rings(detector, PULLER.r_0 + RADII[:, None], PULLER.h_0 + HEIGHTS)
    worst = {name: float(np.nanmax(np.abs(grid["detected"] - grid[name]))) for name in ("closed", "traced")}
    by_radius, by_height = (
        {name: float(np.polyfit(step, ring, 1)[0]) for name, ring in read_rings(detector, r, h).items()}
        for r, h in ((PULLER.r_0 + step, PULLER.h_0), (PULLER.r_0, PULLER.h_0 + step))
    )
    return {
        "pixel_mm": detector.pixel / MM,
        "edge_slope_deg": math.degrees(edge.slope),
        "edge_outside_crystal_mm": (edge.r - PULLER.r_0) / MM,
        "closed_form_outside_crystal_mm": PULLER.ring_bias / MM,
        "largest_difference_px": {name: value / detector.pixel for name, value in worst.items()},
        "largest_difference_mm": {name: value / MM for name, value in worst.items()},
        "images_without_ring": int(np.isnan(grid["detected"]).sum()),
        "images": grid["detected"].size,
        "lowest_meniscus_with_a_ring_mm": edge.z / MM,
        "gain_by_radius": by_radius,
        "gain_by_height": by_height,
        "responses": [
            {
                "model": one.model,
                "change_of_pull": one.change,
                "depth_um": one.depths,
                "recovery_s": {name: one.recovery(ring) for name, ring in one.rings.items()},
            }
            for one in responses
        ],
    }


def view_figure(detector: RingDetector) -> bytes:
    """The image at a low, the nominal and a high meniscus, as PNG."""
    from cz_gym.evaluation.report.canvas import COLOURS, canvas, png

    figure, wide = canvas(9.6, 3.2), np.linspace(-0.6, 0.6, 121)
    axes = figure.subplots(1, 3, sharey=True)
    for axis, h_c in zip(axes, (5.0 * MM, PULLER.h_0, 8.0 * MM), strict=True):
        image = picture(PULLER.r_0, h_c, PULLER, VIEW)
        ring, offset = detector.read(image), float(hurle_ring_offset(PULLER.r_0, h_c, PULLER))
        axis.imshow(image[:, :, 0], cmap="gray", vmin=0, vmax=255, extent=(0, COLUMNS, ROWS, 0))
        for r, angles, z, colour, label in (
            (ring.edges, ANGLES, detector.height, COLOURS[2], "detected edge"),
            (PULLER.r_0 + offset, wide, 0.0, COLOURS[0], "closed-form ring"),
        ):
            seen = project(r * np.cos(angles), r * np.sin(angles), z, VIEW)
            axis.plot(seen.column, seen.row, lw=1.0, color=colour, label=label)
        errors = (ring.radius - PULLER.r_0) / MM, (offset - PULLER.ring_bias) / MM
        said = "$h_c$ = {:.2f} mm: detected {:+.2f} mm,\nclosed form {:+.2f} mm".format(h_c / MM, *errors)
        axis.set_title(said, fontsize=8.5)
        axis.set(xlim=(0, COLUMNS), ylim=(ROWS, 0), xlabel="column")
    axes[0].legend(fontsize=7, loc="upper center", framealpha=0.85)
    return png(figure)


def response_figure(responses: Sequence[Response]) -> bytes:
    """True radius and rings after sudden changes of the pull speed, as PNG."""
    from cz_gym.evaluation.report.canvas import COLOURS, INK, canvas, png

    figure = canvas(9.6, 6.0)
    for axis, one in zip(figure.subplots(2, 2, sharex=True).flat, responses, strict=True):
        axis.plot(one.t, 1e3 * one.r_c / MM, color=INK, label="true radius")
        for (name, ring), line, colour in zip(one.rings.items(), ("-", "--", "."), COLOURS, strict=False):
            axis.plot(one.t, 1e3 * ring / MM, line, color=colour, label=name)
        depths = ", ".join(f"{depth:.1f} ({name})" for name, depth in one.depths.items())
        title = f"Model {one.model}, pull speed {100 * one.change:+.0f} %\ndepth [µm]: {depths}"
        axis.set_title(title, fontsize=8.5)
        least = 1e3 * min(float(np.nanmin(ring)) for ring in one.rings.values()) / MM
        axis.set(ylim=(1.25 * least, -2.5 * least), xlabel="time [s]", ylabel="change of radius [µm]")
    figure.axes[0].legend(fontsize=7.5, loc="lower right")
    return png(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.camera", "Measure the camera's view and draw it.")
    parser.add_argument("--out", type=Path, default=Path("results/camera"), metavar="FOLDER", help="%(default)s")
    return parser.run(_study, arguments, "benchmark")


def _study(given: argparse.Namespace) -> None:
    import matplotlib  # noqa: F401  (missing? say so before the work, not after it)

    check_writable(given.out)
    detector = RingDetector(VIEW, PULLER)
    responses = [respond(detector, *each) for each in CHANGES]
    text = json.dumps(numbers(detector, responses), indent=1, allow_nan=False) + "\n"
    files = {"view.png": view_figure(detector), "response.png": response_figure(responses)}
    write_files({given.out / name: content for name, content in {"camera.json": text.encode(), **files}.items()})
    print(text, end="")


if __name__ == "__main__":
    sys.exit(main())
