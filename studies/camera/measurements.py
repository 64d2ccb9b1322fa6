"""Three readings of the bright ring: their slopes, and their responses to a change of the pull speed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.camera.image import picture
from cz_gym.camera.rays import make_scene
from cz_gym.camera.ring_detector import RingDetector, wall_edge
from cz_gym.camera.view import Camera, View, make_view
from cz_gym.env import CzEnv
from cz_gym.physics.linearisation import Floats
from cz_gym.physics.meniscus import hurle_ring_offset
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.units import MM

RADII = np.linspace(-8.0, 8.0, 17) * MM
"""Radius less r_0 at which the readings are compared [m]."""
HEIGHTS = np.linspace(-2.0, 2.0, 9) * MM
"""Height less h_0 [m]."""
PULLS, MODELS = (-0.1, -0.5), ("I", "II")
"""Sudden changes of the pull speed, share of v_0, the paper's first; models they are made on."""
INTERVAL, HORIZON = 2.0, 240.0
"""Between images, and of a response [s]."""


class Bench(NamedTuple):
    """The default camera at the nominal puller, and a detector for it."""

    view: View
    puller: Puller
    detector: RingDetector


class Rings(NamedTuple):
    """Three readings of the same crystals, less their values at the operating point [m]; arrays of one shape."""

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
    rings: Rings

    def depth(self, ring: Floats) -> float:
        """Largest excursion of the ring in the wrong direction [m]."""
        return float(np.nanmax(ring * np.sign(self.change)))

    def recovery(self, ring: Floats) -> float | None:
        """Time after which the ring is back and stays back [s]; None if it never is."""
        wrong = np.flatnonzero(ring * np.sign(self.change) > 0.0)
        if wrong.size == 0 or wrong[-1] + 1 >= len(self.t) or np.isnan(ring[wrong[-1] + 1]):
            return None
        return float(self.t[wrong[-1] + 1])


def make_bench() -> Bench:
    """The default camera, puller and detector."""
    view, puller = make_view(Camera()), make_puller()
    return Bench(view, puller, RingDetector(view, puller))


def read_rings(bench: Bench, r_c: Floats, h_c: Floats, images: npt.NDArray[np.uint8] | None = None) -> Rings:
    """The three readings of crystals of radius r_c on menisci of height h_c [m], arrays that broadcast.

    ``images`` of the crystals, in order, are drawn unless given.
    """
    view, p, detector = bench
    r, h = np.broadcast_arrays(r_c, h_c)
    pairs = list(zip(r.ravel().tolist(), h.ravel().tolist(), strict=True))
    at_rest = wall_edge(make_scene(p.r_0, p.h_0, p), view).r
    traced = [wall_edge(make_scene(*pair, p), view).r - at_rest for pair in pairs]
    shown = [picture(*pair, p, view) for pair in pairs] if images is None else images
    detected = [detector.read(image).radius - p.r_0 for image in shown]
    closed = r + hurle_ring_offset(r, h, p) - p.ring_bias - p.r_0
    return Rings(closed, np.array(traced).reshape(r.shape), np.array(detected).reshape(r.shape))


def slopes(bench: Bench) -> tuple[dict[str, float], dict[str, float]]:
    """Slopes of each ring by radius and by height [-]: straight lines through +-1 mm about the operating point."""
    step, p = np.linspace(-1.0, 1.0, 41) * MM, bench.puller
    by_radius, by_height = (
        {name: float(np.polyfit(step, ring, 1)[0]) for name, ring in read_rings(bench, r, h)._asdict().items()}
        for r, h in ((p.r_0 + step, np.array(p.h_0)), (np.array(p.r_0), p.h_0 + step))
    )
    return by_radius, by_height


def respond(bench: Bench, model: str, change: float) -> Response:
    """Change the pull speed of a crystal at rest, and watch it through ``observation="camera"``."""
    env, over = CzEnv("nominal", model, "camera", INTERVAL, HORIZON, info="all"), False
    shown = [env.reset(seed=0)]
    while not over:
        image, _, terminated, truncated, info = env.step(np.array([change, 0.0], np.float32))
        shown.append((image, info))
        over = terminated or truncated
    r_c, h_c = (np.array([info[name] for _, info in shown]) for name in ("r_c", "h_c"))
    rings = read_rings(bench, r_c, h_c, np.array([image for image, _ in shown]))
    return Response(model, change, np.linspace(0.0, HORIZON, len(shown)), r_c - bench.puller.r_0, rings)


def numbers(bench: Bench, responses: list[Response]) -> dict[str, object]:
    """The content of ``camera.json``."""
    view, p, detector = bench
    edge = wall_edge(make_scene(p.r_0, p.h_0, p), view)
    grid = read_rings(bench, p.r_0 + RADII[:, None], p.h_0 + HEIGHTS)
    by_radius, by_height = slopes(bench)
    worst = {
        name: float(np.nanmax(np.abs(grid.detected - ring)))
        for name, ring in (("closed", grid.closed), ("traced", grid.traced))
    }
    return {
        "pixel_mm": detector.pixel / MM,
        "edge_slope_deg": math.degrees(edge.slope),
        "edge_height_mm": edge.z / MM,
        "edge_outside_crystal_mm": (edge.r - p.r_0) / MM,
        "closed_form_outside_crystal_mm": p.ring_bias / MM,
        "detector_bias_mm": detector.bias / MM,
        "largest_difference_px": {name: value / detector.pixel for name, value in worst.items()},
        "largest_difference_mm": {name: value / MM for name, value in worst.items()},
        "images_without_ring": int(np.isnan(grid.detected).sum()),
        "images": grid.detected.size,
        "lowest_meniscus_with_a_ring_mm": edge.z / MM,
        "gain_by_radius": by_radius,
        "gain_by_height": by_height,
        "responses": [
            {
                "model": one.model,
                "change_of_pull": one.change,
                "depth_um": {name: 1e3 * one.depth(ring) / MM for name, ring in one.rings._asdict().items()},
                "recovery_s": {name: one.recovery(ring) for name, ring in one.rings._asdict().items()},
            }
            for one in responses
        ],
    }
