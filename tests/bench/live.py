"""Painting in a browser: frames a second, and from the pointer to the drawn canvas.

``python tests/bench/live.py --out out/live`` drives Debian's chromium through its DevTools, without
anything between: the page of `traitbrdf studio`, then a real JupyterLab, 512x512 teapot with
shadows. It prints what the canvas itself measured while a hand painted at 125 Hz, and leaves a
screenshot of each.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import itertools
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from websockets.sync.client import connect

sys.path.insert(0, str(Path(__file__).parents[1]))

from chrome import CHROMIUM, FLAGS, KERNEL_IDLE, RUN_ALL, STUDIO, jupyter_lab, write_notebook

import traitbrdf as tb
from traitbrdf.bench.datasets import default_data
from traitbrdf.design.strokes import follow
from traitbrdf.studio.page import Server
from traitbrdf.studio.session import Session

SECONDS = 8.0
RATE = 125.0


class Tab:
    """One tab of a chromium, by its DevTools' socket."""

    def __enter__(self) -> Tab:
        return self

    def __exit__(self, *failure: object) -> None:
        self._open.close()

    def __init__(self, port: int, address: str) -> None:
        request = urllib.request.Request(
            f"http://127.0.0.1:{port}/json/new?{address}", method="PUT"
        )
        with urllib.request.urlopen(request) as answer:
            target = json.load(answer)
        address = target["webSocketDebuggerUrl"]
        self._open = contextlib.ExitStack()
        self._socket = self._open.enter_context(connect(address, max_size=None))
        self._count = itertools.count(1)
        self.ask("Page.enable")
        self.ask("Emulation.setFocusEmulationEnabled", enabled=True)

    def tell(self, method: str, **arguments: Any) -> int:
        number = next(self._count)
        self._socket.send(json.dumps({"id": number, "method": method, "params": arguments}))
        return number

    def ask(self, method: str, **arguments: Any) -> Any:
        number = self.tell(method, **arguments)
        while True:
            message = json.loads(self._socket.recv())
            if message.get("id") == number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]

    def evaluate(self, expression: str) -> Any:
        result = self.ask("Runtime.evaluate", expression=expression, returnByValue=True)
        if "exceptionDetails" in result:
            raise RuntimeError(f"{expression}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def until(self, expression: str, seconds: float = 180.0) -> None:
        deadline = time.monotonic() + seconds
        while not self.evaluate(f"!!({expression})"):
            if time.monotonic() > deadline:
                raise TimeoutError(expression)
            time.sleep(0.1)

    def screenshot(self, path: Path) -> None:
        picture = self.ask("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(picture["data"]))


@contextlib.contextmanager
def chromium() -> Iterator[int]:
    """A headless chromium; yields the port of its DevTools."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as home:
        command = [
            str(CHROMIUM), "--headless=new", *FLAGS, "--remote-debugging-port=0",
            "--remote-allow-origins=*", f"--user-data-dir={home}", "--window-size=1100,800",
            "about:blank",
        ]  # fmt: skip
        browser = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port = Path(home) / "DevToolsActivePort"
            for _ in range(300):
                if port.exists() and port.read_text().strip():
                    break
                time.sleep(0.1)
            yield int(port.read_text().split()[0])
        finally:
            browser.terminate()
            browser.wait(20)


def scene() -> tb.Scene:
    data = default_data()
    environment = (
        tb.EnvironmentMap.sky()
        if data is None
        else tb.EnvironmentMap.read(data / "envmaps" / "forest.exr")
    )
    camera = tb.Camera.orbit(-35, 20, zoom=1.05)
    return tb.Scene(tb.teapot(), environment, camera=camera, size=512, ground=True)


CELL = """import sys
import traitbrdf as tb
sys.path.insert(0, {folder!r})
from live import scene
edit = tb.EditSession(scene())
edit.assign(list(edit.scene.shape.parts), "red-rubber")
edit.prepare()
tb.studio(edit)"""


def serve() -> None:
    """The page of a session like that of the notebook; says its address."""
    edit = tb.EditSession(scene())
    edit.assign(list(edit.scene.shape.parts), "red-rubber")
    edit.prepare()
    server = Server(Session(edit))
    thread = threading.Thread(target=server.run)
    thread.start()
    print(server.url, flush=True)
    sys.stdin.read()
    server.stop()
    thread.join(30.0)


@contextlib.contextmanager
def page() -> Iterator[str]:
    """`serve` in a process of its own, as a user has it; yields its address."""
    command = [sys.executable, __file__, "--serve"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdin is not None and server.stdout is not None
        yield server.stdout.readline().strip()
        server.stdin.close()


class Hand:
    """A mouse on the canvas, to and fro along a path."""

    def __init__(self, tab: Tab, path: np.ndarray) -> None:
        self.tab, self.path = tab, path
        self.left, self.top, self.scale = tab.evaluate(
            "(() => { const c = document.querySelector('.tb-stage canvas');"
            " const b = c.getBoundingClientRect(); return [b.left, b.top, b.width / c.width]; })()"
        )

    def press(self, index: int) -> None:
        self._dispatch(index, type="mousePressed", clickCount=1)

    def move(self, index: int) -> None:
        self._dispatch(index, type="mouseMoved", buttons=1)

    def lift(self, index: int) -> None:
        self._dispatch(index, type="mouseReleased", clickCount=1)

    def _dispatch(self, index: int, **event: Any) -> None:
        at = index % (2 * len(self.path) - 2)
        x, y = self.path[at if at < len(self.path) else 2 * len(self.path) - 2 - at]
        place = {"x": self.left + x * self.scale, "y": self.top + y * self.scale}
        self.tab.tell("Input.dispatchMouseEvent", button="left", **event, **place)


def paint(tab: Tab, path: np.ndarray) -> dict[str, float]:
    """Strokes to and fro along a path for some seconds; what the canvas measured meanwhile."""
    tab.until(f"{STUDIO}?.state?.ready")
    tab.evaluate(f"{STUDIO}.root.scrollIntoView()")
    time.sleep(1.0)
    tab.evaluate(f"{STUDIO}.times.splice(0), Object.assign({STUDIO}.radius.input, {{value: 60}})")
    hand = Hand(tab, path)
    start = time.perf_counter()
    index, held = 0, False
    while (now := time.perf_counter() - start) < SECONDS:
        if index % 32 == 0:  # a new stroke about every quarter of a second
            if held:
                hand.lift(index)
            sign = 1 if (index // 32) % 2 else -1
            amount = f"Object.assign({STUDIO}.amount.input, {{value: {0.6 * sign}}})"
            tab.tell("Runtime.evaluate", expression=amount)
            hand.press(index)
            held = True
        else:
            hand.move(index)
        index += 1
        time.sleep(max(0.0, index / RATE - now))
    hand.lift(index)
    times = tab.evaluate(
        f"{STUDIO}.times.filter(t => t.drawn !== null).map(t => [t.now, t.drawn, t.trip, t.work,"
        " t.format === 'none' ? 0 : 1, t.bytes])"
    )
    rows = np.array(times)[5:]  # the first ones warm up
    shown = rows[rows[:, 4] > 0]
    return {
        "fps": (len(shown) - 1) / (shown[-1, 0] - shown[0, 0]) * 1e3,
        "drawn": float(np.median(shown[:, 1])),
        "late": float(np.quantile(shown[:, 1], 0.95)),
        "trip": float(np.median(rows[:, 2])),
        "work": float(np.median(rows[:, 3])),
        "kilobytes": float(np.median(shown[:, 5])) / 1e3,
        "error": float(tab.evaluate(f"{STUDIO}.state.error")),
        "padded": bool(tab.evaluate(f"{STUDIO}.link.pad")),
    }


def show(tab: Tab, path: np.ndarray, picture: Path) -> None:
    """A picture of one stroke alone: what was painted for the clock's sake is undone."""
    idle = f"!{STUDIO}.link.flying && !{STUDIO}.link.queue.length"
    tab.until(idle)
    for _ in range(int(tab.evaluate(f"{STUDIO}.state.edits")) - 1):
        tab.evaluate(f"{STUDIO}.change({{do: 'undo'}}, false)")
    tab.until(f"{STUDIO}.state.edits === 1 && {idle}")
    for name, value in (("amount", 0.6), ("radius", 60)):
        moved = f"Object.assign({STUDIO}.{name}.input, {{value: {value}}})"
        tab.evaluate(f"{moved}.dispatchEvent(new Event('input'))")
    hand = Hand(tab, path)
    hand.press(0)
    for index in range(1, len(path)):
        hand.move(index)
        time.sleep(1.0 / RATE)
    hand.lift(len(path) - 1)
    tab.until(f"{STUDIO}.lossless && {STUDIO}.state.edits === 2")
    time.sleep(1.0)
    tab.screenshot(picture)


def tell(name: str, found: dict[str, float], fps: float, drawn: float) -> None:
    met = "met" if found["fps"] >= fps and found["drawn"] <= drawn else "MISSED"
    print(
        f"{name:11s} {found['fps']:5.1f} fps (asked {fps:.0f}), newest sample to drawn "
        f"{found['drawn']:.1f} ms median (asked {drawn:.0f}), {found['late']:.1f} ms at the 95th "
        f"percentile: {met}; round trip {found['trip']:.1f} ms, of which work {found['work']:.1f}; "
        f"{found['kilobytes']:.0f} kB a frame, frame error {100 * found['error']:.2f} %"
        + (", padded" if found["padded"] else ""),
        flush=True,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("out/live"))
    parser.add_argument("--serve", action="store_true", help="the page alone, until stdin ends")
    given = parser.parse_args()
    if given.serve:
        serve()
        return 0
    if CHROMIUM is None:
        print("live: chromium is not installed", file=sys.stderr)
        return 1
    given.out.mkdir(parents=True, exist_ok=True)
    shown = scene()
    line, _ = follow(shown.part_image == shown.parts.index("handle"))
    # about 3 pixels a sample: a hand in a hurry
    steps = [
        np.linspace(a, b, max(2, round(math.dist(a, b) / 3.0)), endpoint=False)
        for a, b in itertools.pairwise(line)
    ]
    path = np.concatenate(steps)
    print(f"512x512 teapot with shadows, {os.cpu_count()} cores, painting for {SECONDS:.0f} s")
    with chromium() as port:
        with page() as address, Tab(port, address) as tab:
            tell("page", paint(tab, path), 60.0, 25.0)
            show(tab, path, given.out / "page.png")
            tab.tell("Page.close")
        data = default_data()
        shared = {} if data is None else {"TRAITBRDF_SHARED": str(data.resolve())}
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            cell = CELL.format(folder=str(Path(__file__).parent))
            write_notebook(Path(folder) / "live.ipynb", cell)
            with (
                jupyter_lab(Path(folder), **shared) as address,
                Tab(port, f"{address}/lab/tree/live.ipynb") as tab,
            ):
                tab.until(KERNEL_IDLE)
                tab.evaluate(RUN_ALL)
                tell("JupyterLab", paint(tab, path), 30.0, 50.0)
                # as where browser and kernel are on two machines
                tab.evaluate(f"{STUDIO}.socket.close()")
                tab.until(f"{STUDIO}.channel === {STUDIO}.model")
                tell("its kernel", paint(tab, path), 30.0, 50.0)
                show(tab, path, given.out / "lab.png")
    print(f"screenshots: {given.out}/page.png and {given.out}/lab.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
