"""Pictures, reports, and pages for a browser. Matplotlib is imported on first use."""

from fcos_lidar_jax.visualization.bev import draw_bev
from fcos_lidar_jax.visualization.camera import draw_camera
from fcos_lidar_jax.visualization.figure import draw_curves
from fcos_lidar_jax.visualization.page import PageFrame, page_frame, write_page
from fcos_lidar_jax.visualization.range_image import draw_range_image
from fcos_lidar_jax.visualization.report import write_report

__all__ = [
    "PageFrame",
    "draw_bev",
    "draw_camera",
    "draw_curves",
    "draw_range_image",
    "page_frame",
    "write_page",
    "write_report",
]
