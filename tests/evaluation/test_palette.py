"""Colours of figures: those that share a figure stay apart for every reader."""

import numpy as np
import pytest

from cz_gym.evaluation.plots import COLOURS, DASHES, DRIVE, INK, LEARNED, MARKS, RING, STYLES, TRUE, lighter, styles
from cz_gym.rendering import canvas

KINDS = {
    "none": np.eye(3),
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
"""Machado, Oliveira and Fernandes (2009): linear RGB as it is seen, at full severity."""
LEAST = 15.0
"""Least distance of two colours of a figure in CIELAB [-]; 2.3 is just seen."""
ON_DARK = [f"#{red:02X}{green:02X}{blue:02X}"
           for red, green, blue in (canvas.TRUE, canvas.CAMERA, canvas.REFERENCE, canvas.DRIVE)]  # fmt: skip


def linear(colours):
    """Linear RGB of colours such as "#D55E00", shape (colours, 3)."""
    c = np.array([[int(colour[place : place + 2], 16) for place in (1, 3, 5)] for colour in colours]) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    """CIELAB of linear RGB under D65."""
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    t = np.clip(rgb, 0.0, 1.0) @ np.transpose(to_xyz) / (0.9505, 1.0, 1.089)
    x, y, z = np.moveaxis(np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16.0 / 116.0), -1, 0)
    return np.stack((116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)), axis=-1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "colours",
    [COLOURS, [*map(lighter, COLOURS)], [TRUE, RING, DRIVE, INK], ON_DARK],
    ids=["controllers", "on a dark ground", "signals", "window"],
)
def test_colours_of_a_figure_stay_apart_for_colour_blind_readers(colours, kind):
    seen = lab(linear(colours) @ np.transpose(KINDS[kind]))
    apart = np.linalg.norm(seen[:, None] - seen, axis=-1)[np.triu_indices(len(colours), 1)]
    assert apart.min() >= LEAST


def test_true_radius_and_ring_have_one_hue_each_on_white_and_in_the_window():
    light, dark = lab(linear([TRUE, RING, DRIVE])), lab(linear([ON_DARK[0], ON_DARK[1], ON_DARK[3]]))
    hues = [np.arctan2(each[:, 2], each[:, 1]) for each in (light, dark)]
    assert np.abs(np.angle(np.exp(1j * (hues[0] - hues[1])))).max() < np.deg2rad(35.0)


def test_colours_are_seen_on_their_ground():
    luminance = [linear(each) @ [0.2126, 0.7152, 0.0722] for each in (COLOURS, [*map(lighter, COLOURS)])]
    assert (1.05 / (luminance[0] + 0.05)).min() > 2.5
    assert ((luminance[1] + 0.05) / (linear(["#0d1117"]) @ [0.2126, 0.7152, 0.0722] + 0.05)).min() > 2.5


def test_a_look_differs_in_colour_mark_and_dashes_and_diamonds_are_learned():
    assert len(COLOURS) == len(DASHES) == len({*DASHES})
    body, whole = ([*STYLES.values()][:8], [*STYLES.values()][8:16])
    for looks in (body, whole):
        assert [len({*part}) for part in zip(*looks, strict=True)] == [8] * 3
    assert [name for name, look in STYLES.items() if look.mark in LEARNED] == [
        "gradient", "ppo", "sac", "ppo-plain", "gradient-along", "ppo-along",
    ]  # fmt: skip


def test_many_unknown_names_have_looks_of_their_own():
    names = [f"c{number}" for number in range(48)]
    known = styles([*names, "gradient", "mine"], learned=["mine"])
    assert len({*known.values()}) == 50
    assert known["gradient"] == STYLES["gradient"]
    assert known["mine"].mark in LEARNED
    assert {len(corners) > 2 for corners in MARKS.values()} == {True}
