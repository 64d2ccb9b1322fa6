"""The paper's block diagrams, drawn from lists of boxes and arrows on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple


class Box(NamedTuple):
    """A block, or with text "+" a summing point, centred at (x, y)."""

    x: float
    y: float
    text: str


class Arrow(NamedTuple):
    """A line through the points, an arrow head at the last, a label at the middle of its first leg."""

    points: Sequence[tuple[float, float]]
    text: str = ""
    minus: bool = False
    """Whether the summing point at its head subtracts."""


_HALF, _HIGH, _SUM = 0.55, 0.32, 0.16


def draw(boxes: Sequence[Box], arrows: Sequence[Arrow], size: tuple[float, float]) -> Any:
    """A figure of boxes and arrows; one unit of the grid is about an inch."""
    from matplotlib import patches
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axis = figure.subplots()
    for box in boxes:
        if box.text == "+":
            axis.add_patch(patches.Circle((box.x, box.y), _SUM, fill=False))
        else:
            low = (box.x - _HALF, box.y - _HIGH)
            axis.add_patch(patches.Rectangle(low, 2 * _HALF, 2 * _HIGH, facecolor="#eef3fa", edgecolor="black"))
        axis.text(box.x, box.y, box.text, ha="center", va="center", fontsize=9)
    for arrow in arrows:
        *way, last = arrow.points
        axis.plot(*zip(*arrow.points, strict=True), linestyle="none")
        if len(way) > 1:
            axis.plot(*zip(*way, strict=True), color="black", linewidth=0.9)
        head = {"arrowstyle": "-|>", "color": "black", "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0}
        axis.annotate("", last, way[-1], arrowprops=head)
        if arrow.minus:
            axis.text(last[0] + 0.1, last[1] - 0.14, "$-$", fontsize=9)
        if arrow.text:
            (x_0, y_0), (x_1, y_1) = arrow.points[:2]
            beside = 0.08 if x_0 == x_1 else 0.0
            axis.text(
                0.5 * (x_0 + x_1) + beside, 0.5 * (y_0 + y_1) + (0.0 if beside else 0.08), arrow.text,
                ha="left" if beside else "center", va="center" if beside else "bottom", fontsize=9,
            )  # fmt: skip
    axis.set_aspect("equal")
    axis.set_axis_off()
    axis.autoscale_view()
    return figure


def series_connection() -> Any:
    """Plant and measurement in series."""
    return draw(
        [Box(2, 0, "$G_p(s)$"), Box(4, 0, "$G_m(s)$")],
        [
            Arrow([(0.6, 0), (1.45, 0)], "$V_p$"),
            Arrow([(2.55, 0), (3.45, 0)], "$R_c$"),
            Arrow([(4.55, 0), (5.4, 0)], "$R_{br}$"),
        ],
        (5.0, 1.2),
    )


def feedback() -> Any:
    """A feedback loop with an output disturbance."""
    return draw(
        [Box(1, 0, "+"), Box(2.3, 0, "$K(s)$"), Box(4.2, 0, "$G(s)$"), Box(5.8, 0, "+"), Box(5.8, 1.1, "$G_d(s)$")],
        [
            Arrow([(0, 0), (0.84, 0)], "$R$"),
            Arrow([(1.16, 0), (1.75, 0)], "$E$"),
            Arrow([(2.85, 0), (3.65, 0)], "$U$"),
            Arrow([(4.75, 0), (5.64, 0)]),
            Arrow([(5.8, 1.9), (5.8, 1.42)], "$V$"),
            Arrow([(5.8, 0.78), (5.8, 0.16)]),
            Arrow([(5.96, 0), (7.0, 0)], "$Y$"),
            Arrow([(6.5, 0), (6.5, -0.8), (1, -0.8), (1, -0.16)], minus=True),
        ],
        (6.4, 2.6),
    )


def parallel() -> Any:
    """Feedback with a parallel compensator."""
    return draw(
        [Box(1, 0, "+"), Box(2.3, 0, "$K(s)$"), Box(4.6, 0, "$G(s)$"), Box(4.6, -1, "$G_{pc}(s)$"), Box(6.2, 0, "+")],
        [
            Arrow([(0, 0), (0.84, 0)], "$R$"),
            Arrow([(1.16, 0), (1.75, 0)], "$E$"),
            Arrow([(2.85, 0), (4.05, 0)], "$U$"),
            Arrow([(3.45, 0), (3.45, -1), (4.05, -1)]),
            Arrow([(5.15, 0), (6.04, 0)], "$Y$"),
            Arrow([(5.15, -1), (6.2, -1), (6.2, -0.16)], "$Y_{pc}$"),
            Arrow([(6.36, 0), (7.4, 0)], "$Z$"),
            Arrow([(6.9, 0), (6.9, -1.8), (1, -1.8), (1, -0.16)], minus=True),
        ],
        (6.6, 2.6),
    )


def compensated_loop() -> Any:
    """The linear loop: plant, measurement, compensator behind its high-pass filter, controller."""
    return draw(
        [
            Box(1, 0, "+"), Box(2.3, 0, "$K(s)$"), Box(4.6, 0, "$G_p(s)$"), Box(6.6, 0, "$G_m(s)$"),
            Box(4.6, -1, "$G_{hpf}(s)$"), Box(6.6, -1, "$G_{pc}(s)$"), Box(8.1, 0, "+"),
        ],
        [
            Arrow([(0, 0), (0.84, 0)], r"$R_{c,ref}$"),
            Arrow([(1.16, 0), (1.75, 0)]),
            Arrow([(2.85, 0), (4.05, 0)], "$V_p$"),
            Arrow([(3.45, 0), (3.45, -1), (4.05, -1)]),
            Arrow([(5.15, 0), (6.05, 0)], "$R_c$"),
            Arrow([(5.15, -1), (6.05, -1)]),
            Arrow([(7.15, 0), (7.94, 0)], "$R_{br}$"),
            Arrow([(7.15, -1), (8.1, -1), (8.1, -0.16)], "$Y_{pc}$"),
            Arrow([(8.26, 0), (9.3, 0)], r"$\tilde R$"),
            Arrow([(8.8, 0), (8.8, -1.8), (1, -1.8), (1, -0.16)], minus=True),
        ],
        (7.2, 2.3),
    )  # fmt: skip


def tested_loop() -> Any:
    """The loop on the nonlinear plant: deviations outside, the operating point added and removed at its border."""
    return draw(
        [
            Box(1, 0, "+"), Box(2.2, 0, "$-K$"), Box(4.2, 0, "+"), Box(5.6, 0, "Cz plant"), Box(7.2, 0, "+"),
            Box(5.6, -1, "$G_{pc,real}$"), Box(8.6, 0, "+"),
        ],
        [
            Arrow([(-0.1, 0), (0.84, 0)], r"$\delta r_{ref}$"),
            Arrow([(1.16, 0), (1.65, 0)]),
            Arrow([(2.75, 0), (4.04, 0)], r"$\delta v_p$"),
            Arrow([(3.35, 0), (3.35, -1), (5.05, -1)]),
            Arrow([(4.2, 0.9), (4.2, 0.16)], "$v_0$"),
            Arrow([(4.36, 0), (5.05, 0)], "$v_p$"),
            Arrow([(6.15, 0), (7.04, 0)], "$r_{br}$"),
            Arrow([(7.2, 0.9), (7.2, 0.16)], r"$-r_{br,0}$"),
            Arrow([(7.36, 0), (8.44, 0)], r"$\delta r_{br}$"),
            Arrow([(6.15, -1), (8.6, -1), (8.6, -0.16)], "$y_{pc}$"),
            Arrow([(8.76, 0), (9.8, 0)], r"$\delta\tilde r$"),
            Arrow([(9.3, 0), (9.3, -1.8), (1, -1.8), (1, -0.16)], minus=True),
        ],
        (7.4, 2.6),
    )  # fmt: skip
