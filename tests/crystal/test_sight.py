"""What the camera sees of a whole crystal: flags against traced rays and images, the edge's noise, held errors."""

import numpy as np
import pytest

from cz_gym import HURLE, decode
from cz_gym.camera.image import first_row, grey_value
from cz_gym.camera.view import Camera, make_scene, make_view, project
from cz_gym.config import make_config
from cz_gym.crystal import recipe, sight
from cz_gym.crystal.process import CRYSTAL, linear_recipe, nominal_recipe
from cz_gym.env import CzCrystalEnv, CzCrystalVectorEnv
from cz_gym.episodes.draw import Episode
from cz_gym.support.units import MM

PULLERS = "default", "silicon-300mm", "germanium"
PLAIN = {"observation": "measured", "action": "direct", "info": "all"}
_STEP = 0.05


def on_recipe(puller):
    """Constants, camera's view, and the state on the recipe by length."""
    config = make_config(process=CRYSTAL, puller=puller)
    p, table = nominal_recipe(config.parameters._replace(**dict.fromkeys(CRYSTAL.apart, 0.0)), HURLE)
    return p, make_view(config.camera), lambda L: recipe.state_at(float(L), table, p, Episode())


def traced(r_c, h_c, p, view):
    """Width of the bright band below the crystal's edge [pixels], and the step of brightness at the edge [grey]."""
    scene = make_scene(r_c, h_c, p)
    edge = float(project(r_c, 0.0, h_c, view).row)
    below = np.arange(_STEP, 14.0, _STEP)
    grey = np.array([grey_value(edge + row, 80.0, scene, view) for row in below])
    bright = grey > view.gain * (view.melt + 0.5 * view.mirrored * view.wall)
    width = below[np.flatnonzero(bright)[-1]] if bright.any() else 0.0
    return width, grey_value(edge - 0.3, 80.0, scene, view) - grey[: round(0.5 / _STEP)].mean()


@pytest.mark.parametrize("puller", PULLERS)
def test_flags_agree_with_traced_rays_along_crown_body_and_tail(puller):
    """Where the flag says ring, rays show a bright band of that width; where not, the crystal's brighter edge."""
    p, view, at = on_recipe(puller)
    end, shown = float(recipe.end(p)), []
    for L in np.r_[np.linspace(0.0, p.crown_length, 21), np.linspace(0.2, 1.0, 9) * end]:
        x = at(L)
        width, step = traced(float(x.r_c), float(x.h_c), p, view)
        pixels = float(sight.ring_pixels(x.r_c, x.h_c, p))
        assert pixels == pytest.approx(width, abs=0.15)
        if abs(pixels - sight.LEAST_PIXELS) > 0.15:
            shown.append(bool(sight.shows_ring(x.r_c, x.h_c, p)))
            assert shown[-1] == (width >= sight.LEAST_PIXELS)
        if pixels == 0.0:
            assert step > 15.0
    assert 0.2 < np.mean(shown) < 0.8, "both happen"
    assert shown[-9:] == [True] * 9, "body and tail show a ring"


@pytest.mark.parametrize(("puller", "share"), [("default", 0.69), ("silicon-300mm", 0.74), ("germanium", 0.61)])
def test_the_share_of_the_crown_without_a_ring(puller, share):
    p, _, at = on_recipe(puller)
    states = [at(L) for L in np.linspace(0.0, p.crown_length, 400)]
    none = [not sight.shows_ring(x.r_c, x.h_c, p) for x in states]
    assert np.mean(none) == pytest.approx(share, abs=0.01)


def test_a_steep_camera_before_a_high_wall_shows_the_crown_s_ring():
    """10 degrees off the vertical and 0.23 m of bare wall: on the whole crown but for a sliver."""
    p, _, at = on_recipe("default")
    steep = make_config(
        process=CRYSTAL, observation="camera", camera=Camera(tilt=np.radians(10.0), wall_height=0.23)
    ).parameters
    p = p._replace(lens_x=steep.lens_x, lens_z=steep.lens_z, wall_height=steep.wall_height)
    states = [at(L) for L in np.linspace(0.0, p.crown_length, 60)]
    slopes = np.degrees([sight.slope_of(x.r_c, x.h_c, p) - sight.steepness(x.r_c, x.h_c, p) for x in states])
    assert slopes.min() > -6.0


@pytest.mark.parametrize("puller", PULLERS)
def test_images_and_flags_of_an_episode_agree(puller):
    """An image has a band as bright as the mirrored wall down its middle where the ring is flagged valid, else none."""
    config = make_config(process=CRYSTAL, puller=puller)
    crown, view = config.parameters.crown_length, make_view(config.camera)
    wall = view.gain * (view.melt + view.mirrored * view.wall)
    flags = []
    for L in (0.02 * crown, 0.5 * crown, 0.7 * crown, 1.5 * crown, 5.0 * crown):
        env = CzCrystalEnv(scenario="nominal", puller=puller, stage=float(L), observation="camera")
        image, _ = env.reset(seed=0)
        flags.append(env._slots["valid"][0])
        assert env._slots["edge_valid"][0] == 1.0 - flags[-1]
        assert (image[:, 80, 0].max() > 0.8 * wall) == (flags[-1] == 1.0)
        edge = float(project(env._slots["x"]["r_c"][0], 0.0, env._slots["x"]["h_c"][0], view).row)
        row = edge - float(first_row(config.parameters.r_0 - env._slots["x"]["r_c"][0], view))
        assert 50.0 < row < 62.0, "the image follows the crystal"
        middle = image[:, 80, 0].astype(float)
        assert middle[int(row) - 1] > middle[int(row) + 9] + 12.0, "crystal above, melt below"
    assert flags == [1.0, 0.0, 0.0, 1.0, 1.0]


def test_noise_and_bias_of_the_edge():
    """White noise of twice the ring's, and an error that each crystal keeps, of five times it; nothing where calm."""
    env = CzCrystalVectorEnv(400, scenario="randomized", stage=0.045, **PLAIN)
    env.reset(seed=1)
    slots, errors = env._batch.memory.slots, []
    for _ in range(30):
        *_, info = env.step(np.zeros((400, 2), np.float32))
        assert (slots["edge_valid"] == 1.0).all()
        errors.append(info["edge_measured"] - info["r_c"] - (info["r_br_measured"] - info["r_br"]))
    sd = slots["episode"]["camera_sd"]
    kept, white = np.mean(errors, axis=0), np.std(errors, axis=0, ddof=1)
    assert np.sqrt(np.mean((white / sd) ** 2)) == pytest.approx(sight.EDGE_NOISE, rel=0.1)
    assert np.std(kept / sd) == pytest.approx(sight.EDGE_BIAS, rel=0.12)


def test_flags_exclude_each_other_and_errors_are_held():
    """A frozen or dropped frame has neither flag; an invalid error is the last valid one."""
    env = CzCrystalVectorEnv(40, scenario="sensor-fault", stage=0.01, **PLAIN)
    observation, _ = env.reset(seed=2)
    process, ranges = env.config.process, env.config.ranges
    before, neither, both_happened = decode(observation, *ranges, process), 0, np.zeros(2, bool)
    for _ in range(150):
        observation, *_ = env.step(np.zeros((40, 2), np.float32))
        seen = decode(observation, *ranges, process)
        flags = np.stack([seen.valid, seen.edge_valid])
        assert (flags.sum(axis=0) <= 1.0).all()
        neither += int((flags.sum(axis=0) == 0.0).sum())
        both_happened |= flags.any(axis=1)
        for now, was, flag in ((seen.ring_error, before.ring_error, 0), (seen.edge_error, before.edge_error, 1)):
            held = (flags[flag] == 0.0) & (np.stack([before.valid, before.edge_valid])[flag] == 0.0)
            np.testing.assert_array_equal(now[held], was[held])
        before = seen
    assert neither > 0
    assert both_happened.all()


def test_the_linearisation_has_edge_and_geometry():
    at = linear_recipe(make_config(process=CRYSTAL).parameters, HURLE)
    np.testing.assert_array_equal(at.C[:, 2], np.eye(6)[[0]].repeat(len(at.L), axis=0))
    assert not at.shows_ring[np.argmin(np.abs(at.L - 0.05))]
    assert at.shows_ring[at.L > 90 * MM].all()
