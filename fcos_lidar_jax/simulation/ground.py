"""Ground of sloping planes with two streets, even or uneven, and random fields for undulations and shading."""

import dataclasses

import numpy as np

LANE_M = 3.5
_MARK_HALF_M = 0.08
_DIRECTIONS = 720  # number of profiles of uneven ground around the sensor
_PROFILE_M = np.geomspace(1.0, 120.0, 144)  # distances from the sensor at which a profile is sampled
_BISECTIONS = 5  # bisections of the profile segment that contains a hit
_CELLS = 256  # size of a relief's grid
_CELL_M = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Relief:
    """A smooth periodic field with mean 0, bilinear between the points of a grid: undulations or shading."""

    values: np.ndarray  # f32[n, n], x first

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Values at positions in metres, f32[...]."""
        n = len(self.values)
        u, v = np.asarray(x, np.float32) / np.float32(_CELL_M), np.asarray(y, np.float32) / np.float32(_CELL_M)
        i, j = np.floor(u), np.floor(v)
        u, v, i, j = u - i, v - j, i.astype(np.int32), j.astype(np.int32)
        flat = self.values.ravel()
        i0, i1, j0, j1 = i % n * n, (i + 1) % n * n, j % n, (j + 1) % n
        low = flat.take(i0 + j0) * (1 - v) + flat.take(i0 + j1) * v
        high = flat.take(i1 + j0) * (1 - v) + flat.take(i1 + j1) * v
        return low * (1 - u) + high * u


def sample_relief(rng: np.random.Generator, deviation: float, power: float) -> Relief:
    """Sample a field with a given standard deviation; amplitudes grow with wavelength to the ``power``."""
    frequency = np.hypot(np.fft.fftfreq(_CELLS)[:, None], np.fft.rfftfreq(_CELLS))
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((_CELLS, _CELLS))) * np.maximum(frequency, 3 / _CELLS) ** -power
    values = np.fft.irfft2(spectrum, (_CELLS, _CELLS))
    return Relief((deviation * values / values.std()).astype(np.float32))


@dataclasses.dataclass(frozen=True)
class Ground:
    """A main street along x and a crossing street, between raised pavements, on sloping planes.

    Street frame: x along the main street, y to the left of it, z up; metres.
    """

    planes: np.ndarray  # f64[p, 3]: z = a x + b y + c; the ground is the highest plane, so it is convex
    half_width: float  # half width of the main carriageway
    crossing_x: float  # x of the middle of the crossing street, which runs along y
    crossing_half_width: float  # half width of its carriageway
    kerb: float  # height of the ground beside the carriageways above them
    pavement: float  # width of the pavements
    brightness: tuple[float, float, float]  # albedo of carriageways, pavements and the ground beyond
    crown: float = 0.0  # height of the middle of the carriageways above their gutters
    relief: Relief | None = None  # undulations, metres
    shading: Relief | None = None  # added to the logarithm of the brightness

    def on_road(self, x: np.ndarray, y: np.ndarray, margin: np.ndarray | float = 0.0) -> np.ndarray:
        """Whether points lie on a carriageway or within ``margin`` of it."""
        main = np.abs(y) < self.half_width + margin
        return main | (np.abs(x - self.crossing_x) < self.crossing_half_width + margin)

    def slope_height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height of the ground without kerbs."""
        height = np.max([a * x + b * y + c for a, b, c in self.planes], axis=0)
        if self.crown:
            main, other = np.abs(y) / self.half_width, np.abs(x - self.crossing_x) / self.crossing_half_width
            height = height - self.crown * np.minimum(np.minimum(main, other), 1) ** 2
        return height if self.relief is None else height + self.relief.at(x, y)

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self.slope_height(x, y) + np.where(self.on_road(x, y), 0.0, self.kerb)

    def first_hits(self, d: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Intersect rays with the ground.

        Args:
            d: f32[3, k], unit vectors.
            origin: f64[3], above the ground and its kerbs.

        Returns:
            range f32[k], inf for rays that miss the ground, and cosine of the angle of incidence f32[k].
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
        """Implement :meth:`first_hits` by bisection of the first profile segment that rises to the ray.

        Ground nearer than the start or beyond the end of the profiles is ignored.
        """
        flat = np.maximum(np.hypot(d[0], d[1]), np.float32(1e-9))
        towards, rise = d[:2] / flat, d[2] / flat
        sector = ((np.arctan2(d[1], d[0]) / (2 * np.pi) % 1) * _DIRECTIONS).astype(np.int32) % _DIRECTIONS
        used, row = np.unique(sector, return_inverse=True)
        angle = (used[:, None] + 0.5) * (2 * np.pi / _DIRECTIONS)
        x, y = origin[0] + np.cos(angle) * _PROFILE_M, origin[1] + np.sin(angle) * _PROFILE_M
        highest = np.maximum.accumulate((self.height(x, y) - origin[2]) / _PROFILE_M, axis=1)
        # One search covers all profiles: offsets keep their slopes, which are clipped, in separate intervals.
        offset = 4.0 * np.arange(len(used))
        position = np.searchsorted((np.clip(highest, -2, 2) + offset[:, None]).ravel(), rise + offset[row])
        segment = position - row * len(_PROFILE_M)
        hit = np.flatnonzero((segment < len(_PROFILE_M)) & (rise > -2))
        last = _PROFILE_M[np.maximum(segment[hit], 1)].astype(np.float32)
        first = _PROFILE_M[np.maximum(segment[hit], 1) - 1].astype(np.float32)
        towards, rise = towards[:, hit], rise[hit]
        eye = origin.astype(np.float32)
        for _ in range(_BISECTIONS):
            middle = (first + last) / 2
            x, y = eye[0] + towards[0] * middle, eye[1] + towards[1] * middle
            under = self.height(x, y) > eye[2] + rise * middle
            first, last = np.where(under, first, middle), np.where(under, middle, last)
        distance = (first + last) / 2
        x, y = eye[0] + towards[0] * distance, eye[1] + towards[1] * distance
        here = self.slope_height(x, y)
        a, b = (2 * (self.slope_height(x + u, y + v) - here) for u, v in ((0.5, 0.0), (0.0, 0.5)))
        cosine = (a * d[0, hit] + b * d[1, hit] - d[2, hit]) / np.sqrt(1 + a * a + b * b)
        range_m, cosines = np.full(d.shape[1], np.inf, np.float32), np.zeros(d.shape[1], np.float32)
        range_m[hit], cosines[hit] = distance / flat[hit], np.clip(cosine, 0.01, 1)
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
        """Range at which rays that cross the road and would end under the pavement hit the face of the kerb."""
        best = high.copy()
        for axis, middle, half in ((1, 0.0, self.half_width), (0, self.crossing_x, self.crossing_half_width)):
            for edge in (middle - half, middle + half):
                at = (np.float32(edge - origin[axis])) / np.where(d[axis] == 0, np.float32(1e-9), d[axis])
                ahead = at + np.float32(1e-3)
                leaves = ~self.on_road(origin[0] + ahead * d[0], origin[1] + ahead * d[1])
                best = np.where((at >= low) & (at <= high) & leaves, np.minimum(best, at), best)
        return best

    def albedo(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Albedo of the ground, including road markings."""
        road, walk, beyond = self.brightness
        shade = np.where(self.on_road(x, y), road, np.where(self.on_road(x, y, self.pavement), walk, beyond))
        offset = np.abs(x - self.crossing_x)
        main = (np.abs(y) < self.half_width) & (offset > self.crossing_half_width + 2)
        lanes = np.minimum(np.abs(y), np.abs(np.abs(y) - LANE_M))
        dashed = (np.abs(y) < 0.5) | (x % 9 < 3)
        marked = main & dashed & (lanes < _MARK_HALF_M)
        # A zebra crossing on each side of the junction.
        zebra = (np.abs(y) < self.half_width) & (y % 1 < 0.5)
        zebra &= np.abs(offset - self.crossing_half_width - 3) < 1.5
        bright = np.where(marked | zebra, 0.35, shade)
        return bright if self.shading is None else bright * np.exp(self.shading.at(x, y))


@dataclasses.dataclass(frozen=True)
class Side:
    """A section of one side of a street."""

    ground: Ground
    along: int  # 0 main street, 1 crossing street
    side: int  # 1 to the left of the street's direction, -1 to the right
    span: tuple[float, float]  # metres along the street

    @property
    def edge_m(self) -> float:
        """Distance of the kerb from the middle of the street."""
        return self.ground.crossing_half_width if self.along else self.ground.half_width

    @property
    def back_m(self) -> float:
        """Distance of the back of the pavement from the middle of the street."""
        return self.edge_m + self.ground.pavement

    @property
    def length_m(self) -> float:
        return self.span[1] - self.span[0]

    @property
    def yaw(self) -> float:
        return np.pi / 2 * self.along

    @property
    def facing(self) -> float:
        """Direction from the side to the street, radians."""
        return (1 + self.side) * np.pi / 2 if self.along else -self.side * np.pi / 2

    def free(
        self, s: np.ndarray, away: np.ndarray | float, clear: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions ``x, y`` at ``s`` along and ``away`` from the middle of the street; and their indices.

        Positions on carriageways or closer to them than ``clear`` are omitted.
        """
        beside = self.side * away + np.zeros(len(s))
        x, y = (self.ground.crossing_x + beside, s) if self.along else (s, beside)
        free = np.flatnonzero(~self.ground.on_road(x, y, clear))
        return x[free], y[free], free

    def positions(
        self, s: np.ndarray, away: np.ndarray | float, clear: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Like :meth:`free`, on the ground: positions f64[k, 3], and their indices."""
        x, y, free = self.free(s, away, clear)
        return np.stack([x, y, self.ground.height(x, y)], axis=1), free
