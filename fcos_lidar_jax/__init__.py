"""FCOS-LiDAR in JAX: 3D object detection on LiDAR range images, from pure functions."""

__version__ = "0.1.0"
