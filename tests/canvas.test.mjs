// The canvas's link, without a page: `node --test tests/canvas.test.mjs`.

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import test from "node:test";

const file = new URL("../traitbrdf/studio/link.js", import.meta.url);
const source = await readFile(file, "utf8");
const { Link, Socket, letterOf, opaque } = await import(`data:text/javascript,${encodeURIComponent(source)}`);

const BRUSH = { trait: "shiny", amount: 0.5, radius: 20 };

function linked() {
  const sent = [];
  const waiting = [];
  let time = 0;
  const link = new Link("v", (header, buffers) => sent.push({ header, buffers }), {
    now: () => time, later: (act, ms) => waiting.push({ act, at: time + ms }),
  });
  const reply = (ms = 5, work = {}) => {
    time += ms;
    return link.answered({ seq: link.flying.seq, ms: work });
  };
  const pass = (ms) => {
    time += ms;
    for (const { act, at } of waiting.splice(0)) if (at <= time) act(); else waiting.push({ act, at });
  };
  return { link, sent, reply, pass };
}

test("one request is in flight, the rest is put together", () => {
  const { link, sent, reply } = linked();
  link.ask({ hello: true });
  for (let i = 0; i < 100; i++) link.paint(BRUSH, [[i, 0, 1, i ? 1 : 0, i]]);
  assert.equal(sent.length, 1);
  assert.deepEqual(sent[0].header, { kind: "hello", view: "v", seq: 1 });
  reply();
  assert.equal(sent.length, 2);
  assert.equal(sent[1].header.kind, "input");
  const values = new Float32Array(sent[1].buffers[0]);
  assert.equal(values.length, 400);
  assert.deepEqual([...values.slice(-4)], [99, 0, 1, 1]);
  assert.equal(reply().newest, 99);
  assert.equal(sent.length, 2);
});

test("keys are known by their letter, or by their place on other keyboards", () => {
  assert.equal(letterOf({ key: "z", code: "KeyW" }), "z"); // a French keyboard
  assert.equal(letterOf({ key: "Z", code: "KeyZ" }), "z");
  for (const [key, code, letter] of [["я", "KeyZ", "z"], ["н", "KeyY", "y"], ["ζ", "KeyZ", "z"],
    ["ז", "KeyZ", "z"], ["и", "KeyB", "b"], ["х", "BracketLeft", "["], ["１", "Digit1", "1"]]) {
    assert.equal(letterOf({ key, code }), letter);
  }
  assert.equal(letterOf({ key: "Enter", code: "Enter" }), "enter");
  assert.equal(letterOf({ key: "é" }), "é");
});

test("a page that forbids sockets says so and goes on", async () => {
  const old = globalThis.WebSocket;
  globalThis.WebSocket = class {
    constructor() {
      throw new Error("forbidden");
    }
  };
  const heard = [];
  try {
    const socket = new Socket("ws://127.0.0.1:1/socket", true);
    socket.on("msg:custom", (header) => heard.push(header));
    socket.send({ kind: "input" });
    await new Promise((resolve) => setTimeout(resolve, 10));
    socket.close();
  } finally {
    globalThis.WebSocket = old;
  }
  assert.deepEqual(heard, [{ kind: "closed", refused: false }]);
});

test("drags add up, sliders and choices are replaced", () => {
  const { link, sent, reply } = linked();
  link.ask({ part: "lid" });
  link.ask({ orbit: [1, 2] });
  link.ask({ orbit: [3, -1] });
  link.ask({ turn: 5 });
  link.ask({ turn: 6, zoom: 2 });
  link.ask({ zoom: 1.5 });
  link.ask({ slide: { part: "lid", amounts: { red: 0.1 }, done: false } });
  link.ask({ slide: { part: "lid", amounts: { red: 0.2 }, done: true } });
  reply();
  assert.equal(sent.length, 2);
  const { orbit, turn, zoom, slide } = sent[1].header;
  assert.deepEqual([orbit, turn, zoom], [[4, 1], 11, 3]);
  assert.deepEqual(slide, { part: "lid", amounts: { red: 0.2 }, done: true });
});

test("what cannot be put together keeps its order", () => {
  const { link, sent, reply } = linked();
  link.ask({ hello: true });
  link.paint(BRUSH, [[1, 1, 1, 0, 0], [1, 1, 1, 2, 1]]);
  link.ask({ do: "undo" }, false);
  link.ask({ do: "undo" }, false);
  link.paint({ ...BRUSH, trait: "red" }, [[2, 2, 1, 0, 2]]);
  link.paint(BRUSH, [[3, 3, 1, 0, 3]]);
  link.ask({ slide: { part: "lid", amounts: { red: 0.2 }, done: true } });
  link.ask({ slide: { part: "lid", amounts: { blue: 0.1 }, done: false } });
  const seen = [];
  while (link.flying) {
    const { header } = sent[sent.length - 1];
    seen.push(header.do ?? header.brush?.trait ?? Object.keys(header.slide?.amounts ?? {})[0] ?? header.kind);
    reply();
  }
  assert.deepEqual(seen, ["hello", "shiny", "undo", "undo", "red", "shiny", "red", "blue"]);
});

test("a crowd of samples is thinned, ends are kept", () => {
  const { link, sent, reply } = linked();
  link.ask({ hello: true });
  link.paint(BRUSH, [[0, 0, 1, 0, 0]]);
  for (let i = 0; i < 10000; i++) link.paint(BRUSH, [[i, 1, 1, 1, i]]);
  link.paint(BRUSH, [[7, 7, 1, 2, 10001]]);
  reply();
  const values = new Float32Array(sent[1].buffers[0]);
  assert.ok(values.length <= 4 * 8194 && values.length > 4 * 2000);
  assert.equal(values[3], 0);
  assert.equal(values[values.length - 1], 2);
  assert.ok(values.byteLength < 1 << 20);
});

test("a lost request is not waited for forever", () => {
  const { link, sent, reply, pass } = linked();
  link.ask({ part: "lid" });
  link.ask({ do: "undo" }, false);
  pass(25000);
  assert.deepEqual(sent.map(({ header }) => header.kind), ["input", "hello"]);
  assert.equal(link.answered({ seq: 1 }), null); // too late
  reply();
  assert.equal(sent[2].header.do, "undo");
  reply();
  pass(60000);
  assert.equal(sent.length, 3);
});

test("a slow channel is padded, slow work is not", () => {
  const { link, sent, reply } = linked();
  for (let i = 0; i < 8; i++) {
    link.ask({ part: "lid" });
    reply(100, { render: 95 });
  }
  assert.equal(link.pad, false);
  for (let i = 0; i < 4; i++) {
    link.ask({ part: "lid" });
    reply(50, { render: 8 });
  }
  assert.equal(link.pad, true);
  link.ask({ part: "lid" });
  assert.equal(sent[sent.length - 1].header.pad, true);
});

test("errors end a flight as frames do", () => {
  const { link, sent } = linked();
  link.ask({ part: "lid" });
  link.ask({ do: "redo" }, false);
  link.answered({ kind: "error", seq: 1 });
  assert.equal(sent.length, 2);
});

test("pixels are made opaque", () => {
  assert.deepEqual([...opaque(new Uint8Array([1, 2, 3, 4, 5, 6]))], [1, 2, 3, 255, 4, 5, 6, 255]);
});
