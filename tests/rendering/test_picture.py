"""A picture shows the logged signals: pixels and drawn numbers against the record."""

import numpy as np
import pytest
from scipy.integrate import trapezoid

from cz_gym import HURLE, CzEnv, Parameters, make_puller
from cz_gym.env import CzCrystalEnv
from cz_gym.physics.meniscus import hurle_slope
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.rendering import canvas
from cz_gym.rendering import picture as triple_point
from cz_gym.rendering.picture import Ending, Picture
from cz_gym.support.units import MM

pygame = pytest.importorskip("pygame")
BOX = Picture(640, 480).box


def grown(steps=240, pull=0.0, kind=CzEnv, **arguments):
    """A crystal pulled with a slow swing of the pull speed, so that its surface is not straight."""
    env = kind(render_mode="rgb_array", observation="measured", **arguments)
    env.reset(seed=4)
    for k in range(steps):
        if env.step(np.array([pull + 0.25 * np.sin(0.06 * k), 0.0], np.float32))[2]:
            break
    frame = env.render()
    assert frame is not None
    return frame, env._view.record


def near(frame, colour, within=70.0):
    """Pixels close to a colour, shape (height, width)."""
    return np.linalg.norm(frame.astype(float) - colour, axis=-1) < within


def check_near(pixels, expected, reach):
    """The pixels of a line that are set within ``reach`` of the expected coordinate are centred on it, to one pixel."""
    first = round(expected) - reach
    assert np.flatnonzero(pixels[first : first + 2 * reach]).mean() + first + 0.5 == pytest.approx(expected, abs=1.0)


@pytest.fixture(scope="module")
def picture():
    return grown()


def test_a_whole_crystals_scale_follows_its_crown():
    """From the axis on; the camera's radius is that of the recipe's ring; the header and the end say what it is."""
    widths = []
    for steps in (100, 900):
        frame, record = grown(steps, kind=CzCrystalEnv, action="direct", scenario="nominal")
        scale = triple_point.scale_of(BOX, record)
        assert scale.x(0.0) == BOX.x
        assert near(frame[round(scale.y_0) - 1], canvas.MELT).any()
        row, (r_c, _, z) = round(scale.y(record.last("h_c") + 5 * MM)), record.surface()
        edge = np.interp((scale.y_0 - (row + 0.5)) / scale.per_metre, z, r_c)
        check_near(near(frame[row], canvas.TRUE), scale.x(edge), 8)
        widths.append(scale.per_metre)
        assert abs(record.camera_error[-1] - record.error[-1]) < 2 * MM
    assert widths[0] > 2.0 * widths[1]
    assert record.length[-1] == record.last("L")


@pytest.mark.parametrize(
    ("moved", "by", "ending"),
    [("r_c", 13 * MM, "LOST"), ("h_c", 9 * MM, "DETACHED"), ("T_b", -30.0, "COLD"), ("L", 0.03, "DONE")],
)
def test_how_a_whole_crystal_ends(moved, by, ending):
    env = CzCrystalEnv(render_mode="rgb_array", observation="measured", scenario="nominal", stage=1.24)
    env.reset(seed=0)
    env._slots["x"][moved] += by
    assert env.step(np.zeros(2, np.float32))[2]
    assert env._view.record.ending is Ending[ending]
    assert env.render().shape == (480, 640, 3)


def test_the_drawn_surface_is_the_logged_radius(picture):
    frame, record = picture
    scale = triple_point.scale_of(BOX, record)
    r_c, _, z = record.surface()
    blue = near(frame, canvas.TRUE)
    rows = range(round(BOX.y) + 8, round(scale.y(z[0])) - 8)
    for row in rows:
        check_near(blue[row], scale.x(np.interp((scale.y_0 - (row + 0.5)) / scale.per_metre, z, r_c)), 12)
    assert len(rows) > 50
    assert np.ptp(r_c) > 0.05 * MM


@pytest.mark.parametrize(("pull", "r_0"), [(-0.3, 87.5e-3), (0.3, 87.5e-3), (0.0, 20e-3), (0.0, 150e-3)])
def test_the_rings_mark_is_at_the_rings_radius(pull, r_0):
    frame, record = grown(60, pull=pull, parameters=Parameters(r_0=r_0))
    scale = triple_point.scale_of(BOX, record)
    # In the melt, where the mark's line goes down from the ring.
    check_near(near(frame, canvas.CAMERA)[round(scale.y_0 + 34)], scale.x(record.last("r_br")), 8)


@pytest.mark.parametrize(("model", "tolerance"), [(HURLE, 1e-6), (YOUNG_LAPLACE, 0.3 * MM)], ids=["hurle", "exact"])
def test_the_drawn_meniscus_leaves_the_triple_point_and_meets_the_ring(model, tolerance, monkeypatch):
    """Hurle's curve leaves at Hurle's slope; through the exact model's slope it passes near the exact ring."""
    monkeypatch.setattr(triple_point, "POINTS", 20_001)
    p = make_puller(meniscus=model)
    for h_c in (0.004, p.h_0, 0.0085) if model is HURLE else (p.h_0,):
        r, z, z_b = triple_point.meniscus_curve(p.r_0, h_c, p, model, Parameters().phi_b)
        assert (r[0], z[0]) == (p.r_0, h_c)
        ring = p.r_0 + model.ring_offset(p.r_0, h_c, p)
        assert np.interp(-z_b, -z, r) == pytest.approx(ring, abs=tolerance)
        if model is HURLE:
            sine, cosine = hurle_slope(p.r_0, h_c, p)
            assert (r[1] - r[0]) / (z[0] - z[1]) == pytest.approx(sine / cosine, rel=2e-3)


def test_length_grown_is_the_integral_of_the_growth_rate(picture):
    record = picture[1]
    assert record.length[-1] == pytest.approx(trapezoid(record.column("v_g"), record.t), rel=2e-3)


@pytest.mark.parametrize(("pull", "ending"), [(1.0, Ending.DETACHED), (-1.0, Ending.FROZEN)])
def test_the_picture_of_a_failed_crystal_has_a_band_that_says_so(pull, ending):
    # Model I finds a balance without any pull; Model II grows on, and freezes.
    frame, record = grown(900, pull=pull, scenario="nominal", model="II")
    assert record.ending is ending
    assert near(frame, canvas.ALARM, 5.0)[round(BOX.y) : round(BOX.y) + 30].sum() > 0.3 * 20 * BOX.w
