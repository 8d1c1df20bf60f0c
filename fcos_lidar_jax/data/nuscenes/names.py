"""nuScenes' categories and their detection classes."""

from fcos_lidar_jax.classes import NUSCENES_CLASSES

CATEGORY_TO_CLASS = {
    "vehicle.car": "car",
    "vehicle.truck": "truck",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.trailer": "trailer",
    "vehicle.construction": "construction_vehicle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "vehicle.motorcycle": "motorcycle",
    "vehicle.bicycle": "bicycle",
    "movable_object.trafficcone": "traffic_cone",
    "movable_object.barrier": "barrier",
}
"""Category -> class; all other categories are background."""

TO_KITTI = {
    **dict.fromkeys(NUSCENES_CLASSES),
    **{"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian", "bicycle": "Cyclist"},
}
"""Class map from nuScenes' classes to KITTI's types; None drops the object. A bicycle need not have a rider,
which a cyclist has."""

BICYCLE_RACK = "static_object.bicycle_rack"  # the evaluation ignores boxes in a rack


def label_of(category: str) -> int:
    """Index of a category's class, -1 for background."""
    name = CATEGORY_TO_CLASS.get(category)
    return -1 if name is None else NUSCENES_CLASSES.index(name)
