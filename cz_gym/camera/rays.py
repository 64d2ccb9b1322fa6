"""Geometry of rays: the surface that each meets first, and how the melt mirrors it.

The meniscus is Hurle's profile, turned about the crystal's axis: z / M = sqrt(2) sech(q) and
X / M = q / sqrt(2) - sqrt(2) tanh(q), with q increasing outwards from the triple point. It is the curve of
:func:`cz_gym.physics.meniscus.profile`, where q is arccosh(sqrt(2) M / z). Its slope phi against the horizontal has
sin(phi / 2) = sech(q). Where a sinking ray has the height of the profile at q, its distance from the axis minus the
profile's radius is a function of q with a single zero below the triple point; Newton's method finds it.
Directions need not have unit length. Coordinates are those of :mod:`cz_gym.camera.view`, in [m].
"""

import math
from typing import Any, NamedTuple

import numpy as np

from cz_gym.jit.compile import jittable
from cz_gym.physics.meniscus import hurle_slope, profile_scale

SQRT_2 = math.sqrt(2.0)
FLAT = 9.5
"""q beyond which the melt counts as flat [-]: its slope is below 0.02 degrees, its height a micrometre."""
CRYSTAL, MELT, WALL, SHIELD, OPENING = range(5)
"""Surfaces that a ray can hit."""
_MOST_STEPS = 60
"""Largest number of Newton steps; three or four are usual."""
_CLOSE = 1e-7
"""Newton step below which the next one, about its square, is rounding error [-]."""


class Scene(NamedTuple):
    """Crystal and meniscus in one image."""

    r_c: Any
    """Radius of the crystal [m]."""
    h_c: Any
    """Height of the triple point [m]."""
    M: Any
    """Scale of the profile [m]."""
    q_c: Any
    """q at the triple point [-]."""
    X_c: Any
    """X / M at the triple point [-]."""
    r_flat: Any
    """Radius at which the melt is flat [m]."""


class Ray(NamedTuple):
    """A ray: origin [m] and direction."""

    x: Any
    y: Any
    z: Any
    dx: Any
    dy: Any
    dz: Any


class Hit(NamedTuple):
    """The surface that a ray meets first, the point [m], and q there; q = -1 off the meniscus."""

    what: Any
    x: Any
    y: Any
    z: Any
    q: Any


@jittable
def make_scene(r_c: Any, h_c: Any, p: Any) -> Any:
    """The scene of a crystal of radius r_c on Hurle's meniscus of height h_c [m]; ``p`` is the puller."""
    _, cos_theta = hurle_slope(r_c, h_c, p)
    M = profile_scale(r_c, h_c, cos_theta, p.a)
    q_c = np.arccosh(max(SQRT_2 * M / h_c, 1.0))
    X_c = q_c / SQRT_2 - SQRT_2 * np.tanh(q_c)
    return Scene(r_c, h_c, M, q_c, X_c, r_c + M * (FLAT / SQRT_2 - SQRT_2 - X_c))


@jittable
def _sech_tanh(q: Any) -> Any:
    e = np.exp(-q)
    per = 1.0 / (1.0 + e * e)
    return 2.0 * e * per, (1.0 - e * e) * per


@jittable
def profile_at(q: Any, scene: Any) -> Any:
    """Radius and height [m] of the meniscus at q, and their derivatives with respect to q."""
    sech, tanh = _sech_tanh(q)
    M = scene.M
    r = scene.r_c + M * (q / SQRT_2 - SQRT_2 * tanh - scene.X_c)
    return r, M * SQRT_2 * sech, M * (1.0 / SQRT_2 - SQRT_2 * sech * sech), -M * SQRT_2 * sech * tanh


@jittable
def slope_at(q: Any) -> Any:
    """Sine and cosine of the meniscus' slope against the horizontal."""
    sech, tanh = _sech_tanh(q)
    return 2.0 * sech * tanh, 1.0 - 2.0 * sech * sech


@jittable
def _gap(q: Any, ray: Any, scene: Any) -> Any:
    """Distance of the ray from the axis minus the profile's radius, at the profile's height, and its derivative."""
    r, z, dr, dz = profile_at(q, scene)
    t = (z - ray.z) / ray.dz
    x, y = ray.x + t * ray.dx, ray.y + t * ray.dy
    distance = np.sqrt(x * x + y * y)
    outward = (x * ray.dx + y * ray.dy) / (distance * ray.dz)
    return distance - r, outward * dz - dr


@jittable
def _zero_of_gap(ray: Any, scene: Any, outside: Any, inside: Any, q: Any) -> Any:
    """q where the ray meets the profile, by Newton's method between a q outside the melt and one inside it."""
    for _ in range(_MOST_STEPS):
        gap, rate = _gap(q, ray, scene)
        step = gap / rate
        if abs(step) < _CLOSE:
            return q - step
        if gap > 0.0:
            outside = q
        else:
            inside = q
        q = q - step
        if not min(outside, inside) < q < max(outside, inside):
            q = 0.5 * (outside + inside)
    return q


@jittable
def _meet_below(ray: Any, scene: Any, q: Any) -> Any:
    """q where a sinking ray, outside the profile at ``q``, meets it; -1 where the melt is flat."""
    t = -ray.z / ray.dz
    x, y = ray.x + t * ray.dx, ray.y + t * ray.dy
    beyond = np.sqrt(x * x + y * y) - scene.r_flat
    if not beyond < 0.0:
        return -1.0
    guess = FLAT + SQRT_2 * beyond / scene.M
    guess = guess - 4.0 / (1.0 + np.exp(2.0 * max(guess, q)))
    return _zero_of_gap(ray, scene, q, FLAT, max(guess, q))


@jittable
def _meet_above(ray: Any, scene: Any, q: Any) -> Any:
    """q where a rising ray, outside the profile at ``q``, meets it; -1 if it passes outside the triple point."""
    if ray.x * ray.dx + ray.y * ray.dy >= 0.0:
        return -1.0
    gap, _ = _gap(scene.q_c, ray, scene)
    return _zero_of_gap(ray, scene, q, scene.q_c, 0.5 * (q + scene.q_c)) if gap < 0.0 else -1.0


@jittable
def _meet_cylinder(ray: Any, radius: Any, outwards: Any) -> Any:
    """Time at which the ray enters a cylinder about the axis, or (``outwards``) leaves it; -1 if never."""
    a = ray.dx * ray.dx + ray.dy * ray.dy
    b = ray.x * ray.dx + ray.y * ray.dy
    c = ray.x * ray.x + ray.y * ray.y - radius * radius
    square = b * b - a * c
    if a == 0.0 or square < 0.0:
        return -1.0
    root = np.sqrt(square)
    return (root - b) / a if outwards else (-root - b) / a


@jittable
def _meet_crystal(ray: Any, scene: Any) -> Any:
    """Time at which the ray meets the crystal, through its wall or its underside; -1 if never."""
    inside = ray.x * ray.x + ray.y * ray.y < scene.r_c * scene.r_c
    t = _meet_cylinder(ray, scene.r_c, inside)
    return t if t > 0.0 and ray.z + t * ray.dz > scene.h_c else -1.0


@jittable
def _at(what: Any, ray: Any, t: Any) -> Any:
    return Hit(what, ray.x + t * ray.dx, ray.y + t * ray.dy, ray.z + t * ray.dz, -1.0)


@jittable
def _beyond(hit: Any, radius: Any) -> Any:
    """Whether a point lies outside a cylinder about the axis."""
    return hit.x * hit.x + hit.y * hit.y > radius * radius


@jittable
def _at_profile(ray: Any, q: Any, scene: Any) -> Any:
    _, z, _, _ = profile_at(q, scene)
    t = (z - ray.z) / ray.dz
    return Hit(MELT, ray.x + t * ray.dx, ray.y + t * ray.dy, z, q)


@jittable
def _rising(ray: Any, q: Any, scene: Any, view: Any) -> Any:
    """The first hit of a ray that does not sink."""
    camera = view.camera
    t = _meet_crystal(ray, scene)
    shield = _at(SHIELD, ray, (camera.wall_height - ray.z) / ray.dz)
    if t > 0.0 and (ray.z + t * ray.dz < camera.wall_height or not _beyond(shield, camera.shield_radius)):
        return _at(CRYSTAL, ray, t)
    t_meniscus = _meet_above(ray, scene, q)
    if t_meniscus >= 0.0:
        return _at_profile(ray, t_meniscus, scene)
    if _beyond(shield, camera.crucible_radius):
        return _at(WALL, ray, _meet_cylinder(ray, camera.crucible_radius, True))
    return shield if _beyond(shield, camera.shield_radius) else _at(OPENING, ray, 1.0)


@jittable
def _sinking(ray: Any, q: Any, scene: Any, view: Any) -> Any:
    """The first hit of a sinking ray."""
    camera = view.camera
    t = _meet_crystal(ray, scene)
    if ray.z > camera.wall_height:
        shield = _at(SHIELD, ray, (camera.wall_height - ray.z) / ray.dz)
        if _beyond(shield, camera.shield_radius) and not (t > 0.0 and ray.z + t * ray.dz > camera.wall_height):
            return shield
    if t > 0.0:
        return _at(CRYSTAL, ray, t)
    t_meniscus = _meet_below(ray, scene, q)
    if t_meniscus >= 0.0:
        return _at_profile(ray, t_meniscus, scene)
    melt = _at(MELT, ray, -ray.z / ray.dz)
    if _beyond(melt, camera.crucible_radius):
        return _at(WALL, ray, _meet_cylinder(ray, camera.crucible_radius, True))
    return melt


@jittable
def first_hit(ray: Any, q: Any, scene: Any, view: Any) -> Any:
    """The first hit of a ray that is outside the melt at ``q``: the triple point's q, or the one where it starts."""
    return _sinking(ray, q, scene, view) if ray.dz < 0.0 else _rising(ray, q, scene, view)


@jittable
def mirror(ray: Any, hit: Any) -> Any:
    """The reflected ray of one that met the melt: the angle of reflection is the angle of incidence."""
    sine, cosine = 0.0, 1.0
    if hit.q >= 0.0:
        sine, cosine = slope_at(hit.q)
    r = np.sqrt(hit.x * hit.x + hit.y * hit.y)
    n_x, n_y = sine * hit.x / r, sine * hit.y / r
    twice = 2.0 * (ray.dx * n_x + ray.dy * n_y + ray.dz * cosine)
    return Ray(hit.x, hit.y, hit.z, ray.dx - twice * n_x, ray.dy - twice * n_y, ray.dz - twice * cosine)
