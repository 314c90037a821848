// The live canvas, what one sees of it, in notebooks (anywidget) and on the page.

import { Link, Socket, letterOf, opaque } from "./link.js";

const RESTS = 250; // ms until the hand rests
const OTHERS = 100; // ms between two looks at what other views changed
const TELLS = 120; // ms between two looks of the hand's owner at figures and sliders

/** An image of the bytes of a file. Blobs are registered with the browser's own process, which takes
 * milliseconds: where there are decoders, they are spared. */
async function decoded(data, type) {
  if (!globalThis.ImageDecoder) return createImageBitmap(new Blob([data], { type }));
  const decoder = new ImageDecoder({ data, type });
  const { image } = await decoder.decode();
  decoder.close();
  return image;
}

const STYLE = `
.tb { --back: #1e1e1e; --raised: #2c2c2c; --line: #4c4c4c; --text: #e4e4e4; --quiet: #a6a6a6;
  --accent: #6aa0dc; --on: #34608f; --bad: #ff9d7a; color-scheme: dark;
  display: flex; flex-wrap: wrap; gap: 16px; color: var(--text); background: var(--back);
  padding: 12px; font: 13px/1.4 system-ui, sans-serif; outline: none; border-radius: 6px;
  contain: content; box-sizing: border-box; }
.tb[data-theme=light] { --back: #d2d2d2; --raised: #ededed; --line: #8a8a8a; --text: #1a1a1a;
  --quiet: #474747; --accent: #1d5c9c; --on: #a9c6e6; --bad: #8c2600; color-scheme: light; }
.tb-stage { position: relative; contain: layout paint; line-height: 0; align-self: flex-start; touch-action: none; }
.tb-stage canvas { max-width: 100%; background: #000; cursor: none; border-radius: 4px; }
.tb-stage[data-tool=pick] canvas { cursor: pointer; }
.tb-stage[data-tool=orbit] canvas, .tb-stage[data-tool=light] canvas { cursor: move; }
.tb-ring { position: absolute; border: 1px solid #fff; border-radius: 50%; pointer-events: none;
  outline: 1px solid #0008; display: none; left: 0; top: 0; box-sizing: border-box;
  will-change: transform; }
.tb-stage[data-tool=brush]:hover .tb-ring { display: block; }
.tb-side { width: 22em; display: flex; flex-direction: column; gap: 0.6em; }
.tb-whole { display: grid; grid-template-columns: minmax(0, 1fr) auto; width: 100%; height: 100vh;
  border-radius: 0; font-size: clamp(13px, 0.45vw + 0.45vh + 4px, 24px); }
.tb-whole .tb-stage { place-self: center;
  width: min(100%, calc((100vh - 24px) * var(--aspect, 1))); }
.tb-whole .tb-stage canvas { width: 100%; height: auto; }
.tb-whole .tb-side { overflow-y: auto; min-height: 0; padding-right: 4px; }
@media (max-aspect-ratio: 1/1), (max-width: 800px) {
  .tb-whole { grid-template-columns: minmax(0, 1fr); height: auto; min-height: 100vh; }
  .tb-whole .tb-stage { width: min(100%, calc(60vh * var(--aspect, 1))); }
  .tb-whole .tb-side { width: auto; }
}
.tb-row { display: flex; gap: 0.5em; align-items: center; }
.tb-row > label { width: 5em; color: var(--quiet); }
.tb-row > select, .tb-row > input { flex: 1; min-width: 0; }
.tb output { width: 3em; text-align: right; font-variant-numeric: tabular-nums; }
.tb button, .tb select, .tb input[type=text] { background: var(--raised); color: var(--text);
  border: 1px solid var(--line); border-radius: 4px; padding: 0.25em 0.6em; font: inherit; }
.tb :focus-visible { outline: 2px solid var(--accent); outline-offset: 1px; }
.tb button[aria-pressed=true] { background: var(--on); border-color: var(--accent); }
.tb button:disabled { opacity: 0.4; }
.tb input[type=range], .tb input[type=checkbox] { accent-color: var(--accent); }
.tb-sliders { border-top: 1px solid var(--line); border-bottom: 1px solid var(--line);
  padding: 0.3em 0.1em; }
.tb-sliders summary { cursor: pointer; color: var(--quiet); padding: 0.15em 0; }
.tb-shelf { display: grid; grid-template-columns: repeat(auto-fill, minmax(2.9em, 1fr)); gap: 3px;
  max-height: 9.5em; overflow-y: auto; flex-shrink: 0; }
.tb-shelf button { padding: 1px; line-height: 0; }
.tb-shelf canvas { width: 100%; height: auto; border-radius: 50%; }
.tb-layers { max-height: 12em; overflow-y: auto; border-top: 1px solid var(--line); flex-shrink: 0; }
.tb-layer { display: flex; gap: 0.3em; align-items: center; padding: 2px; cursor: default; }
.tb-layer[aria-selected=true] { background: var(--on); }
.tb-layer > span { flex: 1; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.tb-layer > input[type=range] { width: 5em; }
.tb-side[data-where=part] .tb-soft { display: none; }
.tb-status { font-variant-numeric: tabular-nums; color: var(--quiet); min-height: 3.9em; }
.tb-status b { color: var(--text); font-weight: 600; }
.tb-bad { color: var(--bad); }
.tb pre { margin: 0; font: 0.85em/1.35 ui-monospace, monospace; color: var(--text);
  white-space: pre-wrap; overflow-wrap: anywhere; max-height: 9em; overflow-y: auto;
  background: none; flex-shrink: 0; }
`;

function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key in element && key !== "list") element[key] = value;
    else element.setAttribute(key, value);
  }
  element.append(...children);
  // JupyterLab would take keys for its own, and asks what has the focus before what is around it
  if (element.tabIndex >= 0) element.setAttribute("data-lm-suppress-shortcuts", "true");
  return element;
}

const TOOLS = {
  brush: "Brush (1): paint the chosen trait",
  pick: "Pick (2): choose a part",
  orbit: "Orbit (3): turn the camera by dragging; also with the right button",
  light: "Light (4): turn the map by dragging",
};

class Canvas {
  constructor(model, el, fill) {
    this.model = model;
    this.view = Math.random().toString(36).slice(2);
    this.channel = model;
    const local = ["127.0.0.1", "localhost"].includes(location.hostname);
    this.link = new Link(this.view, (header, buffers) => {
      this.channel.send(header, undefined, buffers);
    }, {
      padding: !fill, // our own server does not hold small messages back
      greeting: fill || !local ? {} : { origin: location.origin },
    });
    this.tool = "brush";
    this.state = null;
    this.drawn = [];
    this.times = []; // of the last frames, for whoever measures
    this.drawing = Promise.resolve();
    this.build(el, fill);
    this.listener = (header, buffers) => this.hear(header, buffers);
    model.on("msg:custom", this.listener);
    this.clock = setInterval(() => this.showStatus(), 500);
    this.link.ask({ hello: true });
  }

  end() {
    clearInterval(this.clock);
    clearTimeout(this.resting);
    clearTimeout(this.telling);
    clearTimeout(this.finding);
    this.model.off("msg:custom", this.listener);
    this.socket?.close();
    for (const undo of this.undoing) undo();
  }

  // -- what is seen --------------------------------------------------------------------------

  build(el, fill) {
    this.undoing = [];
    this.picture = make("canvas", { width: 512, height: 512 });
    this.paper = this.picture.getContext("2d", { alpha: false });
    this.ring = make("div", { className: "tb-ring" });
    this.stage = make("div", { className: "tb-stage" }, this.picture, this.ring);
    this.tools = Object.fromEntries(Object.entries(TOOLS).map(([name, title]) => [
      name, make("button", { title, textContent: name, onclick: () => this.take(name) }),
    ]));
    this.parts = make("select", { ariaLabel: "part",
      onchange: () => this.change({ part: this.parts.value }) });
    this.library = make("select", { ariaLabel: "material", onchange: () => {
      this.change({ assign: { part: this.state.part, material: this.library.value } }, false);
    } });
    this.trait = make("select", { ariaLabel: "trait" });
    this.where = make("select", { ariaLabel: "where", title: "what a stroke changes: whole parts, "
      + "or softly the surface under the brush", onchange: () => this.choose() },
      make("option", { value: "part", textContent: "whole parts" }),
      make("option", { value: "local", textContent: "the surface" }));
    this.paintWith = make("select", { ariaLabel: "with", onchange: () => this.choose() },
      ...["trait", "material", "colour", "eraser"].map((name) => make("option", {
        value: name, textContent: name })));
    this.paintMaterial = make("select", { ariaLabel: "paint material" });
    this.colour = make("input", { type: "color", value: "#b03030", ariaLabel: "colour" });
    this.hardness = this.range("hardness", 0, 1, 0.5);
    this.flow = this.range("flow", 0.05, 1, 1);
    this.layers = make("div", { className: "tb-layers", role: "listbox", ariaLabel: "layers" });
    this.selected = null; // the layer that strokes go onto; a stroke elsewhere makes a new one
    this.tied = ["up", "down", "duplicate", "invert", "clear", "delete"].map((name) => make("button", {
      textContent: name, disabled: true, onclick: () => this.stack(name) }));
    this.amount = this.range("amount", -1, 1, 0.6);
    this.radius = this.range("radius", 3, 120, 24, 1);
    this.stay = make("input", { type: "checkbox", checked: true });
    this.undo = make("button", { textContent: "undo", title: "Ctrl+Z",
      onclick: () => this.change({ do: "undo" }, false) });
    this.redo = make("button", { textContent: "redo", title: "Ctrl+Shift+Z or Ctrl+Y",
      onclick: () => this.change({ do: "redo" }, false) });
    this.compare = make("button", { textContent: "before", ariaPressed: "false",
      title: "B: show what was there before the first edit",
      onclick: () => this.showBefore(!this.before) });
    this.exact = make("button", { textContent: "exact", disabled: true,
      title: "render without the basis what it cannot promise: takes seconds",
      onclick: () => this.link.ask({ exact: true, rest: true }, false) });
    this.kind = make("select", { ariaLabel: "export as",
      title: "glb, mtlx, py: the design; png: the picture; binary, bsdf, npz: the chosen material" },
      ...["glb", "mtlx", "py", "png", "binary", "bsdf", "npz"].map((name) => make("option", {
        value: name, textContent: `.${name}` })));
    const send = make("button", { textContent: "export", title: "for other programs",
      onclick: () => {
        this.news.textContent = "writing ...";
        this.change({ export: `${this.name.value}.${this.kind.value}` }, false);
      } });
    this.news = make("div", { className: "tb-told", role: "status" });
    this.theme = make("button", { title: "what is around the picture",
      onclick: () => this.surround(this.root.dataset.theme === "light" ? "dark" : "light") });
    this.wide = make("button", { textContent: "full screen", title: "F: full screen, and back",
      onclick: () => this.enlarge() });
    this.name = make("input", { type: "text", value: "design", size: 10, ariaLabel: "file" });
    const save = make("button", { textContent: "save",
      onclick: () => this.change({ save: this.name.value }, false) });
    const open = make("button", { textContent: "open",
      onclick: () => this.change({ open: this.name.value }, false) });
    this.query = make("input", { type: "text", ariaLabel: "find a material",
      placeholder: "old brass, shiny < .7", oninput: () => this.find() });
    this.shelf = make("div", { className: "tb-shelf", role: "group", ariaLabel: "materials" });
    this.sliders = make("div", { className: "tb-sliders" });
    this.status = make("div", { className: "tb-status", role: "status" });
    this.said = make("div", { className: "tb-bad", role: "alert" });
    this.history = make("pre", { ariaLabel: "history" });
    const row = (...children) => make("div", { className: "tb-row" }, ...children);
    const named = (text, ...rest) => row(make("label", { textContent: text }), ...rest);
    const soft = (line) => {
      line.classList.add("tb-soft");
      return line;
    };
    const side = this.side = make("div", { className: "tb-side" },
      row(...Object.values(this.tools)),
      named("part", this.parts), named("material", this.library),
      named("find", this.query), this.shelf,
      named("paint", this.where), soft(named("with", this.paintWith, this.colour)),
      this.traitRow = named("trait", this.trait),
      this.materialRow = soft(named("paint with", this.paintMaterial)),
      named("amount", this.amount.input, this.amount.output),
      named("radius", this.radius.input, this.radius.output),
      soft(named("hardness", this.hardness.input, this.hardness.output)),
      soft(named("flow", this.flow.input, this.flow.output)),
      make("label", { title: "a stroke paints only the part on which it begins" },
        this.stay, " stay on one part"),
      row(this.undo, this.redo, this.compare, this.exact), row(this.name, save, open),
      row(this.kind, send), this.news, row(this.theme, this.wide),
      this.layers, make("div", { className: "tb-row", style: "flex-wrap: wrap" }, ...this.tied),
      this.sliders, this.status, this.said, this.history);
    this.choose();
    this.fills = fill;
    this.root = make("div", { className: fill ? "tb tb-whole" : "tb", tabIndex: 0 },
      make("style", { textContent: STYLE }), this.stage, side);
    el.append(this.root);
    this.root.studio = this;
    this.surround(globalThis.matchMedia?.("(prefers-color-scheme: light)").matches && !fill
      ? "light" : "dark");
    this.take("brush");
    this.listen(fill ? document : this.root);
  }

  range(name, min, max, value, step = 0.01) {
    const output = make("output", { textContent: value });
    const input = make("input", { type: "range", min, max, step, value, ariaLabel: name,
      oninput: () => { output.textContent = input.value; } });
    input.value = value;
    return { input, output };
  }

  /** A light or a dark surround; both are neutral, so that colours are judged well. */
  surround(theme) {
    this.root.dataset.theme = theme;
    this.theme.textContent = theme === "light" ? "dark room" : "bright room";
  }

  /** Full screen, and back. */
  enlarge() {
    if (document.fullscreenElement) document.exitFullscreen();
    else this.root.requestFullscreen?.().catch((error) => { this.said.textContent = `${error}`; });
  }

  /** Show the controls of what a stroke does. */
  choose() {
    const local = this.where.value === "local";
    const way = local ? this.paintWith.value : "trait";
    this.side.dataset.where = this.where.value;
    this.traitRow.hidden = way !== "trait";
    this.materialRow.hidden = way !== "material";
    this.colour.hidden = way !== "colour";
    for (const line of [this.traitRow, this.materialRow]) line.style.display = line.hidden ? "none" : "";
  }

  /** Look for materials, once the typing rests. */
  find() {
    clearTimeout(this.finding);
    this.finding = setTimeout(() => this.link.ask({ shelf: { query: this.query.value } }, false),
      RESTS);
  }

  /** Show the materials that were found: a click assigns one, and so does dropping it on a part. */
  async stock({ names, total, side, query }, buffer) {
    if (query !== this.query.value) return;
    const key = JSON.stringify(names);
    if (key !== this.stocked) {
      this.stocked = key;
      this.shelf.replaceChildren(...names.map((name) => make("button", { title: name,
        ariaLabel: name, draggable: true,
        onclick: () => this.change({ assign: { part: this.state.part, material: name } }, false),
        ondragstart: (event) => event.dataTransfer.setData("text/plain", name),
      }, make("canvas", { width: side, height: side }))));
    }
    this.shelf.title = total > names.length ? `the first ${names.length} of ${total}` : "";
    if (!buffer) return;
    const bytes = new Uint8Array(buffer.buffer ?? buffer, buffer.byteOffset ?? 0);
    const strip = await decoded(bytes, "image/jpeg");
    if (key !== this.stocked) return;
    [...this.shelf.children].forEach((button, i) => {
      button.firstChild.getContext("2d").drawImage(strip, side * i, 0, side, side, 0, 0, side, side);
    });
    strip.close();
  }

  /** Do something to the chosen layer. */
  stack(name) {
    if (this.selected === null) return;
    const index = this.selected;
    if (name === "up") this.selected = Math.min(index + 1, this.state.layers.length - 1);
    else if (name === "down") this.selected = Math.max(index - 1, 0);
    else if (name === "duplicate") this.selected = index + 1;
    else if (name === "delete") this.selected = null;
    this.change({ layer: { index, do: name } }, false);
  }

  /** List the layers, the highest first. */
  listLayers(layers) {
    const said = JSON.stringify([layers, this.selected]);
    if (said === this.listed || this.fading) return;
    this.listed = said;
    if (this.selected !== null && this.selected >= layers.length) this.selected = null;
    const rows = layers.map((layer, index) => {
      const set = (values, done = true) => this.change({ layer: { index, set: values, done } });
      const shown = make("input", { type: "checkbox", checked: layer.visible, title: "visible",
        ariaLabel: `layer ${index} visible`, onchange: () => set({ visible: shown.checked }) });
      const fade = make("input", { type: "range", min: 0, max: 1, step: 0.01, title: "opacity",
        ariaLabel: `layer ${index} opacity`, oninput: () => {
          this.fading = true;
          set({ opacity: Number(fade.value) }, false);
        }, onchange: () => {
          this.fading = false;
          set({ opacity: Number(fade.value) });
        } });
      fade.value = layer.opacity;
      const text = make("span", { title: `${layer.effect} on ${layer.parts}; double click to name`,
        textContent: `${layer.local ? "\u2022 " : ""}${layer.name || layer.effect}` });
      const line = make("div", { className: "tb-layer", role: "option" }, shown, text, fade);
      line.setAttribute("aria-selected", String(index === this.selected));
      text.addEventListener("click", () => {
        this.selected = this.selected === index ? null : index;
        this.listLayers(this.state.layers);
      });
      text.addEventListener("dblclick", () => {
        const name = globalThis.prompt?.("name of the layer", layer.name);
        if (name !== null && name !== undefined) set({ name });
      });
      return line;
    });
    this.layers.replaceChildren(...rows.reverse());
    const chosen = this.selected === null ? null : layers[this.selected];
    for (const button of this.tied) {
      const local = ["invert", "clear"].includes(button.textContent);
      button.disabled = !chosen || (local && !chosen.local);
    }
  }

  take(tool) {
    this.tool = tool;
    this.stage.dataset.tool = tool;
    for (const [name, button] of Object.entries(this.tools)) {
      button.setAttribute("aria-pressed", String(name === tool));
    }
  }

  // -- what the hand does --------------------------------------------------------------------

  listen(keys) {
    const on = (target, name, act, options) => {
      target.addEventListener(name, act, options);
      this.undoing.push(() => target.removeEventListener(name, act, options));
    };
    on(this.stage, "contextmenu", (event) => event.preventDefault());
    on(this.picture, "pointerdown", (event) => this.down(event));
    on(this.picture, "pointermove", (event) => this.move(event));
    // where it can be had, the pen is heard at once: "pointermove" waits for the next picture
    this.raw = "onpointerrawupdate" in this.picture;
    if (this.raw) on(this.picture, "pointerrawupdate", (event) => this.stroke(event));
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
      on(this.picture, name, (event) => this.up(event));
    }
    on(document, "fullscreenchange", () => {
      const whole = this.fills || document.fullscreenElement === this.root;
      this.root.classList.toggle("tb-whole", whole);
    });
    on(this.picture, "dragover", (event) => event.preventDefault());
    on(this.picture, "drop", (event) => {
      event.preventDefault();
      const material = event.dataTransfer.getData("text/plain");
      if (material) this.change({ assign: { at: this.place(event), material } }, false);
    });
    on(this.picture, "wheel", (event) => {
      event.preventDefault();
      this.drag({ zoom: Math.exp(-0.001 * event.deltaY) });
      clearTimeout(this.wheeling);
      this.wheeling = setTimeout(() => this.drop(), RESTS);
    }, { passive: false });
    on(keys, "keydown", (event) => this.key(event));
  }

  key(event) {
    const letter = letterOf(event);
    const typing = event.target instanceof HTMLInputElement && event.target.type === "text";
    if (typing) {
      event.stopPropagation();
      return;
    }
    let act = null;
    if ((event.ctrlKey || event.metaKey) && letter === "z") {
      act = () => this.change({ do: event.shiftKey ? "redo" : "undo" }, false);
    } else if ((event.ctrlKey || event.metaKey) && letter === "y") {
      act = () => this.change({ do: "redo" }, false);
    } else if (event.ctrlKey || event.metaKey || event.altKey) return;
    else if (letter === "[" || letter === "]") {
      act = () => this.resize(letter === "]" ? 1.15 : 1 / 1.15);
    } else if (letter === "f" && !event.repeat) act = () => this.enlarge();
    else if (letter === "b" && !event.repeat) act = () => this.showBefore(!this.before);
    else if ("1234".includes(letter)) act = () => this.take(Object.keys(TOOLS)[letter - 1]);
    if (act) {
      event.preventDefault();
      event.stopPropagation();
      act();
    }
  }

  place(event) {
    const box = (this.held && this.box) || this.picture.getBoundingClientRect();
    const scale = this.picture.width / box.width;
    return [(event.clientX - box.left) * scale, (event.clientY - box.top) * scale];
  }

  sample(event, phase) {
    const pressure = event.pointerType === "pen" ? event.pressure : 1;
    return [...this.place(event), phase === 2 ? -1 : pressure, phase, event.timeStamp];
  }

  brush() {
    const brush = { trait: this.trait.value, amount: Number(this.amount.input.value),
      radius: Number(this.radius.input.value), stay: this.stay.checked };
    if (this.where.value !== "local") return brush;
    const way = this.paintWith.value;
    Object.assign(brush, { where: "local", hardness: Number(this.hardness.input.value),
      flow: Number(this.flow.input.value) });
    if (way === "material") brush.material = this.paintMaterial.value;
    if (way === "colour") brush.tint = this.colour.value;
    const chosen = this.selected === null ? null : this.state.layers?.[this.selected];
    if (chosen?.local) brush.onto = this.selected;
    if (way === "eraser") brush.erase = true;
    return brush;
  }

  /** A wider or narrower brush. */
  resize(factor) {
    const { input, output } = this.radius;
    const value = Math.round(input.value * factor) + (factor > 1 ? 1 : -1) * (input.value < 8);
    input.value = Math.min(Math.max(value, input.min), input.max);
    output.textContent = input.value;
    if (this.at) this.moveRing(this.at);
  }

  down(event) {
    this.root.focus({ preventScroll: true });
    // neither a second finger nor the middle button paints
    if (this.held || !this.state || !event.isPrimary || ![0, 2].includes(event.button)) return;
    this.picture.setPointerCapture(event.pointerId);
    this.pointer = event.pointerId;
    const turning = event.button === 2 || this.tool === "orbit";
    this.held = turning ? "orbit" : this.tool;
    this.from = [event.clientX, event.clientY];
    this.box = this.picture.getBoundingClientRect();
    if (this.before) this.showBefore(false);
    if (this.held === "brush") {
      this.pressure = event.pointerType === "pen" ? event.pressure : 1;
      this.newest = this.sample(event, 0);
      this.paint([this.newest]);
    } else if (this.held === "pick") this.change({ pick: this.place(event) });
  }

  move(event) {
    if (this.held && event.pointerId !== this.pointer) return;
    this.moveRing(event);
    if (this.held === "brush") {
      if (!this.raw) this.stroke(event);
    } else if (this.held === "orbit" || this.held === "light") {
      const dx = event.clientX - this.from[0];
      const dy = event.clientY - this.from[1];
      this.from = [event.clientX, event.clientY];
      this.drag(this.held === "light" ? { turn: 0.4 * dx } : { orbit: [-0.4 * dx, 0.4 * dy] });
    }
  }

  stroke(event) {
    if (this.held !== "brush" || event.pointerId !== this.pointer) return;
    const all = event.getCoalescedEvents?.() ?? [];
    this.pressure = event.pointerType === "pen" ? event.pressure : 1;
    const samples = (all.length ? all : [event]).map((one) => this.sample(one, 1));
    this.newest = samples[samples.length - 1];
    this.paint(samples);
  }

  up(event) {
    if (!this.held || event.pointerId !== this.pointer) return;
    if (this.held === "brush") {
      // a pointer that was lost, or taken for a gesture, has no place of its own
      const last = event.type === "pointerup" ? this.sample(event, 2) : [...this.newest];
      last[3] = 2;
      last[2] = this.pressure; // a pen that is lifted presses no more
      this.paint([last]);
    } else if (this.held === "orbit" || this.held === "light") this.drop();
    this.held = null;
  }

  moveRing(event) {
    this.at = { clientX: event.clientX, clientY: event.clientY };
    // while the pen is down nothing moves the picture: asking where it is lays the page out
    const box = this.held ? this.box : this.picture.getBoundingClientRect();
    const radius = (this.radius.input.value * box.width) / this.picture.width;
    const [x, y] = [event.clientX - box.left - radius, event.clientY - box.top - radius];
    if (this.ringed !== radius) {
      this.ring.style.width = this.ring.style.height = `${2 * radius}px`;
      this.ringed = radius;
    }
    this.ring.style.transform = `translate(${x}px, ${y}px)`;
  }

  paint(samples) {
    this.lossless = false;
    this.link.paint(this.brush(), samples);
    this.rest();
  }

  change(header, join = true) {
    if (this.before && !("before" in header)) this.showBefore(false);
    this.said.textContent = "";
    this.lossless = false;
    this.link.ask(header, join);
    this.rest();
  }

  drag(header) {
    this.dragging = true;
    this.change({ ...header, dragging: true });
  }

  drop() {
    this.dragging = false;
    this.change({ dragging: false });
  }

  showBefore(before) {
    this.before = before;
    this.compare.setAttribute("aria-pressed", String(before));
    this.link.ask({ before }, false);
  }

  rest() {
    clearTimeout(this.resting);
    this.resting = setTimeout(() => {
      if (this.held || this.before || this.dragging) return;
      if (this.link.flying || this.link.queue.length) this.rest();
      else if (!this.lossless) this.link.ask({ rest: true });
    }, RESTS);
  }

  slide(trait, slider) {
    const value = Number(slider.input.value);
    if (!this.sliding) {
      this.sliding = { trait, part: this.state.part, start: slider.shown };
    }
    return { part: this.sliding.part, amounts: { [trait]: value - this.sliding.start } };
  }

  // -- what the session says -----------------------------------------------------------------

  hear(header, buffers) {
    if (header.kind === "open") this.link.renew();
    else if (header.kind === "closed") {
      this.said.textContent = header.refused
        ? "refused: open the address that the command printed" : "connection lost: trying again";
    } else if (header.kind === "changed") this.others(header);
    else if (header.view !== this.view) return;
    else if (header.kind === "shelf") this.stock(header, buffers[0]);
    else if (header.kind === "told") {
      this.news.textContent = header.done ? `written: ${header.message}` : "";
      if (!header.done) this.said.textContent = header.message;
    }
    else if (header.kind === "error") {
      this.said.textContent = header.message;
      this.news.textContent = "";
      if (header.seq !== null) this.link.answered(header);
    } else if (header.kind === "frame") {
      if (header.socket && !this.socket) this.connect(header.socket);
      const times = this.link.answered(header); // the next request leaves before this is drawn
      this.drawing = this.drawing.then(() => this.draw(header, buffers[0], times)).catch((error) => {
        this.said.textContent = `${error}`;
      });
    }
  }

  /** A socket that needs no kernel in between: what it cannot do, the kernel's messages do. */
  connect(address) {
    this.socket = new Socket(address, false);
    this.socket.on("msg:custom", (header, buffers) => {
      if (header.kind === "open") {
        this.channel = this.socket;
        Object.assign(this.link, { padding: false, pad: false });
        this.link.renew();
      } else if (header.kind === "closed") {
        if (this.channel !== this.socket) return;
        this.channel = this.model;
        this.link.padding = true;
        this.link.renew();
      } else this.hear(header, buffers);
    });
  }

  others({ by, fraction, ready }) {
    if (by === this.view) return;
    this.lossless = false; // what is seen is out of date
    if (this.state) Object.assign(this.state, { fraction, ready });
    if (this.looking) return;
    this.looking = setTimeout(() => {
      this.looking = null;
      if (!this.held && !this.link.flying && !this.link.queue.length) {
        this.link.ask(this.before ? { before: true } : {});
        this.rest();
      }
    }, OTHERS);
  }

  async draw(header, buffer, times) {
    const { format, x, y, w, h } = header;
    const bytes = buffer && new Uint8Array(buffer.buffer ?? buffer, buffer.byteOffset ?? 0,
      header.bytes);
    if (this.picture.width !== header.width || this.picture.height !== header.height) {
      Object.assign(this.picture, { width: header.width, height: header.height });
      this.root.style.setProperty("--aspect", header.width / header.height);
    }
    if (format === "rgb") {
      this.paper.putImageData(new ImageData(opaque(bytes), w, h), x, y);
    } else if (format !== "none") {
      const bitmap = await decoded(bytes, `image/${format}`);
      this.paper.drawImage(bitmap, x, y);
      bitmap.close();
    }
    this.lossless = format === "png" || (format === "none" && this.lossless);
    const now = performance.now();
    this.drawn.push(now);
    if (this.drawn.length > 240) this.drawn.shift();
    if (times) {
      this.last = { ...times, drawn: times.newest === null ? null : now - times.newest };
      this.times.push({ now, format, ms: header.ms, bytes: header.bytes, ...this.last });
      if (this.times.length > 5000) this.times.shift();
    }
    if (header.parts) {
      this.fill(header);
      this.rest();
    }
    this.update(header.state);
  }

  fill({ parts, traits, library, groups }) {
    const options = (select, names) => {
      const old = select.value;
      select.replaceChildren(...names.map((name) => make("option", { value: name,
        textContent: name || "(edited)" })));
      if (names.includes(old)) select.value = old;
    };
    options(this.parts, parts);
    options(this.library, ["", ...library]);
    options(this.paintMaterial, library);
    options(this.trait, traits);
    if (!this.chosen) this.find();
    if (!this.chosen && traits.includes("shiny")) this.trait.value = "shiny";
    this.chosen = true;
    this.scores = Object.fromEntries(traits.map((trait) => {
      const slider = this.range(trait, -0.5, 1.5, 0);
      slider.input.addEventListener("input", () => {
        this.change({ slide: { ...this.slide(trait, slider), done: false } });
      });
      slider.input.addEventListener("change", () => {
        this.change({ slide: { ...this.slide(trait, slider), done: true } }, true);
        this.sliding = null;
        slider.shown = Number(slider.input.value); // keys come faster than replies
      });
      return [trait, slider];
    }));
    const line = (trait) => make("div", { className: "tb-row" },
      make("label", { textContent: trait }), this.scores[trait].input, this.scores[trait].output);
    this.sliders.replaceChildren(...groups.map(([title, names], i) => make("details",
      { open: i === 0 }, make("summary", { textContent: title }), ...names.map(line))));
  }

  update(state) {
    this.state = { ...this.state, ...state };
    if (this.telling) return;
    const wait = this.held ? this.told + TELLS - performance.now() : 0;
    if (wait > 0) {
      this.telling = setTimeout(() => this.tell(), wait);
    } else this.tell();
  }

  /** Show what the session said; while the hand moves, seldom: laying the page out takes time. */
  tell() {
    this.telling = null;
    this.told = performance.now();
    const { state } = this;
    this.parts.value = state.part;
    this.library.value = state.material;
    for (const [trait, slider] of Object.entries(this.scores ?? {})) {
      if (this.sliding?.trait === trait) continue;
      slider.shown = state.scores[trait];
      const score = slider.shown.toFixed(2);
      if (slider.output.textContent === score) continue;
      slider.input.value = slider.shown;
      slider.output.textContent = score;
    }
    if (state.layers) this.listLayers(state.layers);
    this.undo.disabled = !state.undo;
    this.redo.disabled = !state.redo;
    this.exact.disabled = !state.doubtful.length;
    const lines = (state.history ?? []).join("\n"); // a stroke is told at its end
    if (this.history.textContent !== lines) this.history.textContent = lines;
    if (state.trouble) this.said.textContent = state.trouble;
    this.showStatus();
  }

  showStatus() {
    if (!this.state) return;
    const { error, ready, fraction, plausibility, doubtful } = this.state;
    const now = performance.now();
    const fps = this.drawn.filter((time) => time > now - 1000).length;
    const margin = plausibility.gamut_margin;
    const energy = plausibility.energy_scale;
    const real = energy < 0.995 ? `lowered to ${(100 * energy).toFixed(0)} % to keep energy`
      : margin <= 0.001 ? "at the edge of what is known" : "plausible";
    const share = `${(100 * fraction).toFixed(0)} %`;
    const text = [
      `<b>${fps}</b> fps`,
      this.last?.drawn ? `<b>${this.last.drawn.toFixed(0)}</b> ms to drawn` : "",
      `<span class="${doubtful.length ? "tb-bad" : ""}">error <b>${
        error === null ? "?" : (100 * error).toFixed(2)} %</b></span>`,
      ready ? "" : `<b>draft</b>, preparing ${share}`,
      `<span class="${energy < 0.995 || margin <= 0.001 ? "tb-bad" : ""}">${real}</span>`,
    ].filter(Boolean).join(" &middot; ");
    if (this.status.innerHTML !== text) this.status.innerHTML = text;
  }
}

export default {
  render({ model, el, fill = false }) {
    const canvas = new Canvas(model, el, fill);
    return () => canvas.end();
  },
};
