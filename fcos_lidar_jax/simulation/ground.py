"""Ground: sloping planes with streets let into it, even or uneven."""

import dataclasses

import numpy as np

from fcos_lidar_jax.simulation.relief import Relief

LANE_M = 3.5
_MARK_HALF_M = 0.08
_DIRECTIONS = 720  # in which profiles of uneven ground are taken
_PROFILE_M = np.geomspace(1.0, 120.0, 144)  # where, from the sensor
_HALVINGS = 5  # of the piece of a profile that holds a hit


@dataclasses.dataclass(frozen=True)
class Ground:
    """A main street along x and one that crosses it, between raised pavements, on sloping planes.

    The frame is the street's: x along the main street, y to the left of it, z up, metres.
    """

    planes: np.ndarray  # f64[p, 3]: z = a x + b y + c; the highest counts, so the ground is convex
    half_width: float  # of the main street's carriageway
    crossing_x: float  # where the other street crosses, along its own y
    crossing_half_width: float  # of its carriageway
    kerb: float  # height of everything beside the carriageways above them
    pavement: float  # width of the pavements
    brightness: tuple[float, float, float]  # albedo of carriageway, pavement and what lies beyond
    crown: float = 0.0  # the carriageways' middles stand this far above their gutters
    relief: Relief | None = None  # undulations, metres
    shading: Relief | None = None  # logarithm of brightness

    def on_road(self, x: np.ndarray, y: np.ndarray, margin: np.ndarray | float = 0.0) -> np.ndarray:
        """Whether places lie on a carriageway, or within ``margin`` of one."""
        main = np.abs(y) < self.half_width + margin
        return main | (np.abs(x - self.crossing_x) < self.crossing_half_width + margin)

    def slope_height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height of the carriageways, and of what lies beside them without its kerb."""
        height = np.max([a * x + b * y + c for a, b, c in self.planes], axis=0)
        if self.crown:
            off = np.minimum(np.abs(y) / self.half_width, np.abs(x - self.crossing_x) / self.crossing_half_width)
            height = height - self.crown * np.minimum(off, 1) ** 2
        return height if self.relief is None else height + self.relief.at(x, y)

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height of the ground, kerbs included."""
        return self.slope_height(x, y) + np.where(self.on_road(x, y), 0.0, self.kerb)

    def first_hits(self, d: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays meet the ground.

        Args:
            d: f32[3, k], unit vectors.
            origin: f64[3], above the ground and its kerbs.

        Returns:
            range f32[k], inf for rays that never do, and the cosine of incidence f32[k].
        """
        if self.crown or self.relief is not None:
            return self._uneven_hits(d, origin)
        low, cosine = self._plane_hits(d, origin, 0.0)
        if self.kerb:
            high, _ = self._plane_hits(d, origin, self.kerb)
            with np.errstate(invalid="ignore"):
                high_on_road = self.on_road(origin[0] + high * d[0], origin[1] + high * d[1])
                low_on_road = self.on_road(origin[0] + low * d[0], origin[1] + low * d[1])
            face = np.flatnonzero(high_on_road & ~low_on_road & np.isfinite(low))
            low = np.where(high_on_road, low, high)
            low[face] = self._kerb_hits(d[:, face], origin, high[face], low[face])
            cosine[face] = np.hypot(d[0, face], d[1, face])
        return low, cosine

    def _uneven_hits(self, d: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As :meth:`first_hits`: the first piece of the profile ahead that rises to a ray, then halved.

        What is nearer than the profiles' beginning or beyond their end is not met.
        """
        flat = np.maximum(np.hypot(d[0], d[1]), np.float32(1e-9))
        towards, rise = d[:2] / flat, d[2] / flat
        sector = ((np.arctan2(d[1], d[0]) / (2 * np.pi) % 1) * _DIRECTIONS).astype(np.int32) % _DIRECTIONS
        used, row = np.unique(sector, return_inverse=True)
        angle = (used[:, None] + 0.5) * (2 * np.pi / _DIRECTIONS)
        x, y = origin[0] + np.cos(angle) * _PROFILE_M, origin[1] + np.sin(angle) * _PROFILE_M
        highest = np.maximum.accumulate((self.height(x, y) - origin[2]) / _PROFILE_M, axis=1)
        # One search for all: rows of slopes, which are small, one above the other.
        spread = 4.0 * np.arange(len(used))
        found = np.searchsorted((np.clip(highest, -2, 2) + spread[:, None]).ravel(), rise + spread[row])
        piece = found - row * len(_PROFILE_M)
        met = np.flatnonzero((piece < len(_PROFILE_M)) & (rise > -2))
        last = _PROFILE_M[np.maximum(piece[met], 1)].astype(np.float32)
        first = _PROFILE_M[np.maximum(piece[met], 1) - 1].astype(np.float32)
        towards, rise = towards[:, met], rise[met]
        eye = origin.astype(np.float32)
        for _ in range(_HALVINGS):
            middle = (first + last) / 2
            x, y = eye[0] + towards[0] * middle, eye[1] + towards[1] * middle
            under = self.height(x, y) > eye[2] + rise * middle
            first, last = np.where(under, first, middle), np.where(under, middle, last)
        way = (first + last) / 2
        x, y = eye[0] + towards[0] * way, eye[1] + towards[1] * way
        here = self.slope_height(x, y)
        a, b = (2 * (self.slope_height(x + u, y + v) - here) for u, v in ((0.5, 0.0), (0.0, 0.5)))
        cosine = (a * d[0, met] + b * d[1, met] - d[2, met]) / np.sqrt(1 + a * a + b * b)
        range_m, cosines = np.full(d.shape[1], np.inf, np.float32), np.zeros(d.shape[1], np.float32)
        range_m[met], cosines[met] = way / flat[met], np.clip(cosine, 0.01, 1)
        return range_m, cosines

    def _plane_hits(self, d: np.ndarray, origin: np.ndarray, lift: float) -> tuple[np.ndarray, np.ndarray]:
        best, cosine = np.full(d.shape[1], np.inf, np.float32), np.zeros(d.shape[1], np.float32)
        for a, b, c in self.planes:
            fall = np.float32(a) * d[0] + np.float32(b) * d[1] - d[2]
            height = np.float32(origin[2] - (a * origin[0] + b * origin[1] + c) - lift)
            reach = np.where(fall > 1e-6, height / np.maximum(fall, np.float32(1e-6)), np.float32(np.inf))
            nearer = reach < best
            best[nearer] = reach[nearer]
            cosine[nearer] = fall[nearer] / np.float32(np.sqrt(1 + a * a + b * b))
        return best, cosine

    def _kerb_hits(self, d: np.ndarray, origin: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Where rays that pass over the road and would end under the pavement meet the kerb's face."""
        best = high.copy()
        for axis, middle, half in ((1, 0.0, self.half_width), (0, self.crossing_x, self.crossing_half_width)):
            for edge in (middle - half, middle + half):
                at = (np.float32(edge - origin[axis])) / np.where(d[axis] == 0, np.float32(1e-9), d[axis])
                ahead = at + np.float32(1e-3)
                leaves = ~self.on_road(origin[0] + ahead * d[0], origin[1] + ahead * d[1])
                best = np.where((at >= low) & (at <= high) & leaves, np.minimum(best, at), best)
        return best

    def albedo(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """How bright the ground is, lane marks included."""
        road, walk, beyond = self.brightness
        shade = np.where(self.on_road(x, y), road, np.where(self.on_road(x, y, self.pavement), walk, beyond))
        off = np.abs(x - self.crossing_x)
        main = (np.abs(y) < self.half_width) & (off > self.crossing_half_width + 2)
        lanes = np.minimum(np.abs(y), np.abs(np.abs(y) - LANE_M))
        dashed = (np.abs(y) < 0.5) | (x % 9 < 3)
        marked = main & dashed & (lanes < _MARK_HALF_M)
        # A zebra crossing on either side of the junction.
        zebra = (np.abs(y) < self.half_width) & (np.abs(off - self.crossing_half_width - 3) < 1.5) & (y % 1 < 0.5)
        bright = np.where(marked | zebra, 0.35, shade)
        return bright if self.shading is None else bright * np.exp(self.shading.at(x, y))
