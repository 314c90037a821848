"""Exported .mtlx files, drawn by the code that MaterialX generates from them, in a browser."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from chrome import CHROMIUM, WEBGL

import traitbrdf as tb
from traitbrdf.export.lobes import Pixels, near_angles
from traitbrdf.reflectance.models import ggx_lobe

SIZE = 64
EYE = np.array([0.0, 0.0, 10.0])
LAMPS = np.array([(0.3, 0.4, 1.0), (-0.8, 0.3, 0.6), (0.9, 0.1, 0.25), (0.2, -0.9, 0.3)])
LAMPS /= np.linalg.norm(LAMPS, axis=1, keepdims=True)

DRAW = """([vertex, pixel, uniforms, size, eye, lamps]) => {
  const canvas = document.createElement('canvas'), gl = canvas.getContext('webgl2');
  gl.getExtension('EXT_color_buffer_float');
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, pixel]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS))
      throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS))
    throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  const target = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, target);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, size, size);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
  gl.viewport(0, 0, size, size);
  const at = name => gl.getUniformLocation(program, name);
  const one = [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1];
  for (const name of ['u_worldMatrix', 'u_worldInverseTransposeMatrix'])
    gl.uniformMatrix4fv(at(name), false, one);
  // straight down the z axis, so that a pixel's place on the sphere is plain
  gl.uniformMatrix4fv(at('u_viewProjectionMatrix'), false, [1,0,0,0, 0,1,0,0, 0,0,-.1,0, 0,0,0,1]);
  gl.uniform3fv(at('u_viewPosition'), eye);
  for (const [name, kind, value] of uniforms) {
    if (kind == 'float') gl.uniform1f(at(name), value[0]);
    else if (kind == 'boolean') gl.uniform1i(at(name), value[0]);
    else gl.uniform3fv(at(name), value);
  }
  // one small square of the sphere's face to each pixel
  const points = [], tangents = [];
  for (let y = 0; y < size; y++) for (let x = 0; x < size; x++) {
    const u = (2 * x + 1) / size - 1, v = (2 * y + 1) / size - 1;
    if (u * u + v * v > .95) continue;
    const z = Math.sqrt(1 - u * u - v * v), flat = Math.hypot(u, z);
    points.push(u, v, z);
    tangents.push(z / flat, 0, -u / flat);
  }
  for (const [name, data] of
       [['i_position', points], ['i_normal', points], ['i_tangent', tangents]]) {
    const place = gl.getAttribLocation(program, name);
    if (place < 0) continue;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(data), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
  }
  // textures that are not bound are black, and so is the map then
  gl.uniformMatrix4fv(at('u_envMatrix'), false, one);
  gl.uniform1i(at('u_envRadianceMips'), 1);
  gl.uniform1i(at('u_envRadianceSamples'), 1);
  gl.uniform1i(at('u_numActiveLightSources'), lamps.length);
  lamps.forEach((lamp, i) => {
    gl.uniform1i(at(`u_lightData[${i}].type`), 1);
    gl.uniform3fv(at(`u_lightData[${i}].direction`), lamp.map(c => -c));
    gl.uniform3fv(at(`u_lightData[${i}].color`), [1, 1, 1]);
    gl.uniform1f(at(`u_lightData[${i}].intensity`), 1);
  });
  gl.drawArrays(gl.POINTS, 0, points.length / 3);
  const pixels = new Float32Array(4 * size * size);
  gl.readPixels(0, 0, size, size, gl.RGBA, gl.FLOAT, pixels);
  return [Array.from(pixels), gl.getError()];
}"""


class Lit(Pixels):
    """Points of a sphere under parallel light from the lamps."""

    def __init__(self, grid, normals):
        views = EYE - normals
        views /= np.linalg.norm(views, axis=1, keepdims=True)
        super().__init__(grid, (views * normals).sum(1))
        side = np.cross(normals, (0.3, 0.5, 0.8))
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        frame = np.stack([side, np.cross(normals, side), normals], axis=1)
        self.views = (frame @ views[:, :, None])[..., 0]
        self.lamps = np.moveaxis(frame @ LAMPS.T, 2, 0)  # (lamps, m, 3)

    def images(self, tables):
        count = tables.shape[1]
        threes = np.pad(tables, ((0, 0), (0, -count % 3))).reshape(*self.grid.shape, -1, 3)
        found = np.zeros((len(self.cosine), threes.shape[-2], 3))
        for lamp in self.lamps:
            for i in range(threes.shape[-2]):
                table = tb.TabulatedBRDF(self.grid, threes[..., i, :])
                found[:, i] += table.eval(lamp, self.views) * np.maximum(lamp[:, 2:], 0.0)
        return found.reshape(len(self.cosine), -1)[:, :count]

    def ggx(self, alpha):  # not from a table: highlights of lamps are as sharp as the lobe
        found = 0.0
        for lamp in self.lamps:
            half = lamp + self.views
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            cosine = (half * lamp).sum(1)
            near = near_angles(cosine)
            lobe = ggx_lobe(lamp, self.views, alpha) * np.maximum(lamp[:, 2], 0.0)
            found = found + lobe[:, None] * near
        return found

    @property
    def mirror(self):
        return np.zeros(len(self.cosine))


def generated(document, name):
    """Vertex and pixel program of a material, and its uniforms, by MaterialX."""
    mx = importlib.import_module("MaterialX")
    shading = importlib.import_module("MaterialX.PyMaterialXGenShader")
    glsl = importlib.import_module("MaterialX.PyMaterialXGenGlsl")
    generator = glsl.EsslShaderGenerator.create()
    context = shading.GenContext(generator)
    context.registerSourceCodeSearchPath(mx.getDefaultDataSearchPath())
    options = context.getOptions()
    options.hwMaxActiveLightSources = len(LAMPS)
    light = document.getDataLibrary().getNodeDef("ND_directional_light")
    shading.HwShaderGenerator.bindLightShader(light, 1, context)
    shader = generator.generate(name, document.getNode(name), context)
    block = shader.getStage("pixel").getUniformBlocks()["PublicUniforms"]
    uniforms = []
    for port in (block[i] for i in range(block.size())):
        kind = port.getType().getName()
        if kind in ("float", "color3", "vector3", "boolean"):
            text = port.getValue().getValueString().replace("false", "0").replace("true", "1")
            uniforms.append([port.getVariable(), kind, [float(v) for v in text.split(",")]])
    return shader.getSourceCode("vertex"), shader.getSourceCode("pixel"), uniforms


@pytest.mark.slow
def test_generated_code_shows_the_material(tmp_path):
    mx = pytest.importorskip("MaterialX")
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no chromium")
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    row, column = np.mgrid[:SIZE, :SIZE]
    u, v = (2 * column + 1) / SIZE - 1, (2 * row + 1) / SIZE - 1
    inside = u * u + v * v <= 0.95
    x, y = u[inside], v[inside]
    sphere = np.stack([x, y, np.sqrt(1.0 - x * x - y * y)], axis=1)
    grid = tb.default_embedding().grid_
    lit = Lit(grid, sphere)
    edit = tb.EditSession(tb.Scene(tb.sphere(), size=8))
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=WEBGL)
        page = browser.new_page()
        for name in (
            "red-rubber",
            "gold-satin",
            "blue-plastic",
            "green-felt",
            "varnished-walnut-4",
        ):
            edit.assign("sphere", name)
            made = edit.export(tmp_path / f"{name}.mtlx")
            document = mx.createDocument()
            mx.readFromXmlFile(document, str(made.files[0]))
            document.setDataLibrary(library)
            programs = generated(document, "sphere")
            given = [*programs, SIZE, EYE.tolist(), LAMPS.tolist()]
            pixels, error = page.evaluate(DRAW, given)
            assert error == 0
            theirs = np.reshape(pixels, (SIZE, SIZE, 4))[inside][:, :3]
            ours = made.pairs[0].image(lit)
            table = made.pairs[0].material
            exact = lit.images(table.values.reshape(-1, 3))
            model = np.abs(theirs - ours).mean() / ours.mean()
            fit = np.abs(theirs - exact).mean() / exact.mean()
            print(f"{name}: generated code is {100 * model:.2f} % off our model of OpenPBR, "
                  f"{100 * fit:.1f} % off the table; {made}")  # fmt: skip
            assert model < 0.015, name  # cloth's fuzz is not reciprocal, and ours is the mean
            assert fit < 0.08, name  # lamps show highlights more than the fit's lights do
        browser.close()
