"""Physical descriptors of a BRDF, such as a gloss meter or a colorimeter would measure.

Every descriptor depends on values of f alone, never on a model's parameters, so measured and
synthetic materials are treated alike. `DESCRIPTORS` gives the meaning, unit and source of each.

Descriptors are formulas of `READINGS`, a few dozen numbers that are linear in f: f at some angles,
the flux into a gloss meter's receptor, and albedos. So they can be computed from a table, or from
the coordinates of an embedding without decoding the whole table.

The formulas separate a reflectance into two parts: the *body* is what remains far from the
highlight (theta_h of 44 to 50 degrees), and the *lobe* is what rises above it. No reading but the
albedo and "fresnel" uses a direction beyond 75 degrees, where measurements are unreliable.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.compiled import CACHED
from traitbrdf.directions import Array, half_diff_angles
from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF, albedo_operator

if TYPE_CHECKING:
    import scipy.sparse

Float64 = NDArray[np.float64]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec.709 luminance of linear RGB."""

_XYZ = np.array(
    [
        [0.41239080, 0.35758434, 0.18048079],
        [0.21263901, 0.71516868, 0.07219232],
        [0.01933082, 0.11919478, 0.95053215],
    ]
)  # linear Rec.709 to CIE XYZ, white D65 (ITU-R BT.709, SMPTE RP 177)

WHITE = _XYZ / _XYZ.sum(axis=1, keepdims=True)
_SEEN_FROM = math.radians(30.0)  # view angle of the albedo reading

_BLACK_GLASS = 0.1000562
"""Fresnel reflectance at 60 degrees of n = 1.567, which defines 100 gloss units (ASTM D523)."""

_BLACK_GLASS_20 = 0.0490782


class Descriptor(NamedTuple):
    """The meaning of a descriptor in one line, its unit, and its source.

    Parameters
    ----------
    meaning, unit, source : str
    """

    meaning: str
    unit: str
    source: str


DESCRIPTORS: Mapping[str, Descriptor] = MappingProxyType(
    {
        "highlight": Descriptor(
            "contrast of highlight and body, difference of cube roots of their radiance factors",
            "1",
            "contrast gloss, Hunter 1937; cube roots as in Pellacini et al. 2000, eq. 4",
        ),
        "gloss_20": Descriptor("specular gloss at 20 degrees", "GU", "ASTM D523"),
        "gloss_60": Descriptor("specular gloss at 60 degrees", "GU", "ASTM D523"),
        "haze": Descriptor(
            "log ratio of the breadths of the lobe to the power of 0.4 and of the lobe itself",
            "1",
            "a halo around a highlight, whatever its width: hazy gloss, Barla, Pacanowski & "
            "Vangorp 2018; ASTM E430 takes one angle, which wide lobes fill without a halo",
        ),
        "image": Descriptor(
            "distinctness of image: 1 minus the reflectance at 0.3 degrees over that at 0",
            "1",
            "ASTM E430; Hunter 1937, distinctness-of-reflected-image gloss",
        ),
        "width": Descriptor(
            "log of the integral breadth, in theta_h, of the lobe above the body",
            "log rad",
            "breadth of the lobe; d = 1 - alpha in Pellacini et al. 2000",
        ),
        "sheen": Descriptor(
            "log ratio of f at theta_h 60 and 40 degrees, light and view close together",
            "1",
            "asperity scattering of cloth and dust, Koenderink & Pont 2003; Hunter's sheen, 1937",
        ),
        "fresnel": Descriptor(
            "log ratio of the lobe's peak times the cosine at 70 and 15 degrees of incidence",
            "1",
            "Fresnel: dielectrics rise towards grazing, metals hardly do",
        ),
        "lightness": Descriptor(
            "cube root of the luminous albedo at 30 degrees", "1", "CIE 1976 lightness"
        ),
        "specular": Descriptor("luminous albedo of the lobe at 30 degrees", "1", "energy"),
        "diffuse": Descriptor("luminous albedo of the body", "1", "energy"),
        "reflection": Descriptor(
            "cube root of the specular minus that of the diffuse albedo",
            "1",
            "energy, on the scale of lightness",
        ),
        "tint": Descriptor(
            "standard deviation of the lobe's log RGB, at its peak and as a whole", "1", "chroma"
        ),
        "red": Descriptor(
            "log of red minus the mean log of green and blue, summed over body and lobe albedo",
            "1",
            "a colourless highlight does not weaken the colour: Todd, Norman & Mingolla 2004",
        ),
        "green": Descriptor("the same for green", "1", "albedo"),
        "blue": Descriptor("the same for blue", "1", "albedo"),
        "diffuse_hue": Descriptor("hue angle of the body", "degrees", "CIELAB, D65"),
        "diffuse_chroma": Descriptor("chroma of the body", "C*ab", "CIELAB, D65"),
        "specular_hue": Descriptor("hue angle of the lobe at its peak", "degrees", "CIELAB, D65"),
        "specular_chroma": Descriptor("chroma of the lobe scaled to white", "C*ab", "CIELAB, D65"),
        "flat": Descriptor(
            "log ratio of f at theta_h 60 degrees, light and view close together, and in the "
            "mirror direction",
            "1",
            "flat shading of rough surfaces, Oren & Nayar 1994: only the outline is visible",
        ),
        "chroma": Descriptor("chroma of all reflected light at 30 degrees", "C*ab", "CIELAB, D65"),
        "gold": Descriptor(
            "-log(d + 0.1), d the log distance of the peak's and the albedo's colour from gold's",
            "1",
            "reflectance of gold at normal incidence: Johnson & Christy 1972",
        ),
    }
)
"""All descriptors, in the order in which `descriptors` returns them."""

_DARK = 0.01  # an albedo too low to have a colour
_GOLD = np.log([1.0, 0.753, 0.374])  # linear Rec.709, over the greatest channel


def cielab(rgb: ArrayLike) -> Float64:
    """Return CIE 1976 L*a*b* (..., 3) of linear Rec.709 `rgb` (..., 3); white (1, 1, 1) is D65."""
    linear = np.maximum(np.asarray(rgb, np.float64), 0.0)
    xyz = linear @ WHITE.T
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz * (29 / 6) ** 2 / 3 + 4 / 29)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def hue(lab: ArrayLike) -> Float64:
    """Return hue angle in degrees [0, 360) and chroma as (..., 2) of CIELAB `lab` (..., 3)."""
    colour = np.asarray(lab, np.float64)
    a, b = colour[..., 1], colour[..., 2]
    return np.stack([np.degrees(np.arctan2(b, a)) % 360.0, np.hypot(a, b)], axis=-1)


_NODE_D = 90.0 / 23.0  # degrees between the theta_d nodes of the library's grid


def _node_h(i: int) -> float:
    """Return theta_h in degrees of node `i` of the library's grid."""
    return 90.0 * (i / 89.0) ** 2


_NODES_H = (0, 2, 4, 6, 8, 10, 12, 14, 17, 20, 23, 26, 30, 34, 38, 42, 46, 50, 54, 58, 62, 66)
PROFILE = tuple(_node_h(i) for i in _NODES_H)
"""theta_h in degrees at which the lobe's profile is read, at incidences of 16 to 47 degrees."""

_MIDDLE = tuple(_NODE_D * i for i in (4, 8, 12))
_NEAR = tuple(_NODE_D * i for i in (1, 2, 3))
_POINTS: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = MappingProxyType(
    {
        "body": (tuple(_node_h(i) for i in (62, 64, 66)), tuple(_NODE_D * i for i in (1, 3, 5))),
        "mirror": ((0.0,), (_NODE_D * 8,)),
        "beside": ((0.15,), (_NODE_D * 8,)),
        "steep": ((0.0,), (_NODE_D * 4,)),
        "grazing": ((0.0,), (_NODE_D * 18,)),
        "inner": ((_node_h(59),), _NEAR),
        "outer": ((_node_h(73),), _NEAR),
        **{f"profile {i}": ((theta,), _MIDDLE) for i, theta in enumerate(PROFILE)},
        "side": (tuple(_node_h(i) for i in (50, 56, 60)), tuple(_NODE_D * i for i in (11, 13, 15))),
    }
)  # each reading is the mean f over all pairs of these theta_h and theta_d, at phi_d 45 degrees

READINGS = ("albedo", "gloss 20", "gloss 60", *_POINTS, "albedo 10", "albedo 60")
"""Names of the readings that descriptors and colours are computed from; each is linear in f."""

_AT = MappingProxyType({name: i for i, name in enumerate(READINGS)})


@functools.lru_cache(maxsize=16)
def reading_rows(grid: HalfDiffGrid) -> scipy.sparse.csr_array:
    """Return sparse rows (len(READINGS), grid.size) that turn flat tables into readings.

    Parameters
    ----------
    grid : HalfDiffGrid
    """
    import scipy.sparse  # slow to import, and compiled formulas do without

    rows = [albedo_operator(grid, _SEEN_FROM)]
    for angle in (20, 60):
        wi, wo, weight = _receptor(angle)
        rows.append(_row(grid, *half_diff_angles(wi, wo), weight))
    for theta_h, theta_d in _POINTS.values():
        h, d = np.meshgrid(np.radians(theta_h), np.radians(theta_d))
        phi_d = np.full(h.size, math.pi / 4)
        rows.append(_row(grid, h.ravel(), d.ravel(), phi_d, np.full(h.size, 1.0 / h.size)))
    rows.append(albedo_operator(grid, np.radians([10.0, 60.0])))
    return scipy.sparse.csr_array(scipy.sparse.vstack(rows))


def _row(
    grid: HalfDiffGrid, theta_h: Array, theta_d: Array, phi_d: Array, weight: Float64
) -> scipy.sparse.csr_array:
    import scipy.sparse  # imported late, as in `reading_rows`

    index, corner = grid.stencil(theta_h, theta_d, phi_d)
    dense = np.bincount(index.ravel(), (corner * weight[:, None]).ravel(), minlength=grid.size)
    return scipy.sparse.csr_array(np.where(dense > 1e-12, dense, 0.0)[None])


def _receptor(angle: int) -> tuple[Float64, Float64, Float64]:
    """Return directions and weights that integrate a gloss meter's receptor (ASTM D523).

    The receptor of the standard (1.8 by 3.6 degrees at 20, 4.4 by 11.7 at 60) is lit by the
    reflection of a parallel beam. The weighted sum of f is the flux over that of black glass, in
    gloss units; black glass sends all its mirror reflection into the receptor.

    Returns
    -------
    wi, wo : (n, 3) arrays
        Directions to the lamp and into the receptor.
    weight : (n,) array
    """
    tall, wide, standard = {20: (1.8, 3.6, _BLACK_GLASS_20), 60: (4.4, 11.7, _BLACK_GLASS)}[angle]
    incident = math.radians(angle)
    # nodes are densest at the mirror direction, where a polished lobe has all its flux
    x, weight = np.polynomial.legendre.leggauss(24)
    x, weight = 0.5 * (x + 1.0), 0.5 * weight
    node = np.concatenate([-(x[::-1] ** 3), x**3])
    weight = np.concatenate([(3.0 * x**2 * weight)[::-1], 3.0 * x**2 * weight])
    up, aside = np.meshgrid(
        incident + math.radians(0.5 * tall) * node, math.radians(0.5 * wide) * node, indexing="ij"
    )
    wo = np.stack([np.sin(up) * np.cos(aside), np.sin(aside), np.cos(up) * np.cos(aside)], axis=-1)
    wi = np.broadcast_to([-math.sin(incident), 0.0, math.cos(incident)], wo.shape)
    solid = math.radians(0.5 * tall) * math.radians(0.5 * wide) * np.cos(aside)
    flux = wo[..., 2] * solid * weight[:, None] * weight[None, :]
    return wi.reshape(-1, 3), wo.reshape(-1, 3), (100.0 / standard * flux).ravel()


def describe(readings: ArrayLike) -> dict[str, Float64]:
    """Return all `DESCRIPTORS` by name, each (...,), of `readings` (..., len(READINGS), 3)."""
    columns = describe_columns(np.asarray(readings, np.float64))
    return {name: columns[..., i] for i, name in enumerate(DESCRIPTORS)}


def describe_columns(readings: Float64) -> Float64:
    """Return what `describe` returns as one array (..., len(DESCRIPTORS)).

    Parameters
    ----------
    readings : (..., len(READINGS), 3) array
    """
    flat = np.ascontiguousarray(readings.reshape(-1, *readings.shape[-2:]), np.float64)
    found = np.empty((len(flat), len(DESCRIPTORS)))
    formulas(flat, found)
    return found.reshape(*readings.shape[:-2], len(DESCRIPTORS))


_ALBEDO, _GLOSS_20, _GLOSS_60, _BODY, _MIRROR, _BESIDE, _STEEP, _GRAZING, _INNER, _OUTER = range(10)
_PEAK = 10
_COS_STEEP = math.cos(math.radians(_NODE_D * 4))
_COS_GRAZING = math.cos(math.radians(_NODE_D * 18))
_ROOTS = np.sqrt(np.radians(PROFILE))
_LOG_WIDE = math.log(math.pi / 4)
_CUBE_ROOT_OF_PI = math.pi ** (1 / 3)


# numpy's divisions: code that raises errors would take most of the compile time
@numba.njit(cache=CACHED, error_model="numpy")
def formulas(r: Any, out: Any) -> Any:
    """Fill `out` (m, len(DESCRIPTORS)) with `DESCRIPTORS` of readings `r` (m, len(READINGS), 3).

    The columns are in the order of `DESCRIPTORS`. Compiled, because one move of a trait evaluates
    this some hundred times.
    """
    # sizes taken from arguments: numba compiles an allocation anew for each constant size
    count, three = r.shape[1], r.shape[2]
    lobe, whole, body_of = np.empty(three), np.empty(three), np.empty(three)
    shed, below, upon = np.empty(three), np.empty(three), np.empty(three)
    light, known, powers = np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        known[i] = 0.0
    for m in range(len(r)):
        for i in range(len(light)):
            light[i] = 0.0
            for c in range(3):
                light[i] += LUMINANCE[c] * max(r[m, i, c], 0.0)
        albedo_light = 0.0
        peak_lobe = bright = top = 1e-12
        for c in range(3):
            whole[c] = max(r[m, _ALBEDO, c], 1e-4)
            bright = max(bright, whole[c])
            body_of[c] = max(r[m, _BODY, c], 0.0)
            lobe[c] = above(max(r[m, _PEAK, c], 0.0), body_of[c], 1e-3)
            peak_lobe, top = max(peak_lobe, lobe[c]), max(top, r[m, _PEAK, c])
            shed[c] = above(whole[c], math.pi * body_of[c], _DARK)
            below[c] = math.log(max(whole[c] - shed[c], 0.0) + _DARK)
            upon[c] = math.log(shed[c] + _DARK)
            albedo_light += LUMINANCE[c] * whole[c]
        peak, body = light[_PEAK], light[_BODY]
        specular = above(albedo_light, math.pi * body, _DARK)
        diffuse = max(albedo_light - specular, 0.0)
        steep = above(light[_STEEP], body, _DARK) * _COS_STEEP
        grazing = above(light[_GRAZING], body, _DARK) * _COS_GRAZING
        mean = square = off_gold = 0.0
        faint = 0.02 + 0.1 * body  # a lobe weaker than that has no colour of its own
        for c in range(3):
            tinted = 0.5 * (math.log(lobe[c] + faint) + math.log(shed[c] + 0.02))
            mean += tinted / 3.0
            square += tinted * tinted / 3.0
            lobe[c] /= peak_lobe
            # the colour in the mirror direction, because a faint lobe's own colour is noise
            shade = math.log((max(r[m, _PEAK, c], 0.0) + faint) / (top + faint)) - _GOLD[c]
            hue_of_all = math.log((whole[c] + _DARK) / (bright + _DARK)) - _GOLD[c]
            off_gold += (shade * shade + hue_of_all * hue_of_all) / 6.0
            body_of[c] *= math.pi
            one, two = (c + 1) % 3, (c + 2) % 3
            out[m, 13 + c] = (
                below[c] + upon[c] - 0.5 * (below[one] + upon[one] + below[two] + upon[two])
            )
        width, broad = _log_breadths(light, body, known, powers)
        # a lobe that hardly rises above the body counts as wide as the hemisphere, without halo
        stands = max(1.0 - body / max(peak, 1e-4), 0.0)
        outer = math.log(light[_OUTER] + 1e-3)
        out[m, 0] = _CUBE_ROOT_OF_PI * (peak ** (1 / 3) - body ** (1 / 3))
        out[m, 1] = light[_GLOSS_20]
        out[m, 2] = light[_GLOSS_60]
        out[m, 3] = stands * (broad - width)
        out[m, 4] = 1.0 - (light[_BESIDE] + 1e-4) / (light[_MIRROR] + 1e-4)
        out[m, 5] = stands * width + (1.0 - stands) * _LOG_WIDE
        out[m, 6] = outer - math.log(light[_INNER] + 1e-3)
        out[m, 7] = math.log((grazing + _DARK) / (steep + _DARK))
        out[m, 8] = albedo_light ** (1 / 3)
        out[m, 9] = specular
        out[m, 10] = diffuse
        out[m, 11] = specular ** (1 / 3) - diffuse ** (1 / 3)
        out[m, 12] = _rounded(max(square - mean * mean, 0.0), 0.12)
        # one loop, because the compiled code for a colour is long
        for i in range(3):
            rgb = body_of if i == 0 else lobe if i == 1 else whole
            a, b = _opponents(rgb)
            chroma = _rounded(a * a + b * b, 4.0)
            if i < 2:
                angle = math.degrees(math.atan2(b, a))
                out[m, 16 + 2 * i] = angle + 360.0 if angle < 0.0 else angle
                out[m, 17 + 2 * i] = chroma
            else:
                out[m, 21] = chroma
        out[m, 20] = outer - math.log(peak + 1e-3)
        out[m, 22] = -math.log(_rounded(off_gold, 0.12) + 0.1)


@numba.njit(cache=CACHED, error_model="numpy")
def _rounded(square: Any, soft: Any) -> Any:
    """Return the root of `square`, smoothed at 0, where the root itself has a kink."""
    return math.sqrt(square + soft * soft) - soft


@numba.njit(cache=CACHED, error_model="numpy")
def _opponents(rgb: Any) -> Any:
    """Return a* and b* of one linear RGB, as `cielab` does."""
    a = b = 0.0
    for i in range(3):
        x = 0.0
        for c in range(3):
            x += WHITE[i, c] * rgb[c]
        f = x ** (1 / 3) if x > (6 / 29) ** 3 else x * (29 / 6) ** 2 / 3 + 4 / 29
        a += 500.0 * f if i == 0 else -500.0 * f if i == 1 else 0.0
        b += 200.0 * f if i == 1 else -200.0 * f if i == 2 else 0.0
    return a, b


@numba.njit(cache=CACHED, error_model="numpy")
def above(whole: Any, body: Any, soft: Any) -> Any:
    """Return a smooth max(whole - body, 0) that is positive and at most `whole`.

    Parameters
    ----------
    whole, body : float
        Reflectance in total and of the body.
    soft : float
        Range in which the maximum is smoothed.
    """
    over = whole - body
    return min(0.5 * (over + math.sqrt(over * over + soft * soft)), whole)


@numba.njit(cache=CACHED, error_model="numpy")
def _log_breadths(light: Any, body: Any, known: Any, powers: Any) -> Any:
    """Return the log integral breadth in theta_h of the lobe, and of the lobe to the power of 0.4.

    The breadth is the width of a box of equal height and area along the root of theta_h. It is an
    integral, and not the place where a height is crossed, which would jump where a profile has a
    shelf. `known` and `powers` cache the inverse of a share at each place, and its power.
    """
    above_body = light[_PEAK] - body + 0.02 * body + 1e-4
    breadth = broad = last = last_broad = 0.0
    for i in range(len(_ROOTS)):
        share = min(max((light[_PEAK + i] - body) / above_body, 0.0), 1.0)
        # powers are most of the work; finite differences hardly change a share: use a series
        near = share * known[i] - 1.0
        if abs(near) < 1e-3:
            terms = 0.4 + near * (-0.12 + near * (0.064 + near * (-0.0416 + near * 0.029952)))
            spread = powers[i] * (1.0 + near * terms)
        else:
            spread = share**0.4 if share > 0.0 else 0.0
            if share > 0.0:
                known[i], powers[i] = 1.0 / share, spread
        if i > 0:
            wide = 0.5 * (_ROOTS[i] - _ROOTS[i - 1])
            breadth += wide * (share + last)
            broad += wide * (spread + last_broad)
        last, last_broad = share, spread
    least = 0.5 * _ROOTS[1]
    return 2.0 * math.log(max(breadth, least)), 2.0 * math.log(max(broad, least))


def read(brdf: TabulatedBRDF) -> Float64:
    """Return the `READINGS` (len(READINGS), 3) of a table; its mirror adds to gloss and albedo.

    Parameters
    ----------
    brdf : TabulatedBRDF
    """
    flat = np.asarray(brdf.values, np.float64).reshape(-1, 3)
    readings = np.asarray(reading_rows(brdf.grid) @ flat, np.float64)
    for name, whole in (
        ("albedo", 1.0), ("albedo 10", 1.0), ("albedo 60", 1.0),
        ("gloss 20", 100.0 / _BLACK_GLASS_20), ("gloss 60", 100.0 / _BLACK_GLASS)
    ):  # fmt: skip
        readings[_AT[name]] += whole * brdf.mirror
    return readings


def descriptors(brdf: TabulatedBRDF) -> dict[str, float]:
    """Return all `DESCRIPTORS` of the table `brdf` by name."""
    return {name: float(value) for name, value in describe(read(brdf)).items()}
