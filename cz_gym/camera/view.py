"""The camera's parameters, and the view that follows from them.

x points from the crystal's axis towards the camera, y to its right, z up; z = 0 is the melt far from the crystal.
docs/camera.md describes how the image is made.
"""

import math
from typing import Annotated, Any, NamedTuple

from cz_gym.errors import CzError
from cz_gym.physics.parameters import Parameters, Q, check_numbers
from cz_gym.support.units import MM

ROWS, COLUMNS = 120, 160
IMAGE = (ROWS, COLUMNS, 1)
"""Shape of ``observation="camera"``, uint8."""
SECOND_RADIATION = 1.438776877e-2
"""Second radiation constant h c / k_B [m K] (CODATA)."""
_E = "estimate"
_SILICON = Parameters()
_EMISSIVITIES = "order and range: Watanabe et al., High Temp. High Press. 31, 587 (1999)"


class Camera(NamedTuple):
    """Parameters of the camera, of the hot zone and of the surfaces in its image; SI units, kelvin, radians.

    For another view give other values: ``Camera(tilt=0.4)``. The temperatures do not follow the plant's state, because
    an industrial camera adjusts its exposure. :func:`camera_for` aims the camera at another puller's crystal.
    """

    tilt: Annotated[float, Q("rad", "angle of the optical axis from the vertical", _E, 0.0)] = math.radians(20)
    distance: Annotated[float, Q("m", "from the lens to the melt, along the optical axis", _E)] = 1.0
    aim: Annotated[float, Q("m", "radius at which the optical axis meets the melt", f"{_E}: r_0")] = _SILICON.r_0
    focal_length: Annotated[float, Q("m", "focal length", f"{_E}: a common lens")] = 50.0 * MM
    pixel_pitch: Annotated[float, Q("m", "side of a pixel", f"{_E}: 3.75 um of a 1280 x 960 sensor, binned 8 x 8")] = (
        30e-6
    )
    wavelength: Annotated[float, Q("m", "effective wavelength", f"{_E}: CCD behind an infrared filter")] = 0.9e-6
    crucible_radius: Annotated[float, Q("m", "inner radius of the crucible's wall", "Parameters.R_cr")] = _SILICON.R_cr
    wall_height: Annotated[float, Q("m", "wall bare above the melt, up to the heat shield's underside", _E)] = 0.12
    wall_temperature: Annotated[float, Q("K", "wall of the crucible", "the plant's T_2 at its nominal")] = 1763.0
    wall_emissivity: Annotated[float, Q("1", "quartz with hot graphite behind", _E)] = 0.9
    shield_radius: Annotated[float, Q("m", "radius of the heat shield's opening", _E)] = 0.18
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


def camera_for(parameters: Parameters) -> Camera:
    """The default camera for a puller: aimed at its crystal, with the heat shield's opening in proportion."""
    default = Camera()
    opening = (default.shield_radius - _SILICON.r_0) / (_SILICON.R_cr - _SILICON.r_0)
    return default._replace(
        aim=parameters.r_0,
        crucible_radius=parameters.R_cr,
        shield_radius=parameters.r_0 + opening * (parameters.R_cr - parameters.r_0),
        melt_temperature=parameters.T_m + parameters.dT_0,
        crystal_temperature=parameters.T_m,
    )


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


def project(x: Any, y: Any, z: Any, view: View) -> Point:
    """Pixel coordinates of a point [m]: row and column, 0 at the image's upper left corner; arrays broadcast."""
    from_x, from_z = x - view.x, z - view.z
    depth = -view.sin_tilt * from_x - view.cos_tilt * from_z
    down = view.cos_tilt * from_x - view.sin_tilt * from_z
    scale = 1.0 / (view.pixel * depth)
    return Point(0.5 * ROWS + down * scale, 0.5 * COLUMNS + y * scale)
