"""What a picture says is true: pixels against the logged signals."""

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import trapezoid

from cz_gym import HURLE, CzEnv, Parameters, make_puller
from cz_gym.physics.meniscus import hurle_slope
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.rendering import geometry, palette, pixels, puller_panel, strip_charts, triple_point
from cz_gym.rendering.geometry import first_at_least, meniscus_curve, ring_height
from cz_gym.rendering.record import Ending, Record, Sample, how_it_failed
from cz_gym.rendering.scene import layout
from cz_gym.rendering.view import record_of
from cz_gym.task import HEIGHT_MIN

pytest.importorskip("pygame")
SIZE = (640, 480)
MM = 1e-3
Frame = npt.NDArray[np.uint8]


def grown(steps: int = 240, seed: int = 4, pull: float = 0.0, **arguments: object) -> tuple[Frame, Record]:
    """A crystal pulled with a slow swing of the pull speed, so that its surface is not straight."""
    env = CzEnv(render_mode="rgb_array", observation="measured", **arguments)  # type: ignore[arg-type]
    env.reset(seed=seed)
    for k in range(steps):
        swing = 0.25 * np.sin(0.06 * k)
        if env.step(np.array([pull + swing, 0.0], np.float32))[2]:
            break
    frame = env.render()
    assert frame is not None
    return frame, record_of(env)


def near(frame: Frame, colour: palette.Colour, within: float = 70.0) -> npt.NDArray[np.bool_]:
    """Pixels close to a colour, shape (height, width)."""
    return np.linalg.norm(frame.astype(float) - colour, axis=-1) < within


@pytest.fixture(scope="module")
def picture() -> tuple[Frame, Record]:
    return grown()


@pytest.fixture(scope="module")
def record(picture: tuple[Frame, Record]) -> Record:
    return picture[1]


def test_the_drawn_surface_is_the_logged_radius(picture: tuple[Frame, Record]) -> None:
    frame, record = picture
    box = layout(*SIZE).triple_point
    scale = triple_point.scale_of(box, record)
    r_c, _, z = record.surface()
    blue = near(frame, palette.TRUE)
    checked = 0
    for row in range(round(box.y) + 24, round(float(scale.y(record.now.h_c))) - 8):
        height = (scale.y_0 - (row + 0.5)) / scale.per_metre
        expected = float(scale.x(np.interp(height, z, r_c)))
        left = round(expected) - 12
        found = left + np.flatnonzero(blue[row, left : left + 24])
        assert found.size
        assert abs(found.mean() + 0.5 - expected) <= 1.0
        checked += 1
    assert checked > 50
    assert np.ptp(r_c) > 0.05 * MM


@pytest.mark.parametrize("pull", [-0.3, 0.0, 0.3])
@pytest.mark.parametrize("r_0", [87.5e-3, 20e-3, 150e-3])
def test_the_ring_is_where_the_camera_looks(pull: float, r_0: float) -> None:
    frame, record = grown(60, pull=pull, parameters=Parameters(r_0=r_0))
    box, now = layout(*SIZE).triple_point, record.now
    scale = triple_point.scale_of(box, record)
    # The marker's line goes down from the ring through the melt: its column is the ring's radius.
    row = round(scale.y_0 + 34)
    expected = float(scale.x(now.r_br))
    left = round(expected) - 8
    found = left + np.flatnonzero(near(frame, palette.CAMERA)[row, left : left + 16])
    assert found.size
    assert abs(found.mean() + 0.5 - expected) <= 1.0


def test_strip_chart_ends_at_the_true_error(picture: tuple[Frame, Record]) -> None:
    frame, record = picture
    plot = layout(*SIZE).charts[0].inner(38.0, 18.0, 10.0, 14.0)
    now = record.now
    error = record.error
    reach = first_at_least(1.15 * float(np.abs(error).max()), triple_point.RANGES)
    x = plot.x + now.t / record.config.horizon * plot.w
    y = plot.y + plot.h / 2 - (now.r_c - now.r_ref) / reach * plot.h / 2
    window = near(frame, palette.TRUE)[:, round(x) : round(x) + 3]
    rows = np.flatnonzero(window.any(axis=1) & (np.abs(np.arange(SIZE[1]) - y) < 8))
    assert abs(rows.mean() + 0.5 - y) <= 1.0


def test_meniscus_curve_leaves_the_crystal_at_hurles_slope_and_meets_the_ring(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geometry, "POINTS", 20_001)
    p = make_puller()
    for h_c in (0.004, p.h_0, 0.0085):
        r, z = meniscus_curve(p.r_0, h_c, p, HURLE)
        assert (r[0], z[0]) == (p.r_0, h_c)
        sine, cosine = hurle_slope(p.r_0, h_c, p)
        assert (r[1] - r[0]) / (z[0] - z[1]) == pytest.approx(sine / cosine, rel=2e-3)
        z_b = ring_height(p.r_0, h_c, p, HURLE, Parameters().phi_b)
        at_ring = np.interp(-z_b, -z, r)
        assert at_ring == pytest.approx(p.r_0 + HURLE.ring_offset(p.r_0, h_c, p), abs=1e-6)


def test_another_meniscus_leaves_from_the_same_triple_point() -> None:
    p = make_puller(meniscus=YOUNG_LAPLACE)
    r, z = meniscus_curve(p.r_0, p.h_0, p, YOUNG_LAPLACE)
    assert (r[0], z[0]) == (p.r_0, p.h_0)
    ring = p.r_0 + YOUNG_LAPLACE.ring_offset(p.r_0, p.h_0, p)
    z_b = ring_height(p.r_0, p.h_0, p, YOUNG_LAPLACE, Parameters().phi_b)
    assert np.interp(-z_b, -z, r) == pytest.approx(ring, abs=0.3 * MM)


def test_length_grown_is_the_integral_of_the_growth_rate(record: Record) -> None:
    integral = trapezoid(record.column("v_g"), record.column("t"))
    assert record.now.length == pytest.approx(integral, rel=2e-3)


def test_what_was_melted_back_hangs_there_no_more() -> None:
    env = CzEnv("nominal", render_mode="rgb_array")
    env.reset(seed=1)
    record = record_of(env)
    info, names = env._said.copy(), ("r_c", "v_p")
    for radius, v_p in (0.0871, 1e-3), (0.0872, 1e-3), (0.0873, -1.5e-3), (0.0874, 1e-4):
        for name, value in zip(names, (radius, v_p), strict=True):
            info[("r_c", "r_br", "r_ref", "h_c", "alpha_c", "v_g", "v_p").index(name)] = value
        record.add(info, 1.0)
    r_c, _, z = record.surface()
    assert np.all(np.diff(z) >= 0)
    assert r_c == pytest.approx([0.0874, 0.0873, record.puller.r_0])
    assert env.render() is not None


@pytest.mark.parametrize(
    ("h_c", "error", "ending"),
    [
        (0.9 * HEIGHT_MIN, 0.0, Ending.FROZEN),
        (HEIGHT_MIN * 1.001, 0.0, Ending.FROZEN),
        (1.3 * 7.56 * MM, 0.001, Ending.DETACHED),
        (6.6 * MM, -8.1 * MM, Ending.LOST),
    ],
)
def test_failures_are_named(h_c: float, error: float, ending: Ending) -> None:
    sample = Sample(*([0.0] * len(Sample._fields)))._replace(r_c=0.0875 + error, r_ref=0.0875, h_c=h_c)
    assert how_it_failed(sample, 7.56 * MM) is ending


@pytest.mark.parametrize(("pull", "ending"), [(1.0, Ending.DETACHED), (-1.0, Ending.FROZEN)])
def test_a_failed_crystal_has_a_picture_that_says_so(pull: float, ending: Ending) -> None:
    # Model I finds a balance without any pull; Model II grows on, and freezes.
    frame, record = grown(900, pull=pull, scenario="nominal", model="II")
    assert record.ending is ending
    box = layout(*SIZE).triple_point
    banner = near(frame, palette.ALARM, 5.0)[round(box.y) : round(box.y) + 30]
    assert banner.sum() > 0.3 * 20 * box.w


def test_the_crucible_rises_by_what_the_crystal_took(record: Record) -> None:
    grown_mass = 2330 * np.pi * trapezoid(record.column("r_c") ** 2, record.column("length"))
    melt_mass = 2570 * np.pi * 0.28**2 * puller_panel.crucible_rise(record)
    assert melt_mass == pytest.approx(grown_mass, rel=1e-3)


def test_long_traces_keep_their_extremes() -> None:
    values = np.sin(np.arange(40_000) * 1.7)
    values[12_345] = 7.0
    t, thin = strip_charts.thinned(np.arange(40_000.0), values, 80)
    assert len(t) == len(thin) == 1000
    assert thin.max() == 7.0
    assert thin.min() == values.min()


def test_a_picture_is_the_mean_of_twice_its_resolution(rng: np.random.Generator) -> None:
    pygame = pytest.importorskip("pygame")
    fine, half = pygame.Surface((86, 34), 0, 32), pygame.Surface((43, 17), 0, 32)
    colours = rng.integers(0, 256, (86, 34, 3), np.uint8)
    colours[:4, :4] = (255, 0, 255)
    pygame.surfarray.blit_array(fine, colours)
    pixels.halve(fine, half)
    mean = np.floor(colours.reshape(43, 2, 17, 2, 3).mean(axis=(1, 3)) + 0.5)
    np.testing.assert_array_equal(pygame.surfarray.array3d(half), mean)
    np.testing.assert_array_equal(pixels.colours(half), mean.swapaxes(0, 1))


def test_running_mean_is_of_what_there_is() -> None:
    values = np.arange(200.0)
    mean = strip_charts.running_mean(values, 5.0)
    assert mean[0] == 0.0
    assert mean[10] == values[:11].mean()
    assert mean[150] == pytest.approx(values[91:151].mean())
