"""Smooth random fields over the plane, for undulating ground and shading of surfaces."""

import dataclasses

import numpy as np

_CELLS = 256
_CELL_M = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Relief:
    """A periodic field with mean 0, bilinear between the points of a grid."""

    values: np.ndarray  # f32[n, n], x first

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Values at positions in metres, f32[...].

        >>> field = Relief(np.eye(4, dtype=np.float32))
        >>> field.at(np.array([0.0, 0.25, 0.5]), np.array([0.0, 0.0, 0.5])).tolist()
        [1.0, 0.5, 1.0]
        """
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
    """Sample a field with a given standard deviation; amplitudes grow with wavelength to the ``power``.

    >>> field = sample_relief(np.random.default_rng(0), 0.05, 2.0)
    >>> round(float(field.values.std()), 4)
    0.05
    """
    frequency = np.hypot(np.fft.fftfreq(_CELLS)[:, None], np.fft.rfftfreq(_CELLS))
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((_CELLS, _CELLS))) * np.maximum(frequency, 3 / _CELLS) ** -power
    values = np.fft.irfft2(spectrum, (_CELLS, _CELLS))
    return Relief((deviation * values / values.std()).astype(np.float32))
