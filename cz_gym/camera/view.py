"""The camera's parameters, and the view that follows from them.

x points from the crystal's axis towards the camera, y to its right, z up; z = 0 is the melt far from the crystal.
docs/camera.md describes how the image is made.
"""

import math
from typing import Annotated, Any, NamedTuple

import numpy as np

from cz_gym.jit import jittable, labelled
from cz_gym.physics.meniscus import hurle_slope, profile_scale
from cz_gym.physics.parameters import (
    CameraPose,
    Parameters,
    Q,
    Sight,
    check_numbers,
    pose_for,
    sight_of,
)
from cz_gym.physics.plant import make_puller
from cz_gym.support.errors import CzError
from cz_gym.support.units import MM

ROWS, COLUMNS = 120, 160
IMAGE = (ROWS, COLUMNS, 1)
"""Shape of ``observation="camera"``, uint8."""
SECOND_RADIATION = 1.438776877e-2
"""Second radiation constant h c / k_B [m K] (CODATA)."""
_E = "estimate"
_SILICON, _POSE = Parameters(), CameraPose()
_EMISSIVITIES = "order and range: Watanabe et al., High Temp. High Press. 31, 587 (1999)"


class Camera(NamedTuple):
    """Parameters of the camera, of the hot zone and of the surfaces in its image; SI units, kelvin, radians.

    For another view give other values: ``Camera(tilt=0.4)``. The temperatures do not follow the plant's state, because
    an industrial camera adjusts its exposure. :func:`camera_for` aims the camera at another puller's crystal.
    """

    tilt: Annotated[float, Q("rad", "angle of the optical axis from the vertical", _E, 0.0)] = _POSE.tilt
    distance: Annotated[float, Q("m", "from the lens to the melt, along the optical axis", _E)] = _POSE.distance
    aim: Annotated[float, Q("m", "radius at which the optical axis meets the melt", f"{_E}: r_0")] = _SILICON.r_0
    focal_length: Annotated[float, Q("m", "focal length", f"{_E}: a common lens")] = 50.0 * MM
    pixel_pitch: Annotated[float, Q("m", "side of a pixel", f"{_E}: 3.75 um of a 1280 x 960 sensor, binned 8 x 8")] = (
        30e-6
    )
    wavelength: Annotated[float, Q("m", "effective wavelength", f"{_E}: CCD behind an infrared filter")] = 0.9e-6
    crucible_radius: Annotated[float, Q("m", "inner radius of the crucible's wall", "Parameters.R_cr")] = _SILICON.R_cr
    wall_height: Annotated[float, Q("m", "wall bare above the melt, up to the heat shield's underside", _E)] = (
        _POSE.wall_height
    )
    wall_temperature: Annotated[float, Q("K", "wall of the crucible", "the plant's T_2 at its nominal")] = 1763.0
    wall_emissivity: Annotated[float, Q("1", "quartz with hot graphite behind", _E)] = 0.9
    shield_radius: Annotated[float, Q("m", "radius of the heat shield's opening", _E)] = _POSE.shield_radius
    shield_temperature: Annotated[float, Q("K", "heat shield", "Parameters.T_e")] = _SILICON.T_e
    shield_emissivity: Annotated[float, Q("1", "graphite", _E)] = 0.8
    opening_temperature: Annotated[float, Q("K", "what is seen through the shield's opening", _E)] = 600.0
    melt_temperature: Annotated[float, Q("K", "melt's surface", "Parameters.T_m + dT_0")] = _SILICON.T_m + _SILICON.dT_0
    melt_emissivity: Annotated[float, Q("1", "liquid silicon", f"Parameters.eps; {_EMISSIVITIES}")] = _SILICON.eps
    crystal_temperature: Annotated[float, Q("K", "crystal at the triple point", "Parameters.T_m")] = _SILICON.T_m
    crystal_far_temperature: Annotated[float, Q("K", "crystal far above the melt", _E)] = 800.0
    crystal_cooling: Annotated[
        float, Q("m", "height over which the crystal cools by 1/e", f"{_E}: 5.9 K/mm, the plant's Phi_s")
    ] = 0.15
    crystal_emissivity: Annotated[float, Q("1", "solid silicon, hot", f"{_E}; {_EMISSIVITIES}")] = 0.46
    white: Annotated[float, Q("1", "grey value 255, in black bodies as hot as the wall", _E)] = 1.0
    full_well: Annotated[float, Q("1", "electrons of a binned pixel at grey value 255", _E)] = 1e4


def camera_for(parameters: Parameters, pose: CameraPose | None = None) -> Camera:
    """The default camera for a puller, in a pose (None: the usual one): aimed at its crystal, in its hot zone."""
    default, q = Camera(), labelled(Parameters, parameters)
    warmer = make_puller(q).T_2_0 - make_puller(_SILICON).T_2_0
    return default._replace(
        **(pose or pose_for(q))._asdict(),
        aim=q.r_0,
        crucible_radius=q.R_cr,
        wall_temperature=default.wall_temperature + warmer,
        shield_temperature=max(q.T_e, 1.0),
        melt_temperature=q.T_m + q.dT_0,
        melt_emissivity=q.eps,
        crystal_temperature=q.T_m,
    )


def camera_sight(camera: Camera) -> Sight:
    """Lens, bare wall and pixel of a camera, which decide where it sees a bright ring."""
    pose = CameraPose(camera.tilt, camera.distance, camera.wall_height, camera.shield_radius)
    return sight_of(pose, camera.aim, camera.pixel_pitch / camera.focal_length)


def check_camera(camera: Camera, parameters: Parameters) -> Camera:
    """Return the camera, or raise CzError naming the parameter that is impossible at this puller."""
    if not isinstance(camera, Camera):
        raise CzError(f"camera must be a cz_gym.camera.Camera, not {camera!r}")
    check_numbers("camera parameter", camera)
    for name, value in camera._asdict().items():
        if name.endswith("_emissivity") and value > 1:
            raise CzError(f"camera parameter {name} = {value!r} must not exceed 1")
    if camera.tilt >= 0.5 * math.pi:
        raise CzError(f"camera parameter tilt = {camera.tilt!r} must be below pi / 2 [rad]: is it in degrees?")
    if not parameters.r_0 < camera.shield_radius < camera.crucible_radius:
        raise CzError(
            f"the heat shield's opening (shield_radius = {camera.shield_radius} m) must be wider than the crystal "
            f"(r_0 = {parameters.r_0} m) and narrower than the crucible ({camera.crucible_radius} m)"
        )
    height = camera.distance * math.cos(camera.tilt)
    if height <= camera.wall_height:
        raise CzError(
            f"the lens, {height:.3g} m above the melt, must be above the heat shield "
            f"(wall_height = {camera.wall_height} m)"
        )
    return Camera(*map(float, camera))


class View(NamedTuple):
    """A camera with the numbers derived from it: position, orientation, pixels, and the radiance of each surface.

    A ray through pixel coordinates (row, column) has direction ``forward + right u + down v``, with u and v the
    distances from the image's centre in focal lengths. The unit of radiance is a black body as hot as the wall.
    """

    camera: Camera
    x: float
    """Distance of the lens from the axis [m]; it is at y = 0."""
    z: float
    """Height of the lens above the melt [m]."""
    sin_tilt: float
    cos_tilt: float
    pixel: float
    """Side of a pixel in focal lengths [-]."""
    wall: float
    """Radiance of the wall [-]."""
    shield: float
    """Radiance of the heat shield [-]."""
    opening: float
    """Radiance seen through the shield's opening [-]."""
    melt: float
    """Radiance that the melt emits itself [-]."""
    mirrored: float
    """Reflectivity of the melt [-]."""
    wien: float
    """Second radiation constant divided by the wavelength [K]."""
    gain: float
    """Grey values of a unit of radiance."""
    electrons: float
    """Electrons of a grey value [-]."""


def make_view(camera: Camera) -> View:
    """The view of a camera that :func:`check_camera` has accepted."""
    c, wien = camera, SECOND_RADIATION / camera.wavelength
    sin_tilt, cos_tilt = math.sin(c.tilt), math.cos(c.tilt)

    def radiance(temperature: float, emissivity: float) -> float:
        return emissivity * math.exp(wien * (1.0 / c.wall_temperature - 1.0 / temperature))

    return View(
        camera=c,
        x=c.aim + c.distance * sin_tilt,
        z=c.distance * cos_tilt,
        sin_tilt=sin_tilt,
        cos_tilt=cos_tilt,
        pixel=c.pixel_pitch / c.focal_length,
        wall=radiance(c.wall_temperature, c.wall_emissivity),
        shield=radiance(c.shield_temperature, c.shield_emissivity),
        opening=radiance(c.opening_temperature, 1.0),
        melt=radiance(c.melt_temperature, c.melt_emissivity),
        mirrored=1.0 - c.melt_emissivity,
        wien=wien,
        gain=255.0 / c.white,
        electrons=c.full_well / 255.0,
    )


class Point(NamedTuple):
    """Pixel coordinates of :func:`project`, numbers or arrays of one shape."""

    row: Any
    column: Any


@jittable
def project(x: Any, y: Any, z: Any, view: View) -> Point:
    """Pixel coordinates of a point [m]: row and column, 0 at the image's upper left corner; arrays broadcast."""
    from_x, from_z = x - view.x, z - view.z
    depth = -view.sin_tilt * from_x - view.cos_tilt * from_z
    down = view.cos_tilt * from_x - view.sin_tilt * from_z
    scale = 1.0 / (view.pixel * depth)
    return Point(0.5 * ROWS + down * scale, 0.5 * COLUMNS + y * scale)


# Geometry of rays: the surface that each meets first, and how the melt mirrors it.
#
# The meniscus is Hurle's profile, turned about the crystal's axis: z / M = sqrt(2) sech(q) and X / M = q / sqrt(2) -
# sqrt(2) tanh(q), with q increasing outwards from the triple point. It is the curve of
# :func:`cz_gym.physics.meniscus.profile`, where q is arccosh(sqrt(2) M / z). Its slope phi against the horizontal has
# sin(phi / 2) = sech(q). Where a sinking ray has the height of the profile at q, its distance from the axis minus the
# profile's radius is a function of q with a single zero below the triple point; Newton's method finds it. Directions
# need not have unit length. Coordinates are those of :mod:`cz_gym.camera.view`, in [m].

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
