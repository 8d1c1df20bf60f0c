"""Class names of the supported data sets, and defaults per class."""

NUSCENES_CLASSES = (
    *("car", "truck", "bus", "trailer", "construction_vehicle"),
    *("pedestrian", "motorcycle", "bicycle", "traffic_cone", "barrier"),
)
"""The ten classes of the nuScenes detection benchmark, in the order of the paper's tables."""

KITTI_CLASSES = ("Car", "Pedestrian", "Cyclist")  # The three classes of the KITTI benchmark.

ARGOVERSE2_CLASSES = (
    *("REGULAR_VEHICLE", "PEDESTRIAN", "BOLLARD", "CONSTRUCTION_CONE", "CONSTRUCTION_BARREL", "STOP_SIGN"),
    *("BICYCLE", "LARGE_VEHICLE", "WHEELED_DEVICE", "BUS", "BOX_TRUCK", "SIGN", "TRUCK", "MOTORCYCLE"),
    *("BICYCLIST", "VEHICULAR_TRAILER", "TRUCK_CAB", "MOTORCYCLIST", "DOG", "SCHOOL_BUS", "WHEELED_RIDER"),
    *("STROLLER", "ARTICULATED_BUS", "MESSAGE_BOARD_TRAILER", "MOBILE_PEDESTRIAN_CROSSING_SIGN", "WHEELCHAIR"),
)
"""The 26 classes of the Argoverse 2 detection benchmark."""

RANGES_M = {
    **dict.fromkeys(("car", "truck", "bus", "trailer", "construction_vehicle"), 50.0),
    **dict.fromkeys(("pedestrian", "motorcycle", "bicycle"), 40.0),
    **dict.fromkeys(("traffic_cone", "barrier"), 30.0),
    **dict.fromkeys(KITTI_CLASSES, 70.0),
    **dict.fromkeys(ARGOVERSE2_CLASSES, 100.0),
}
"""Class -> evaluation range, metres; nuScenes' ranges are the benchmark's."""
DEFAULT_RANGE_M = 50.0  # Evaluation range of other classes.

PASTE_TARGETS = {
    **dict(zip(NUSCENES_CLASSES, (2, 3, 4, 6, 7, 2, 6, 6, 2, 2), strict=True)),
    **dict(zip(KITTI_CLASSES, (15, 10, 10), strict=True)),
}
"""Our choice: class -> number of boxes up to which copy-paste fills a frame."""
DEFAULT_PASTE_TARGET = 2  # Paste target of other classes.
