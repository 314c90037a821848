// The canvas as a page of its own.

import canvas from "./canvas.js";
import { Socket } from "./link.js";

const token = new URLSearchParams(location.search).get("token");
const model = new Socket(`ws://${location.host}/socket?token=${encodeURIComponent(token)}`, true);
canvas.render({ model, el: document.body, fill: true });
