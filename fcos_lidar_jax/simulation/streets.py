"""Variety of the simulated streets, objects and sensor, with one field per randomisation."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Streets:
    """Parameters of simulated streets. By default, every randomisation is off.

    Together with seed, size and traffic these parameters determine all frames. Caches and data set records
    therefore contain them unchanged.
    """

    name: str = "plain"
    # The sensor.
    pitch_rad: float = 0.0  # mean downward pitch
    mount_m: float = 0.0  # deviation of the mounting height
    range_noise_m: float = 0.012
    speckle: float = 0.3  # deviation of the log intensity per point
    ring_gain: float = 0.0  # deviation of the log intensity per ring
    ring_range_m: float = 0.0  # deviation of the range offset per ring
    ring_elevation_rad: float = 0.0  # deviation of the elevation offset per ring
    shading: float = 0.0  # deviation of the log albedo within a surface, smooth over metres
    faint: float = 0.07  # strength at which 63 % of the rays return
    weather: float = 0.0  # deviation of log ``faint`` per world
    rolling_shutter: bool = False  # a frame takes the time of a turn
    ego_outline: bool = False  # the ego vehicle blocks the same rays as in nuScenes
    ego_edges: bool = False  # with ``ego_outline``, the edges of bonnet and roof return rays
    # The ground.
    slopes: bool = False  # frames have sloping ground; drives always have
    relief_m: float = 0.0  # median deviation of undulations
    roughness_m: float = 0.0  # deviation of the height per point
    crown_m: float = 0.0  # maximum fall from the middle of a street to its kerb
    # The scenery.
    clutter: float = 0.0  # unannotated things per metre of street side
    facades: bool = False  # buildings with entrances, columns, bays and balconies
    setting: bool = False  # built-up, green, empty and crowded surroundings
    walls: float = 0.0  # share of street sides with long walls or fences, and independently with long buildings
    # The objects.
    city_classes: float = 0.0  # class frequencies: 1 as in cities, 0 all equal
    class_mix: float = 0.0  # deviation of the log class frequencies per frame
    spread: float = 1.0  # distances are uniform numbers to this power; 0.5 is uniform over an area
    round_cars: bool = False  # most cars have rounded ends
    groups: float = 0.0  # share of pedestrians next to another pedestrian
    bends: float = 0.0  # deviation of the curvature of rows of cones and barriers, 1/m
    depots: float = 0.0  # share of the rows of trailers that are long and close, with trailers of one model
    shape: float = 0.0  # deviation of the sizes of object parts
    sizes: float = 1.0  # factor of the deviations of box sizes
    gloss: float = 0.0  # maximum share of grazing rays that the paint of vehicles reflects away, uniform per world
    patchwork: float = 0.0  # deviation of the log albedo per part of an object


PLAIN = Streets()
"""Level ground, ten equally frequent classes and little clutter, as in the quickstart."""

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
"""Varied streets for detectors of real sensors, with the mount, noise and view of the nuScenes sensor."""

STREETS = {streets.name: streets for streets in (PLAIN, CITY)}
"""Streets by name."""
