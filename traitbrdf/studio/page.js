// What a notebook's widget manager does for canvas.js, over one WebSocket.

import canvas from "./canvas.js";

const text = new TextEncoder();
const words = new TextDecoder();

class Model {
  constructor(address) {
    this.address = address;
    this.listeners = new Set();
    this.open();
  }

  open() {
    this.socket = new WebSocket(this.address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => {
      const length = new DataView(data).getUint32(0, true);
      const header = JSON.parse(words.decode(new Uint8Array(data, 4, length)));
      const rest = data.byteLength - 4 - length;
      this.tell(header, rest ? [new DataView(data, 4 + length, rest)] : []);
    };
    this.socket.onopen = () => this.tell({ kind: "open" }, []);
    this.socket.onclose = ({ code }) => {
      this.tell({ kind: "closed", refused: code === 4403 || code === 1006 && !this.greeted }, []);
      if (this.greeted) setTimeout(() => this.open(), 1000);
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
    if (this.socket.readyState !== WebSocket.OPEN) return;
    const head = text.encode(JSON.stringify(header));
    const body = buffers.length ? new Uint8Array(buffers[0]) : new Uint8Array(0);
    const message = new Uint8Array(4 + head.length + body.length);
    new DataView(message.buffer).setUint32(0, head.length, true);
    message.set(head, 4);
    message.set(body, 4 + head.length);
    this.socket.send(message);
  }
}

const token = new URLSearchParams(location.search).get("token");
const model = new Model(`ws://${location.host}/socket?token=${encodeURIComponent(token)}`);
canvas.render({ model, el: document.body, fill: true });
