"""Figures of the camera's view: images, a section with its rays, and answers to a change of the pull speed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from cz_gym.camera.image import picture
from cz_gym.camera.rays import FLAT, MELT, Ray, Scene, first_hit, make_scene, mirror, profile_at
from cz_gym.camera.ring_detector import ANGLES, wall_edge
from cz_gym.camera.view import COLUMNS, ROWS, Camera, View, project
from cz_gym.evaluation.report.canvas import COLOURS, GREY, INK, canvas, png
from cz_gym.physics.meniscus import hurle_ring_offset
from cz_gym.physics.plant import Puller
from cz_gym.units import MM

from .measurements import Bench, Response

DETECTED, CLOSED, TRUE, TRACED, EDGE = COLOURS[1], COLOURS[0], INK, COLOURS[2], "#56B4E9"


def view_figure(bench: Bench) -> bytes:
    """The image at a low, the nominal and a high meniscus."""
    figure = canvas(9.6, 3.2)
    axes = figure.subplots(1, 3, sharey=True)
    for axis, h_c in zip(axes, (5.0 * MM, bench.puller.h_0, 8.0 * MM), strict=True):
        _draw_image(axis, bench, h_c, picture(bench.puller.r_0, h_c, bench.puller, bench.view))
    axes[0].set_ylabel("row")
    axes[0].legend(fontsize=7, loc="upper center", framealpha=0.85)
    return png(figure)


def _draw_image(axis: Any, bench: Bench, h_c: float, image: Any) -> None:
    view, p, detector = bench
    axis.imshow(
        image[:, :, 0], cmap="gray", vmin=0, vmax=255, extent=(0, COLUMNS, ROWS, 0), interpolation="nearest", zorder=1
    )
    ring = detector.read(image)
    seen = project(ring.edges * np.cos(ANGLES), ring.edges * np.sin(ANGLES), detector.height, view)
    axis.plot(seen.column, seen.row, color=EDGE, lw=1.0, label="detected edge")
    r_br = _closed_form(p, h_c)
    wide = np.linspace(-0.6, 0.6, 121)
    closed = project(r_br * np.cos(wide), r_br * np.sin(wide), 0.0, view)
    inside = (closed.column >= 0) & (closed.column <= COLUMNS)
    axis.plot(closed.column[inside], closed.row[inside], color=CLOSED, lw=1.0, ls="--", label="closed-form ring")
    axis.set_title(f"$h_c$ = {h_c / MM:.2f} mm: detected {(ring.radius - p.r_0) / MM:+.2f} mm,\n"
                   f"closed form {(r_br - p.ring_bias - p.r_0) / MM:+.2f} mm", fontsize=8.5)  # fmt: skip
    axis.set_xlabel("column")


def _closed_form(p: Puller, h_c: float) -> float:
    """Radius of the plant's bright ring at r_0 [m]."""
    return p.r_0 + float(hurle_ring_offset(p.r_0, h_c, p))


def section_figure(bench: Bench) -> bytes:
    """Hot zone and meniscus in the camera's plane, with rays."""
    view, p, _ = bench
    scene = make_scene(p.r_0, p.h_0, p)
    edge = wall_edge(scene, view)
    figure = canvas(9.6, 4.2)
    zone, close = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    for axis in (zone, close):
        _draw_crystal(axis, scene, view.camera.crucible_radius)
        for z, colour in (
            (0.5 * (edge.z + scene.h_c), COLOURS[4]), (edge.z + 0.02 * MM, TRACED), (0.25 * edge.z, COLOURS[1])
        ):  # fmt: skip
            _draw_ray(axis, z, scene, view, colour)
        axis.set_aspect("equal")
    _draw_hot_zone(zone, view.camera)
    r_br = _closed_form(p, p.h_0)
    close.plot(edge.r / MM, edge.z / MM, "o", color=TRACED, ms=5)
    said = f"ring's outer edge,\nslope {math.degrees(edge.slope):.1f}°"
    line = {"arrowstyle": "-", "color": GREY}
    close.annotate(said, (edge.r / MM, edge.z / MM), (84.3, -1.2), fontsize=8, arrowprops=line)
    close.plot(r_br / MM, 0.4, "v", color=CLOSED, ms=6)
    close.text(r_br / MM, 1.1, "closed-form ring,\neffective slope 3.5°", fontsize=8, ha="center")
    close.set(xlim=(84, 108), ylim=(-2, 12), xlabel="distance from the axis [mm]")
    return png(figure)


def _draw_hot_zone(axis: Any, camera: Camera) -> None:
    wall, height, opening = camera.crucible_radius / MM, camera.wall_height / MM, camera.shield_radius / MM
    axis.plot([wall, wall], [0, height], color=COLOURS[0], lw=3, solid_capstyle="butt")
    axis.plot([opening, wall], [height, height], color=GREY, lw=3, solid_capstyle="butt")
    hot = f"hot wall\n{camera.wall_temperature:.0f} K"
    axis.text(wall - 4, 0.5 * height, hot, ha="right", va="center", fontsize=8)
    shield = f"heat shield, {camera.shield_temperature:.0f} K"
    for x, y, text in ((0.5 * (opening + wall), height + 4, shield), (40, 70, "crystal"), (200, -13, "melt")):
        axis.text(x, y, text, ha="center", fontsize=8)
    axis.text(166, 165, "to the camera", fontsize=8, rotation=70, rotation_mode="anchor", ha="right")
    axis.set(xlim=(0, wall + 12), ylim=(-22, 175), xlabel="distance from the axis [mm]", ylabel="height [mm]")


def _draw_crystal(axis: Any, scene: Scene, outer: float) -> None:
    q = np.linspace(float(scene.q_c), FLAT, 400)
    points = [profile_at(each, scene) for each in q]
    r = np.array([0.0, scene.r_c, *[point[0] for point in points], outer]) / MM
    z = np.array([scene.h_c, scene.h_c, *[point[1] for point in points], 0.0]) / MM
    axis.fill_between(r, z, -30.0, color="#f3d9b1", lw=0)
    axis.fill_between([0.0, scene.r_c / MM], scene.h_c / MM, 400.0, color="#d9d9d9", lw=0)
    axis.plot(r, z, color=INK, lw=1.0)


def _draw_ray(axis: Any, z: float, scene: Scene, view: View, colour: str) -> None:
    """A ray from the lens to the meniscus at height z and, mirrored, on to what it hits."""
    q = math.acosh(math.sqrt(2.0) * float(scene.M) / z)
    r = float(profile_at(q, scene)[0])
    ray = Ray(view.x, 0.0, view.z, r - view.x, 0.0, z - view.z)
    x, heights = [view.x], [view.z]
    start = scene.q_c
    for _ in range(3):
        hit = first_hit(ray, start, scene, view)
        far = hit if hit.what != 4 else hit._replace(x=ray.x + 2.0 * ray.dx, z=ray.z + 2.0 * ray.dz)
        x.append(far.x)
        heights.append(far.z)
        if hit.what != MELT:
            break
        ray = mirror(ray, hit)
        start = FLAT if hit.q < 0.0 else hit.q + math.copysign(1e-4, -ray.dz)
    axis.plot(np.array(x) / MM, np.array(heights) / MM, color=colour, lw=1.1)


def response_figure(responses: Sequence[Response]) -> bytes:
    """True radius and rings after sudden changes of the pull speed."""
    figure = canvas(9.6, 6.0)
    axes = figure.subplots(2, 2, sharex=True)
    for axis, response in zip(axes.flat, responses, strict=True):
        _draw_response(axis, response)
    for axis in axes[1]:
        axis.set_xlabel("time after the change [s]")
    for axis in axes[:, 0]:
        axis.set_ylabel("change of radius [µm]")
    axes[0, 0].legend(fontsize=7.5, loc="lower right")
    return png(figure)


def _draw_response(axis: Any, response: Response) -> None:
    rings = response.rings
    for name, values, colour, line in (
        ("true radius", response.r_c, TRUE, {"ls": "-", "lw": 1.3}),
        ("closed-form ring", rings.closed, CLOSED, {"ls": "-", "lw": 1.3}),
        ("exactly traced edge", rings.traced, TRACED, {"ls": "--", "lw": 1.3}),
        ("image and detector", rings.detected, DETECTED, {"ls": "", "marker": ".", "ms": 4}),
    ):
        axis.plot(response.t, 1e3 * values / MM, color=colour, label=name, **line)
    depths = ", ".join(f"{1e3 * response.depth(ring) / MM:.1f} ({name})" for name, ring in rings._asdict().items())
    title = f"Model {response.model}, pull speed {100 * response.change:+.0f} %\ndepth [µm]: {depths}"
    axis.set_title(title, fontsize=8.5)
    least = 1e3 * min(float(np.nanmin(ring)) for ring in rings) / MM
    axis.set_ylim(1.25 * least, -2.5 * least)
