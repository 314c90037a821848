"""A traitbrdf scene in Mitsuba 3: run this file, or import `load` from it.

    python scene.py out.exr --samples 256

The arrays lie beside it, in a file of the same name that ends in .npz. Materials are the tables as
they were shown, looked up by half and difference angles. The file needs numpy, and Mitsuba 3 with
the LLVM library; it does not need traitbrdf. Frames of traitbrdf show light that is scattered once
(``--depth 2``). There, unlike here, the ground hides nothing of the map from the object.
"""

from __future__ import annotations

import argparse
import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np

VARIANT = "llvm_ad_rgb"
FINER = 2  # texels of a bilinear map for each of ours, along each axis


def own(mi: Any, dr: Any, values: Any) -> Any:
    """Copy numbers to memory of Dr.Jit's own.

    Dr.Jit would use a NumPy array in place, and compile kernels again whenever the alignment of an
    array differs from the one before.
    """
    owned = dr.zeros(mi.Float, values.size)
    dr.scatter(owned, mi.Float(values.ravel()), dr.arange(mi.UInt32, values.size))
    dr.eval(owned)
    return owned


def table_material(mi: Any, dr: Any) -> Any:
    """Return a Mitsuba material class for tables on a folded grid, with two equal sides.

    An instance is made from tables (K, n_theta_h, n_theta_d, n_phi_d, 3), the roughness `alpha` of
    a GGX lobe and the share `even` of cosine-distributed directions; its samples are drawn from
    these two. `mirror` is the weight of a perfect mirror. `paint` blends the tables by texture
    coordinates: at each texel of a square texture the index of a cell and its position in it along
    n axes, and for each cell the 2^n tables at its corners.

    Parameters
    ----------
    mi, dr : modules mitsuba and drjit
    """

    class Table(mi.BSDF):  # type: ignore[misc]
        """Tables on a folded grid as a Mitsuba material."""

        def __init__(
            self, tables: Any, alpha: float, even: float, mirror: Any = 0.0, paint: Any = None
        ) -> None:
            super().__init__(mi.Properties())
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.mirror = np.broadcast_to(np.asarray(mirror, np.float32), (3,))
            self.m_components = [flags]
            if self.mirror.any():
                delta = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.FrontSide
                self.m_components.append(delta | mi.BSDFFlags.BackSide)
                flags = flags | delta
            self.m_flags = flags
            self.counts = tables.shape[1:4]
            self.fill(tables)
            self.alpha, self.even = dr.opaque(mi.Float, alpha), dr.opaque(mi.Float, even)
            self.paint = None
            if paint is not None:
                cell, share, corners = paint
                self.paint = (
                    math.isqrt(len(cell)), len(share), mi.UInt32(cell.astype(np.uint32)),
                    [mi.Float(axis.astype(np.float32)) for axis in share],
                    mi.UInt32(corners.astype(np.uint32).ravel()),
                )  # fmt: skip

        def fill(self, tables: Any) -> None:
            """Set the tables."""
            # padded to four values per node, which are gathered at once
            padded = np.zeros((tables.size // 3, 4), np.float32)
            padded[:, :3] = tables.reshape(-1, 3)
            self.values = own(mi, dr, padded)

        def node(self, i: Any) -> Any:
            """Return theta_h of a node."""
            return dr.square(mi.Float(i) / (self.counts[0] - 1)) * (0.5 * math.pi)

        def blended(self, si: Any, light: Any, view: Any) -> Any:
            """Return f where the surface is hit."""
            corners = self.corners(light, view)
            if self.paint is None:
                return self.gathered(corners, 0)
            size, axes, cell, share, table = self.paint
            x = dr.clip(mi.Int(si.uv.x * size), 0, size - 1)
            y = dr.clip(mi.Int((1.0 - si.uv.y) * size), 0, size - 1)
            texel = mi.UInt32(y * size + x)
            which = dr.gather(mi.UInt32, cell, texel) << axes
            places = [dr.gather(mi.Float, axis, texel) for axis in share]
            total = mi.Color3f(0)
            for corner in range(1 << axes):
                weight = mi.Float(1.0)
                for axis, place in enumerate(places):
                    weight *= place if corner >> axis & 1 else 1.0 - place
                index = dr.gather(mi.UInt32, table, which + corner)
                offset = index * (self.counts[0] * self.counts[1] * self.counts[2])
                total += weight * self.gathered(corners, offset)
            return total

        def gathered(self, corners: Any, offset: Any) -> Any:
            """Return the weighted sum of the values at some nodes of a table."""
            total = mi.Color3f(0)
            for weight, index in corners:
                value = dr.gather(mi.Vector4f, self.values, mi.UInt32(index) + offset)
                total += weight * mi.Color3f(value.x, value.y, value.z)
            return total

        def corners(self, light: Any, view: Any) -> Any:
            """Return weights and indices of nodes (Rusinkiewicz 1998)."""
            n_h, n_d, n_p = self.counts
            half = dr.normalize(light + view)
            slant = dr.hypot(half.x, half.y)
            theta_h = dr.atan2(slant, half.z)
            theta_d = dr.atan2(dr.norm(light - view), dr.norm(light + view))
            c, s = dr.select(slant > 0, half.x / slant, 1), dr.select(slant > 0, half.y / slant, 0)
            along = half.z * (c * light.x + s * light.y) - slant * light.z
            phi_d = dr.abs(dr.atan2(c * light.y - s * light.x, along))
            phi_d = dr.minimum(phi_d, math.pi - phi_d)

            def bracket(x: Any, count: int) -> Any:
                low = dr.clip(mi.Int(dr.floor(x)), 0, count - 2)
                return low, dr.clip(x - low, 0, 1)

            i, _ = bracket(dr.sqrt(theta_h * (2 / math.pi)) * (n_h - 1), n_h)
            f_h = (theta_h - self.node(i)) / (self.node(i + 1) - self.node(i))
            f_h = dr.clip(f_h, 0, 1)
            j, f_d = bracket(theta_d * (2 / math.pi) * (n_d - 1), n_d)
            k, f_p = bracket(phi_d * (2 / math.pi) * (n_p - 1), n_p)
            found = []
            for a, w_a in ((i, 1 - f_h), (i + 1, f_h)):
                for b, w_b in ((j, 1 - f_d), (j + 1, f_d)):
                    for e, w_e in ((k, 1 - f_p), (k + 1, f_p)):
                        found.append((w_a * w_b * w_e, (a * n_d + b) * n_p + e))
            return found

        def upright(self, view: Any, light: Any) -> Any:
            """Mirror directions to the upper side, and tell whether both are above the surface."""
            side = dr.sign(view.z)
            view = mi.Vector3f(view.x, view.y, side * view.z)
            light = mi.Vector3f(light.x, light.y, side * light.z)
            return view, light, (view.z > 0) & (light.z > 0)

        def spread(self) -> Any:
            """Return the microfacet distribution that samples are drawn from."""
            return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha, True)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            """Return f times the cosine."""
            view, light, above = self.upright(si.wi, wo)
            return dr.select(active & above, self.blended(si, light, view) * light.z, 0)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            """Return the density of `sample`."""
            view, light, above = self.upright(si.wi, wo)
            half = dr.normalize(view + light)
            lobe = self.spread().pdf(view, half) / (4 * dr.dot(view, half))
            even = mi.warp.square_to_cosine_hemisphere_pdf(light)
            spent = 0.5 if self.mirror.any() else 1.0
            return dr.select(active & above, spent * dr.lerp(lobe, even, self.even), 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            """Return `eval` and `pdf`."""
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            """Draw a direction to the light from the lobe or the cosine distribution."""
            view, _, _ = self.upright(si.wi, si.wi)
            shiny = mi.Bool(False)
            if self.mirror.any():  # half of the samples
                shiny = sample1 < 0.5
                sample1 = dr.select(shiny, 2.0 * sample1, 2.0 * sample1 - 1.0)
            half, _ = self.spread().sample(view, sample2)
            even = mi.warp.square_to_cosine_hemisphere(sample2)
            light = dr.select(sample1 < self.even, even, mi.reflect(view, half))
            light = dr.select(shiny, mi.Vector3f(-view.x, -view.y, view.z), light)
            drawn = mi.BSDFSample3f()
            drawn.wo = mi.Vector3f(light.x, light.y, dr.sign(si.wi.z) * light.z)
            drawn.eta = 1.0
            glossy, delta = mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DeltaReflection
            drawn.sampled_type = dr.select(shiny, mi.UInt32(+delta), mi.UInt32(+glossy))
            drawn.sampled_component = dr.select(shiny, mi.UInt32(1), mi.UInt32(0))
            drawn.pdf = dr.select(shiny, 0.5, self.pdf(ctx, si, drawn.wo, active))
            value = self.eval(ctx, si, drawn.wo, active)
            mirrored = mi.Color3f([float(channel) for channel in self.mirror])
            value = dr.select(shiny, mirrored, value)
            return drawn, dr.select(active & (drawn.pdf > 0), value / drawn.pdf, 0)

        def traverse(self, callback: Any) -> None:
            """Offer no parameters."""

        def to_string(self) -> str:
            """Return a short description."""
            return f"Table{self.counts}"

    return Table


def light_map(mi: Any, image: Any, rotation: float, finer: int = FINER) -> Any:
    """Return a lat-long map (rows, 2 rows, 3), turned about y by radians, as an emitter.

    Mitsuba's rows are at multiples of pi / (H - 1), its columns are centred, and u = 0.5 is +z. Its
    map is bilinear: every texel becomes `finer` x `finer` texels, and ramps remain at its edges.
    """
    rows, columns, _ = image.shape
    wide = image.repeat(finer, axis=1)
    edge = np.arange(finer * rows + 1)
    above, below = np.maximum(edge - 1, 0) // finer, np.minimum(edge // finer, rows - 1)
    fine = np.roll(0.5 * (wide[above] + wide[below]), finer * columns // 2, axis=1)
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(fine, np.float32)),
        "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], math.degrees(rotation)),
        "mis_compensation": True,
    }


def load(path: Any) -> Any:
    """Return the Mitsuba scene of an .npz file; the variant must be set before."""
    dr: Any = importlib.import_module("drjit")
    mi: Any = importlib.import_module("mitsuba")
    with np.load(path) as arrays:
        data = {name: arrays[name] for name in arrays.files}
    make = table_material(mi, dr)
    content: dict[str, Any] = {"type": "scene"}
    if data["map"].any():
        content["map"] = light_map(mi, data["map"], float(data["rotation"]))
    for i, name in enumerate(data["parts"]):
        part = {key.split("/", 1)[1]: v for key, v in data.items() if key.startswith(f"{i}/")}
        paint = (part["cell"], part["share"], part["corners"]) if "cell" in part else None
        material = make(
            part["tables"], float(part["alpha"]), float(part["even"]), part["mirror"], paint
        )
        if "radius" in part:
            place = {"center": part["center"].tolist(), "radius": float(part["radius"])}
            content[f"part{i}"] = {"type": "sphere", "material": material, **place}
            continue
        settings = mi.Properties()
        settings["material"] = material
        mesh = mi.Mesh(
            str(name), len(part["positions"]), len(part["faces"]), settings,
            has_vertex_normals=True, has_vertex_texcoords=True,
        )  # fmt: skip
        fields = mi.traverse(mesh)
        fields["vertex_positions"] = part["positions"].ravel()
        fields["vertex_normals"] = part["normals"].ravel()
        fields["vertex_texcoords"] = part["uvs"].ravel()
        fields["faces"] = part["faces"].ravel()
        fields.update()
        content[f"part{i}"] = mesh
    for i, (point, place, power) in enumerate(
        zip(data["light_point"], data["light_place"], data["light_power"], strict=True)
    ):
        level = {"type": "rgb", "value": power.tolist()}
        content[f"light{i}"] = (
            {"type": "point", "position": place.tolist(), "intensity": level}
            if point
            else {"type": "directional", "direction": (-place).tolist(), "irradiance": level}
        )
    height, width = data["size"].tolist()
    content["camera"] = {
        "type": "perspective",
        "fov": float(data["fov"]),
        "fov_axis": "y",
        "to_world": mi.ScalarTransform4f().look_at(
            data["eye"].tolist(), data["target"].tolist(), [0, 1, 0]
        ),
        "film": {
            "type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"},
        },
    }  # fmt: skip
    return mi.load_dict(content)


def main() -> None:
    """Render the scene to a file."""
    mi: Any = importlib.import_module("mitsuba")
    here = Path(__file__)
    parser = argparse.ArgumentParser(description="Render this scene with Mitsuba 3.")
    parser.add_argument("out", nargs="?", default=str(here.with_suffix(".exr")))
    parser.add_argument("--samples", type=int, default=64, help="of each pixel")
    parser.add_argument("--depth", type=int, default=2, help="2 is light that is scattered once")
    asked = parser.parse_args()
    mi.set_variant(VARIANT)
    scene = load(here.with_suffix(".npz"))
    path = mi.load_dict({"type": "path", "max_depth": asked.depth})
    mi.util.write_bitmap(asked.out, mi.render(scene, integrator=path, spp=asked.samples))


if __name__ == "__main__":
    main()
