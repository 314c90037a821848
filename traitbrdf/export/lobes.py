"""Pixels of spheres at which materials are compared with the models of other programs.

Such a model is a sum of a few lobes, and its image is the sum of theirs. So the images of lobes are
computed once for each roughness; a fit then adds numbers, and takes milliseconds.
"""

from __future__ import annotations

import functools
import hashlib
import math
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import scipy.interpolate
from numpy.typing import NDArray

from traitbrdf.reflectance.brdf import HalfDiffGrid
from traitbrdf.reflectance.models import ggx_lobe, sheen_lobe
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import sphere
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.universal import light

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

ALPHAS: Float64 = np.geomspace(1e-3, 1.0, 43)
"""Roughness alpha of the GGX lobes that fits interpolate between."""

SHEENS: Float64 = np.geomspace(0.07, 1.0, 17)
"""Roughness alpha of the sheen lobes."""

FUZZES: Float64 = np.geomspace(0.1, 1.0, 15)
"""Roughness of the lobes of fuzz."""

ANGLES: Float64 = np.linspace(0.0, 1.0, 17) ** 1.5
"""Cosines of the angle of difference that lobes are told apart by; Fresnel terms are taken as
linear in between."""

_LIGHTS = 6
_PIXELS = 60  # of each light
_SIZE = 48
_KEPT = 8  # images of a picture
_DENSE = 400_000_000  # bytes of the rows of a picture that are kept, to be multiplied at once
_STEPS = 64  # of each angle, for albedos
_COSINES: Float64 = 1e-3 + (1.0 - 1e-3) * np.linspace(0.0, 1.0, 49) ** 2


class Pixels(ABC):
    """Pixels of spheres that materials are shown at.

    Parameters
    ----------
    grid : HalfDiffGrid of the "folded" layout
    cosine : (m,) float64, of the angle between view and normal
    """

    def __init__(self, grid: HalfDiffGrid, cosine: Float64) -> None:
        self.grid = grid
        self.cosine: Float64 = np.clip(cosine, 1e-3, 1.0)
        self._wi, self._wo = grid.node_directions()

    @abstractmethod
    def images(self, tables: Float32) -> Float64:
        """Return the radiance (m, T) of scalar tables (grid.size, T)."""

    @property
    @abstractmethod
    def mirror(self) -> Float64:
        """The radiance (m,) that a perfect mirror shows."""

    def of_table(self, values: Float32, mirror: Float64) -> Float64:
        """Return the radiance (m, 3) of a table (cells, 3), and of a mirror of a weight (3,)."""
        return self.images(values) + self.mirror[:, None] * mirror

    def ggx(self, alpha: float) -> Float64:
        """Return the images (m, angles) of a GGX lobe, told apart by `ANGLES`.

        Times the values of a Fresnel term there, they are the image of the lobe with that term.
        """
        return self._of_lobe(ggx_lobe(self._wi, self._wo, alpha))

    def sheen(self, alpha: float) -> Float64:
        """Return the image (m,) of a sheen lobe."""
        lobe = sheen_lobe(self._wi, self._wo, alpha)
        return self.images(lobe.reshape(-1, 1).astype(np.float32))[:, 0]

    def fuzz(self, roughness: float) -> Float64:
        """Return the image (m,) of a lobe of fuzz."""
        lobe = 0.5 * (
            fuzz_lobe(self._wi, self._wo, roughness) + fuzz_lobe(self._wo, self._wi, roughness)
        )
        return self.images(lobe.reshape(-1, 1).astype(np.float32))[:, 0]

    def ggx_albedo(self, alpha: float) -> Float64:
        """Return the directional albedos (m, angles) of the lobes of `ggx` at the pixels' views."""
        return ggx_albedo(self.cosine, alpha)

    def sheen_albedo(self, alpha: float) -> Float64:
        """Return the directional albedo (m,) of the lobe of `sheen` at the pixels' views."""
        return sheen_albedo(self.cosine, alpha)

    def diffuse(self) -> Float64:
        """Return the images (m, angles) of 1/pi, told apart as those of `ggx`."""
        return self._of_lobe(np.full(self.grid.shape, 1.0 / math.pi))

    def _of_lobe(self, lobe: Float64) -> Float64:
        return self.images((lobe.reshape(-1, 1) * self._near).astype(np.float32))

    @functools.cached_property
    def _near(self) -> Float64:
        """How much (cells, angles) of a cell belongs to each of the angles."""
        return near_angles(np.sqrt(0.5 * (1.0 + (self._wi * self._wo).sum(axis=-1))).ravel())


class FittingPixels(Pixels):
    """Pixels of spheres under made-up lights, each in light of one colour.

    Parameters
    ----------
    grid : HalfDiffGrid of the "folded" layout
    seed : int
        Draws lights and pixels.

    Attributes
    ----------
    light : (m,) int, which of the lights a pixel is lit by
    """

    def __init__(self, grid: HalfDiffGrid, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        rows, cosine, mirror, lit = [], [], [], []
        for i in range(_LIGHTS):
            scene = Scene(
                sphere(), EnvironmentMap.sky() if i == 0 else light(rng), size=_SIZE, subsamples=1,
                camera=Camera.orbit(float(rng.uniform(-180.0, 180.0)), 10.0),
            )  # fmt: skip
            facing = (scene.normals * scene.views).sum(axis=1)
            # evenly over the angles, so that rims count
            spacing = max(len(facing) // _PIXELS, 1)
            index = np.sort(np.argsort(facing)[int(rng.integers(0, spacing)) :: spacing])
            operator = Operator(scene, grid)
            rows.append(operator.rows(index)[:, 1])
            mirror.append(operator.mirror(index)[:, 1])
            cosine.append(facing[index])
            lit.append(np.full(len(index), i))
        super().__init__(grid, np.concatenate(cosine))
        self._rows: Float32 = np.ascontiguousarray(np.concatenate(rows))
        self._mirror: Float64 = np.concatenate(mirror).astype(np.float64)
        self.light = np.concatenate(lit)

    def images(self, tables: Float32) -> Float64:
        """Return the radiance (m, T) of scalar tables (grid.size, T)."""
        found: Float64 = (self._rows @ np.ascontiguousarray(tables)).astype(np.float64)
        return found

    @property
    def mirror(self) -> Float64:
        """The radiance (m,) that a perfect mirror shows."""
        return self._mirror

    def ggx(self, alpha: float) -> Float64:
        """Interpolate the images (m, angles) of a GGX lobe; `Pixels.ggx` computes them."""
        return _between(ALPHAS, self._ggx[0], alpha)

    def sheen(self, alpha: float) -> Float64:
        """Interpolate the image (m,) of a sheen lobe."""
        return _between(SHEENS, self._sheen[0], alpha)

    def diffuse(self) -> Float64:
        """Return the images (m, angles) of 1/pi, told apart as those of `ggx`; they are kept."""
        return self._diffuse

    @functools.cached_property
    def _diffuse(self) -> Float64:
        return super().diffuse()

    def fuzz(self, roughness: float) -> Float64:
        """Interpolate the image (m,) of a lobe of fuzz."""
        return _between(FUZZES, self._fuzz, roughness)

    def ggx_albedo(self, alpha: float) -> Float64:
        """Interpolate the directional albedos (m, angles) of the lobes of `ggx`."""
        return _between(ALPHAS, self._ggx[1], alpha)

    def sheen_albedo(self, alpha: float) -> Float64:
        """Interpolate the directional albedo (m,) of the lobe of `sheen`."""
        return _between(SHEENS, self._sheen[1], alpha)

    @functools.cached_property
    def _ggx(self) -> tuple[Float64, Float64]:
        images = np.stack([super(FittingPixels, self).ggx(a) for a in ALPHAS.tolist()])
        albedo = np.stack([ggx_albedo(_COSINES, a) for a in ALPHAS.tolist()])
        return images, self._at_views(albedo)

    @functools.cached_property
    def _sheen(self) -> tuple[Float64, Float64]:
        images = np.stack([super(FittingPixels, self).sheen(a) for a in SHEENS.tolist()])
        albedo = np.stack([sheen_albedo(_COSINES, a) for a in SHEENS.tolist()])
        return images, self._at_views(albedo)

    def _at_views(self, albedo: Float64) -> Float64:
        """Interpolate albedos (n, cosines, ...) at the pixels' views."""
        found: Float64 = scipy.interpolate.interp1d(_COSINES, albedo, axis=1)(self.cosine)
        return found

    @functools.cached_property
    def _fuzz(self) -> Float64:
        return np.stack([super(FittingPixels, self).fuzz(r) for r in FUZZES.tolist()])


class PicturePixels(Pixels):
    """The pixels of a sphere's picture under a map, one colour of the light at a time.

    Parameters
    ----------
    grid : HalfDiffGrid of the "folded" layout
    environment : EnvironmentMap
    size : int
        Pixels on a side.

    Attributes
    ----------
    colour : int
        The colour, 0 to 2, of the light.
    """

    def __init__(self, grid: HalfDiffGrid, environment: EnvironmentMap, size: int = 64) -> None:
        self.scene = Scene(sphere(), environment, size=size, subsamples=1)
        super().__init__(grid, (self.scene.normals * self.scene.views).sum(axis=1))
        self._operator = Operator(self.scene, grid)
        self._known: OrderedDict[bytes, Float32] = OrderedDict()
        self.colour = 0

    def images(self, tables: Float32) -> Float64:
        """Return the radiance (m, T) of scalar tables (grid.size, T) in light of one colour."""
        if self._rows is not None:
            rows = self._rows[:, self.colour]
            return np.asarray(rows @ np.ascontiguousarray(tables), np.float64)
        key = hashlib.blake2b(np.ascontiguousarray(tables).tobytes()).digest()
        if key not in self._known:
            self._known[key] = self._operator.part_images(0, tables)
            if len(self._known) > _KEPT:
                self._known.popitem(last=False)
        return self._known[key][:, self.colour].astype(np.float64)

    @functools.cached_property
    def _rows(self) -> Float32 | None:
        """The rows (m, 3, cells) of all pixels, if they are few."""
        if 12 * len(self.cosine) * self.grid.size > _DENSE:
            return None
        return self._operator.rows(np.arange(len(self.cosine)))

    @functools.cached_property
    def _mirrors(self) -> Float64:
        return self._operator.mirror(np.arange(len(self.cosine))).astype(np.float64)

    @property
    def mirror(self) -> Float64:
        """The radiance (m,) that a perfect mirror shows."""
        found: Float64 = self._mirrors[:, self.colour]
        return found

    def picture(self, image: Callable[[Pixels], Float64]) -> Float32:
        """Return a picture (size, size, 3), 0 around the sphere.

        Parameters
        ----------
        image : what gives the radiance (m, 3) of pixels
        """
        side = self.scene.height
        whole = np.zeros((side * side, 3), np.float32)
        for self.colour in range(3):
            whole[self.scene.pixels, self.colour] = image(self)[:, self.colour]
        return whole.reshape(side, side, 3)


def near_angles(cosine: Float64) -> Float64:
    """Return how much (m, angles) of each of `ANGLES` cosines (m,) of the angle of difference are.

    Times values at these angles, that is their linear interpolation.
    """
    place = np.interp(cosine, ANGLES, np.arange(len(ANGLES)))
    low = np.minimum(place.astype(np.int64), len(ANGLES) - 2)
    share, row = place - low, np.arange(len(place))
    found = np.zeros((len(place), len(ANGLES)))
    found[row, low], found[row, low + 1] = 1.0 - share, share
    return found


def ggx_albedo(cosine: Float64, alpha: float) -> Float64:
    """Return directional albedos (m, angles) of a GGX lobe, told apart by `ANGLES`.

    Parameters
    ----------
    cosine : (m,) float64, of the view
    alpha : float
    """
    # by half vectors that follow the lobe: its own density spends the samples where the light is
    u, turn = _squares()
    slope = alpha * np.sqrt(u / (1.0 - u))
    sine, up = slope / np.sqrt(1.0 + slope**2), 1.0 / np.sqrt(1.0 + slope**2)
    h = np.stack([sine * np.cos(turn), sine * np.sin(turn), up], axis=-1)
    found = np.empty((len(cosine), len(ANGLES)))
    for i, c in enumerate(cosine):
        wo = np.array([math.sqrt(max(1.0 - c * c, 0.0)), 0.0, c])
        along = np.maximum(h @ wo, 0.0)
        z = 2.0 * along * h[:, 2] - c
        a2 = alpha * alpha
        low = np.maximum(z, 1e-6)
        g = 2.0 * low * c / (
            low * np.sqrt(a2 + (1.0 - a2) * c * c) + c * np.sqrt(a2 + (1.0 - a2) * low * low)
        )  # fmt: skip
        weight = np.where(z > 0.0, g * along / (h[:, 2] * c), 0.0)
        found[i] = weight @ near_angles(along) / len(weight)
    return found


def sheen_albedo(cosine: Float64, alpha: float) -> Float64:
    """Return directional albedos (m,) of a sheen lobe; as for `ggx_albedo`."""
    return hemisphere(cosine, lambda wi, wo: sheen_lobe(wi, wo, alpha))


def fuzz_lobe(wi: Float64, wo: Float64, roughness: float) -> Float64:
    """Return the lobe (...) of OpenPBR's fuzz, as MaterialX fits its coefficients.

    Zeltner, Burley & Chiang, "Practical Multiple-Scattering Sheen Using Linearly Transformed
    Cosines" (2022).

    Parameters
    ----------
    wi, wo : (..., 3) float64
        Local unit vectors above the horizon; the lobe is not reciprocal.
    roughness : float in [0.1, 1]
    """
    x, y = np.clip(wo[..., 2], 0.0, 1.0), roughness
    a = (2.58126 * x + 0.813703 * y) * y / (1.0 + 0.310327 * x * x + 2.60994 * x * y)
    b = np.sqrt(1.0 - x) * (y - 1.0) * y**3
    b = b / (0.0000254053 + 1.71228 * x - 1.71506 * x * y + 1.34174 * y * y)
    flat = np.hypot(wo[..., 0], wo[..., 1])
    safe = np.maximum(flat, 1e-12)
    along = np.where(flat > 1e-12, (wi[..., 0] * wo[..., 0] + wi[..., 1] * wo[..., 1]) / safe, 0.0)
    across = np.sqrt(np.maximum(wi[..., 0] ** 2 + wi[..., 1] ** 2 - along**2, 0.0))
    z = np.maximum(wi[..., 2], 1e-6)
    length = (a * along + b * z) ** 2 + (a * across) ** 2 + z * z
    # the density contains the cosine, which the reflection equation multiplies by again
    found: Float64 = np.maximum(fuzz_albedo(x, y), 0.0) * (a / length) ** 2 / math.pi
    return found


def fuzz_albedo(cosine: Float64, roughness: float) -> Float64:
    """Return directional albedos (...) of `fuzz_lobe` at cosines of the view."""
    x, y = cosine, roughness
    s = y * (0.0206607 + 1.58491 * y) / (0.0379424 + y * (1.32227 + y))
    m = y * (-0.193854 + y * (-1.14885 + y * (1.7932 - 0.95943 * y * y))) / (0.046391 + y)
    o = y * (0.000654023 + (-0.0207818 + 0.119681 * y) * y) / (1.26264 + y * (-1.92021 + y))
    bell: Float64 = np.exp(-0.5 * ((x - m) / s) ** 2) / (s * math.sqrt(2.0 * math.pi)) + o
    return bell


def hemisphere(cosine: Float64, lobe: Callable[[Float64, Float64], Float64]) -> Float64:
    """Return the integrals (m,) of broad lobes times the cosine over the hemisphere."""
    u, turn = _squares()
    up, sine = np.sqrt(u), np.sqrt(1.0 - u)
    wi = np.stack([sine * np.cos(turn), sine * np.sin(turn), up], axis=-1)
    found = np.empty(len(cosine))
    for i, c in enumerate(cosine):
        wo = np.array([math.sqrt(max(1.0 - c * c, 0.0)), 0.0, c])
        found[i] = math.pi * lobe(wi, np.broadcast_to(wo, wi.shape)).mean()
    return found


@functools.cache
def _squares() -> tuple[Float64, Float64]:
    middle = (np.arange(_STEPS) + 0.5) / _STEPS
    u, turn = np.meshgrid(middle, 2.0 * math.pi * middle, indexing="ij")
    return u.ravel(), turn.ravel()


@functools.lru_cache(maxsize=2)
def fitting_pixels(grid: HalfDiffGrid) -> FittingPixels:
    """Return the pixels that materials on a grid are fitted at; they are found once."""
    return FittingPixels(grid)


def _between(nodes: Float64, images: Float64, alpha: float) -> Float64:
    """Interpolate images (n, ...) of lobes between their roughness (n,), by its logarithm."""
    place = float(np.interp(math.log(alpha), np.log(nodes), np.arange(len(nodes))))
    low = min(int(place), len(nodes) - 2)
    share = place - low
    mixed: Float64 = (1.0 - share) * images[low] + share * images[low + 1]
    return mixed
