"""``python -m fcos_lidar_jax``."""

import sys

from fcos_lidar_jax.cli import main

sys.exit(main())
