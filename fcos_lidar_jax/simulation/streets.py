"""What the streets and the sensor above them are like: every randomisation is a field."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Streets:
    """How varied simulated streets are; with the default values a randomisation is off.

    A value says everything that decides the frames beside their seed, size and traffic, so it enters caches and
    the records of data sets as it is.

    >>> level = dataclasses.replace(CITY, slopes=False)
    >>> level.clutter, PLAIN.clutter
    (0.12, 0.0)
    """

    name: str = "plain"
    # The sensor.
    pitch_rad: float = 0.0  # mean angle by which it looks down ahead
    mount_m: float = 0.0  # deviation of its height
    range_noise_m: float = 0.012
    speckle: float = 0.3  # deviation of the logarithm of single intensities
    ring_gain: float = 0.0  # the same of whole rings
    ring_range_m: float = 0.0  # deviation of rings' range offsets
    ring_elevation_rad: float = 0.0  # deviation of rings' elevation offsets
    shading: float = 0.0  # deviation of the logarithm of albedo within a surface, smooth over metres
    faint: float = 0.07  # strength at which 63 % of the rays return
    weather: float = 0.0  # deviation of the logarithm of that strength from world to world
    rolling_shutter: bool = False  # frames take the time of a turn
    ego_outline: bool = False  # the ego vehicle hides what nuScenes' vehicles hide
    ego_edges: bool = False  # where its outline does, the edges of bonnet and roof return rays
    # The ground.
    slopes: bool = False  # frames have sloping planes, as drives always do
    relief_m: float = 0.0  # median deviation of undulations
    roughness_m: float = 0.0  # of single points
    crown_m: float = 0.0  # greatest fall from the middle of a street to its kerb
    # What stands about.
    clutter: float = 0.0  # things that are no objects, a metre of street side
    facades: bool = False  # buildings with entrances, columns, bays and balconies
    setting: bool = False  # built-up, green, empty and crowded places
    # The objects.
    city_classes: float = 0.0  # 1 as often as in cities, 0 all classes equally often
    class_mix: float = 0.0  # deviation of the logarithm of how often from frame to frame
    spread: float = 1.0  # power of an even number that says how far off they are; 0.5 even over an area
    round_cars: bool = False  # most cars have rounded ends
    groups: float = 0.0  # share of the pedestrians that are near another
    shape: float = 0.0  # deviation of the sizes of their parts
    sizes: float = 1.0  # factor of the deviations of their boxes


PLAIN = Streets()
"""Level frames of ten equally frequent classes, few other things: those of the quickstart."""

CITY = Streets(
    "city",
    pitch_rad=0.033,
    mount_m=0.04,
    range_noise_m=0.003,
    speckle=0.08,
    ring_gain=0.3,
    ring_range_m=0.004,
    ring_elevation_rad=0.001,
    shading=0.3,
    faint=0.04,
    weather=0.6,
    rolling_shutter=True,
    ego_outline=True,
    ego_edges=True,
    slopes=True,
    relief_m=0.04,
    roughness_m=0.0015,
    crown_m=0.15,
    clutter=0.12,
    facades=True,
    setting=True,
    city_classes=0.75,
    class_mix=0.7,
    spread=0.65,
    round_cars=True,
    groups=0.4,
    shape=0.06,
    sizes=1.4,
)
"""Varied streets for detectors of real sensors; the sensor's mount, noise and view are those of nuScenes."""

STREETS = {streets.name: streets for streets in (PLAIN, CITY)}
"""Name -> streets."""
