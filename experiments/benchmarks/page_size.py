"""How large is the page of a drive, and how fast? Forty frames of nuScenes' sensor.

    python -m experiments.benchmarks.page_size [--page FILE.html]

Keyframes of the real scene-0523 below the environment's ``FCOS_LIDAR_REAL_DATA``, over and over, with their
annotated boxes as detections and as truth; without these data, simulated frames. Where Chromium or Chrome is
installed the page is opened in it, at 1280 x 800 pixels, without a GPU (software rendering): drawing a frame of
one sweep and of ten. Other programs lengthen it; their load average is recorded.

Cost: a minute. Expected: at most 8 MB.
"""

import dataclasses
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from experiments.browser import find_browser, open_tab, start_browser
from experiments.script import Options, find_real_data, run_measurement
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.input_pipeline.database import cut_reading
from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.visualization.page import page_frame, write_page

_DRAW = """(async () => {
  const times = [], pixel = new Uint8Array(4);
  $("color").value = MODE;
  for (let i = 9; i < 20; i++) {
    await show(i);
    draw();  // uploads
    const began = performance.now();
    draw();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);  // waits until it is drawn
    times.push(performance.now() - began);
  }
  return times;
})()"""


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """What to write."""

    frames: int = 40  # Of the page.
    page: Path | None = None  # Keep the page here.


def measure(args: Args) -> dict[str, Any]:
    """Bytes, seconds to write on the processor, milliseconds to draw."""
    root = find_real_data(None, "nuscenes_scene0523")
    frames: FrameSet = SimulatedFrames(NUSCENES_HDL32E, args.frames)
    if root is not None:
        data = NuScenes(root, "v1.0-scene0523")
        frames = NuScenesFrames(data, tuple(data.sample_tokens), cut_reading(1))
    read = [frames.frame(index % len(frames)) for index in range(args.frames)]
    with tempfile.TemporaryDirectory() as folder:
        path = args.page or Path(folder, "page.html")
        began = time.process_time()
        shown = []
        for index, frame in enumerate(read):
            pose, boxes = np.eye(4), (frame.boxes, frame.labels)
            pose[1, 3] = 5 * index
            look = {
                "pose": pose,
                "time_us": 500_000 * index,
                "name": frames.name(index % len(frames)),
                "truth": boxes,
            }
            shown.append(page_frame(frame.points, (*boxes, np.ones(len(frame.boxes), np.float32)), **look))
        write_page(path, shown, classes=NUSCENES_CLASSES, title="A drive")
        seconds = time.process_time() - began
        figures = {
            "frames": args.frames,
            "of": "simulated frames" if root is None else "keyframes of scene-0523",
            "points_a_frame": round(statistics.mean(len(frame.points) for frame in read)),
            "boxes_a_frame": round(statistics.mean(len(frame.boxes) for frame in read), 1),
            "megabytes": round(path.stat().st_size / 1e6, 2),
            "processor_seconds_to_write": round(seconds, 2),
        }
        return figures | _drawing(path)


def _drawing(path: Path) -> dict[str, Any]:
    browser = find_browser()
    if browser is None:
        return {"draw_ms": None, "browser": "none installed"}
    with start_browser(browser) as started, open_tab(started, path.resolve().as_uri()) as tab:
        one, ten = (tab.run(_DRAW.replace("MODE", mode)) for mode in ("0", "2"))
        product = started.call("Browser.getVersion")["product"]
    times = {
        name: {"fastest": round(min(of), 1), "median": round(statistics.median(of), 1)}
        for name, of in (("draw_ms", one), ("draw_ten_sweeps_ms", ten))
    }
    told = {"browser": f"{product}, 1280 x 800, software rendering", "load_average": round(os.getloadavg()[0], 1)}
    return times | told


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
