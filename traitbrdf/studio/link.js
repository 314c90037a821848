// What the canvas sends when: it knows no page, so that it can be tested without one. The protocol
// stands in session.py.

const LOST = 20000; // ms after which a request is taken for lost
const CROWD = 8192; // samples of one request, beyond which every other one is left out
const SLOW = 30; // ms of a round trip that no work explains

const sameKeys = (a, b) => JSON.stringify(Object.keys(a)) === JSON.stringify(Object.keys(b));

/** One request in flight; what happens meanwhile is put together into the next. */
export class Link {
  constructor(view, send, {
    now = () => performance.now(), later = (act, ms) => setTimeout(act, ms), padding = true,
    greeting = {},
  } = {}) {
    Object.assign(this, { view, send, now, later, padding, greeting });
    this.queue = []; // of requests that cannot be put together
    this.flying = null;
    this.seq = 0;
    this.slow = 0;
    this.pad = false;
  }

  /** Ask for something; `join` says that it may become one with what waits. */
  ask(header, join = true) {
    const last = this.queue[this.queue.length - 1];
    if (join && last && this.#fits(last.header, header)) {
      for (const [key, value] of Object.entries(header)) {
        if (key === "orbit") last.header.orbit = last.header.orbit
          ? [last.header.orbit[0] + value[0], last.header.orbit[1] + value[1]] : value;
        else if (key === "turn") last.header.turn = (last.header.turn ?? 0) + value;
        else if (key === "zoom") last.header.zoom = (last.header.zoom ?? 1) * value;
        else last.header[key] = value;
      }
    } else this.queue.push({ header: { ...header }, samples: [], newest: null });
    this.pump();
  }

  #fits(old, fresh) {
    // a stroke, a slider and a command are obeyed one after the other
    const kinds = ["brush", "slide", "layer", "assign", "do", "save", "open", "pick", "hello",
      "shelf", "export"];
    const had = kinds.filter((kind) => kind in old);
    const has = kinds.filter((kind) => kind in fresh);
    if (!had.length || !has.length) return !("hello" in old || "hello" in fresh);
    if (had.length > 1 || had[0] !== has[0]) return false;
    if (had[0] === "brush") return JSON.stringify(old.brush) === JSON.stringify(fresh.brush);
    if (had[0] === "layer") {
      return "set" in old.layer && "set" in fresh.layer && !old.layer.done
        && old.layer.index === fresh.layer.index && sameKeys(old.layer.set, fresh.layer.set);
    }
    return had[0] === "slide" && !old.slide.done && old.slide.part === fresh.slide.part
      && sameKeys(old.slide.amounts, fresh.slide.amounts);
  }

  /** Samples [x, y, pressure, phase, time] of the brush. */
  paint(brush, samples) {
    this.#hold = true;
    this.ask({ brush });
    this.#hold = false;
    const last = this.queue[this.queue.length - 1];
    for (const [x, y, pressure, phase, time] of samples) {
      last.samples.push(x, y, pressure, phase);
      last.newest = time ?? this.now();
    }
    if (last.samples.length > 4 * CROWD) {
      const kept = [];
      for (let i = 0; i < last.samples.length; i += 4) {
        const moved = last.samples[i + 3] === 1;
        if (!moved || (i / 4) % 2) kept.push(...last.samples.slice(i, i + 4));
      }
      last.samples = kept;
    }
    this.pump();
  }

  #hold = false;

  pump() {
    if (this.flying || this.#hold || !this.queue.length) return;
    const { header, samples, newest } = this.queue.shift();
    const seq = ++this.seq;
    this.flying = { seq, sent: this.now(), newest };
    const kind = "hello" in header ? "hello" : "input";
    const message = { kind, view: this.view, seq, ...header };
    delete message.hello;
    if (this.pad) message.pad = true;
    if (kind === "hello") Object.assign(message, this.greeting);
    this.later(() => {
      if (this.flying?.seq === seq) this.renew();
    }, LOST);
    this.send(message, samples.length ? [new Float32Array(samples).buffer] : []);
  }

  /** Take the reply to the request in flight; its times, or null if it is the reply to another. */
  answered(header) {
    const flown = this.flying;
    if (!flown || header.seq !== flown.seq) return null;
    this.flying = null;
    const trip = this.now() - flown.sent;
    const work = Object.values(header.ms ?? {}).reduce((a, b) => a + b, 0);
    this.slow = header.ms && trip - work > SLOW ? this.slow + 1 : 0;
    this.pad ||= this.padding && this.slow >= 4;
    this.pump();
    return { trip, work, newest: flown.newest };
  }

  /** Begin anew: the other side may have forgotten, or be another. */
  renew() {
    this.flying = null;
    this.queue = this.queue.filter(({ header }) => !("hello" in header));
    this.queue.unshift({ header: { hello: true }, samples: [], newest: null });
    this.pump();
  }
}

const encoder = new TextEncoder();
const decoder = new TextDecoder();

/** What a notebook's widget manager does for the canvas, over one WebSocket (see page.py). */
export class Socket {
  constructor(address, lasting) {
    Object.assign(this, { address, lasting });
    this.listeners = new Set();
    this.open();
  }

  open() {
    try {
      this.socket = new WebSocket(this.address);
    } catch { // a page may forbid them
      this.socket = null;
      queueMicrotask(() => this.tell({ kind: "closed", refused: false }, []));
      return;
    }
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => {
      const length = new DataView(data).getUint32(0, true);
      const header = JSON.parse(decoder.decode(new Uint8Array(data, 4, length)));
      const rest = data.byteLength - 4 - length;
      this.tell(header, rest ? [new DataView(data, 4 + length, rest)] : []);
    };
    this.socket.onopen = () => this.tell({ kind: "open" }, []);
    this.socket.onclose = ({ code }) => {
      this.tell({ kind: "closed", refused: code === 4403 || code === 1006 && !this.greeted }, []);
      if (this.greeted && this.lasting) setTimeout(() => this.open(), 1000);
    };
  }

  tell(header, buffers) {
    if (header.kind === "frame") this.greeted = true;
    for (const listener of this.listeners) listener(header, buffers);
  }

  on(name, listener) {
    if (name === "msg:custom") this.listeners.add(listener);
  }

  off(name, listener) {
    this.listeners.delete(listener);
  }

  send(header, callbacks, buffers = []) {
    if (this.socket?.readyState !== 1) return; // 1: open
    const head = encoder.encode(JSON.stringify(header));
    const body = buffers.length ? new Uint8Array(buffers[0]) : new Uint8Array(0);
    const message = new Uint8Array(4 + head.length + body.length);
    new DataView(message.buffer).setUint32(0, head.length, true);
    message.set(head, 4);
    message.set(body, 4 + head.length);
    this.socket.send(message);
  }

  close() {
    this.lasting = false;
    this.socket?.close();
  }
}

/** The letter of a key; by its place where the keyboard's own letters are not Latin. */
export function letterOf({ key, code = "" }) {
  const letter = key.toLowerCase();
  if (letter.length > 1 || /^[\x20-\x7e]$/.test(letter)) return letter;
  const places = { BracketLeft: "[", BracketRight: "]" };
  return places[code] ?? /^(?:Key|Digit)(.)$/.exec(code)?.[1].toLowerCase() ?? letter;
}

/** RGBA bytes of RGB ones. */
export function opaque(rgb) {
  const out = new Uint8ClampedArray((rgb.length / 3) * 4);
  for (let i = 0, k = 0; i < rgb.length; i += 3, k += 4) {
    out[k] = rgb[i];
    out[k + 1] = rgb[i + 1];
    out[k + 2] = rgb[i + 2];
    out[k + 3] = 255;
  }
  return out;
}
