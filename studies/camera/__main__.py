"""What the camera sees, measured: ``python -m studies.camera [--out FOLDER]``.

Frames a second; the detector against the closed-form ring and against the exactly traced edge, in pixels; how far each
moves with radius and height; and their answers to a sudden change of the pull speed.
"""

from __future__ import annotations

import json
import math
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.camera.image import picture
from cz_gym.camera.rays import make_scene
from cz_gym.camera.ring_detector import RingDetector, wall_edge
from cz_gym.camera.view import Camera, View, make_view
from cz_gym.commands import OneLineParser, guarded
from cz_gym.env import CzEnv
from cz_gym.physics.meniscus import hurle_ring_offset
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.units import MM

Floats = npt.NDArray[np.float64]
RADII = np.linspace(-8.0, 8.0, 17) * MM
"""Radius less r_0 at which the readings are compared [m]."""
HEIGHTS = np.linspace(-2.0, 2.0, 9) * MM
"""Height less h_0 [m]."""
PULLS = (-0.1, -0.5)
"""Sudden changes of the pull speed, share of v_0; the first is the paper's."""
MODELS = ("I", "II")
INTERVAL, HORIZON = 2.0, 240.0
"""Between images, and of a response [s]."""
FRAMES = 300


class Rings(NamedTuple):
    """Three readings of the same crystals less what each says at the operating point [m], arrays of one shape."""

    closed: Floats
    """The plant's bright ring, at its effective slope."""
    traced: Floats
    """The point nearest to the camera that mirrors the wall's upper end."""
    detected: Floats
    """The detector's reading of the image."""


class Response(NamedTuple):
    """A crystal's answer to a sudden change of its pull speed; arrays of shape (images,)."""

    model: str
    change: float
    """Change of the pull speed, share of v_0 [-]."""
    t: Floats
    """[s]"""
    r_c: Floats
    """True radius less r_0 [m]."""
    h_c: Floats
    """Meniscus height [m]."""
    rings: Rings

    def depth(self, ring: Floats) -> float:
        """How far the ring goes the wrong way [m]."""
        return float(np.nanmax(ring * np.sign(self.change)))

    def recovery(self, ring: Floats) -> float:
        """Time after which it is back and stays back [s]; NaN if it never is."""
        wrong = np.flatnonzero(ring * np.sign(self.change) > 0.0)
        if wrong.size == 0 or wrong[-1] + 1 >= len(self.t) or np.isnan(ring[wrong[-1] + 1]):
            return math.nan
        return float(self.t[wrong[-1] + 1])


class Study(NamedTuple):
    """All that was measured."""

    camera: Camera
    view: View
    puller: Puller
    detector: RingDetector
    frames_per_s: float
    grid: Rings
    """On RADII x HEIGHTS."""
    gains: dict[str, tuple[float, float]]
    """Name of a ring to its derivatives by r_c and h_c at the operating point [-]."""
    responses: tuple[Response, ...]


def read_rings(r_c: Floats, h_c: Floats, detector: RingDetector, view: View, puller: Puller) -> Rings:
    """The three readings of crystals of radius r_c on menisci of height h_c [m]; arrays broadcast."""
    r, h = np.broadcast_arrays(r_c, h_c)
    at_rest = wall_edge(make_scene(puller.r_0, puller.h_0, puller), view).r
    pairs = list(zip(r.ravel().tolist(), h.ravel().tolist(), strict=True))
    traced = [wall_edge(make_scene(*pair, puller), view).r - at_rest for pair in pairs]
    detected = [detector.read(picture(*pair, puller, view)).radius - puller.r_0 for pair in pairs]
    closed = r + hurle_ring_offset(r, h, puller) - puller.ring_bias - puller.r_0
    return Rings(closed, np.array(traced).reshape(r.shape), np.array(detected).reshape(r.shape))


def gains(detector: RingDetector, view: View, puller: Puller) -> dict[str, tuple[float, float]]:
    """Slopes of each ring by radius and by height [-]: straight lines through +-1 mm about the operating point."""
    step = np.linspace(-1.0, 1.0, 41) * MM
    by_radius = read_rings(puller.r_0 + step, np.full_like(step, puller.h_0), detector, view, puller)
    by_height = read_rings(np.full_like(step, puller.r_0), puller.h_0 + step, detector, view, puller)

    def slope(ring: Floats) -> float:
        return float(np.polyfit(step, ring, 1)[0])

    pairs = zip(Rings._fields, by_radius, by_height, strict=True)
    return {name: (slope(radius), slope(height)) for name, radius, height in pairs}


def respond(model: str, change: float, detector: RingDetector, view: View, puller: Puller) -> Response:
    """Change the pull speed of a crystal at rest, and watch it through ``observation="camera"``."""
    env = CzEnv("nominal", model, "camera", INTERVAL, HORIZON, info="all")
    image, info = env.reset(seed=0)
    images, infos = [image], [info]
    over = False
    while not over:
        image, _, terminated, truncated, info = env.step(np.array([change, 0.0], np.float32))
        images.append(image)
        infos.append(info)
        over = terminated or truncated
    r_c, h_c, r_br = (np.array([info[name] for info in infos]) for name in ("r_c", "h_c", "r_br"))
    at_rest = wall_edge(make_scene(puller.r_0, puller.h_0, puller), view).r
    traced = [wall_edge(make_scene(r, h, puller), view).r - at_rest for r, h in zip(r_c, h_c, strict=True)]
    detected = [detector.read(image).radius - puller.r_0 for image in images]
    rings = Rings(r_br - puller.ring_bias - puller.r_0, np.array(traced), np.array(detected))
    return Response(model, change, np.linspace(0.0, HORIZON, len(images)), r_c - puller.r_0, h_c, rings)


def frames_per_second(view: View, puller: Puller) -> float:
    """Images of the operating point a second of one core's time, the median of FRAMES."""
    took = []
    for _ in range(FRAMES):
        began = time.process_time()
        picture(puller.r_0, puller.h_0, puller, view)
        took.append(time.process_time() - began)
    return 1.0 / statistics.median(took)


def measure() -> Study:
    """Measure everything; about a minute."""
    camera, puller = Camera(), make_puller()
    view = make_view(camera)
    detector = RingDetector(view, puller)
    grid = read_rings(puller.r_0 + RADII[:, None], puller.h_0 + HEIGHTS, detector, view, puller)
    responses = tuple(respond(m, change, detector, view, puller) for change in PULLS for m in MODELS)
    speed = frames_per_second(view, puller)
    return Study(camera, view, puller, detector, speed, grid, gains(detector, view, puller), responses)


def numbers(study: Study) -> dict[str, object]:
    """What was measured, as ``camera.json`` says it."""
    edge = wall_edge(make_scene(study.puller.r_0, study.puller.h_0, study.puller), study.view)
    pixel = study.detector.pixel
    worst = {
        name: float(np.nanmax(np.abs(study.grid.detected - getattr(study.grid, name)))) for name in Rings._fields[:2]
    }
    return {
        "frames_per_s": study.frames_per_s,
        "pixel_mm": pixel / MM,
        "edge_slope_deg": math.degrees(edge.slope),
        "edge_height_mm": edge.z / MM,
        "edge_outside_crystal_mm": (edge.r - study.puller.r_0) / MM,
        "closed_form_outside_crystal_mm": study.puller.ring_bias / MM,
        "detector_bias_mm": study.detector.bias / MM,
        "largest_difference_px": {name: value / pixel for name, value in worst.items()},
        "largest_difference_mm": {name: value / MM for name, value in worst.items()},
        "images_without_ring": int(np.isnan(study.grid.detected).sum()),
        "images": study.grid.detected.size,
        "lowest_meniscus_with_a_ring_mm": edge.z / MM,
        "gain_by_radius": {name: pair[0] for name, pair in study.gains.items()},
        "gain_by_height": {name: pair[1] for name, pair in study.gains.items()},
        "responses": [_response(response) for response in study.responses],
    }


def _response(response: Response) -> dict[str, object]:
    rings = response.rings._asdict()
    recovery = {name: response.recovery(ring) for name, ring in rings.items()}
    return {
        "model": response.model,
        "change_of_pull": response.change,
        "depth_um": {name: 1e3 * response.depth(ring) / MM for name, ring in rings.items()},
        "recovery_s": {name: None if math.isnan(value) else value for name, value in recovery.items()},
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.camera", "Measure the camera's view and draw it.")
    parser.add_argument("--out", type=Path, default=Path("results/camera"), metavar="FOLDER", help="%(default)s")
    out = parser.parse_args(arguments).out
    return guarded(parser.prog, lambda: _study(out), "benchmark")


def _study(out: Path) -> int:
    from .figures import response_figure, section_figure, view_figure

    check_writable(out)
    study = measure()
    text = json.dumps(numbers(study), indent=1, allow_nan=False) + "\n"
    write_files(
        {
            out / "camera.json": text.encode(),
            out / "view.png": view_figure(study),
            out / "section.png": section_figure(study),
            out / "response.png": response_figure(study),
        }
    )
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
