"""The live canvas in a real browser: the local page, and a real JupyterLab."""

from __future__ import annotations

import contextlib
import threading
import time

import numpy as np
import pytest
from chrome import CHROMIUM, FLAGS, KERNEL_IDLE, RUN_ALL, STUDIO, jupyter_lab, write_notebook

import traitbrdf as tb
from traitbrdf.design.strokes import follow
from traitbrdf.session import preparation
from traitbrdf.studio.page import Server
from traitbrdf.studio.session import Session

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed"),
    # a browser's driver leaves its pipes to the collector
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

# pixels outside an edit are compared to the bit: so large an error leaves no part to become exact
SCENE = (
    "scene = tb.Scene(tb.teapot(8), tb.EnvironmentMap.sky(rows=32), "
    "camera=tb.Camera.orbit(-35, 20, zoom=1.05), size=192, ground=True)\n"
    "edit = tb.EditSession(scene, 'preview', cache=False, error=1.0)\n"
    "edit.assign(list(scene.shape.parts), 'red-rubber')\n"
)


def example():
    """The scene that the notebook has as well."""
    names: dict[str, object] = {"tb": tb}
    exec(SCENE, names)
    return names["edit"]


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def page(browser):
    context = browser.new_context(viewport={"width": 1100, "height": 800})
    page = context.new_page()
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    yield page
    context.close()
    assert [t for t in troubles if "studio" in t or "canvas" in t] == []


class Driver:
    """A hand, and eyes, on the canvas of a page."""

    def __init__(self, page, scene):
        self.page, self.scene = page, scene

    def until(self, expression, seconds=120.0):
        deadline = time.monotonic() + seconds
        while not self.page.evaluate(f"!!({expression})"):
            assert time.monotonic() < deadline, f"never: {expression}"
            time.sleep(0.05)

    def settled(self):
        """Until all is sent and shown, without loss."""
        self.until(f"{STUDIO}?.state?.ready")
        self.until(f"{STUDIO}.lossless && !{STUDIO}.link.flying && !{STUDIO}.link.queue.length")

    def state(self):
        return self.page.evaluate(f"{STUDIO}.state")

    def pixels(self):
        self.settled()
        height, width = self.scene.height, self.scene.width
        values = self.page.evaluate(
            f"[...{STUDIO}.paper.getImageData(0, 0, {width}, {height}).data]"
        )
        return np.array(values, np.uint8).reshape(height, width, 4)[..., :3]

    def stroke(self, points):
        box = self.page.locator(".tb-stage canvas").bounding_box()
        scale = box["width"] / self.scene.width
        places = [(box["x"] + x * scale, box["y"] + y * scale) for x, y in points]
        self.page.mouse.move(*places[0])
        self.page.mouse.down()
        for place in places[1:]:
            self.page.mouse.move(*place, steps=3)
        self.page.mouse.up()

    def pen(self, points, force):
        """A stroke of a pen that is pressed with `force`."""
        box = self.page.locator(".tb-stage canvas").bounding_box()
        scale = box["width"] / self.scene.width
        tools = self.page.context.new_cdp_session(self.page)
        kinds = ["mousePressed"] + ["mouseMoved"] * (len(points) - 2) + ["mouseReleased"]
        for kind, (x, y) in zip(kinds, points, strict=True):
            tools.send("Input.dispatchMouseEvent", {
                "type": kind, "x": box["x"] + x * scale, "y": box["y"] + y * scale,
                "button": "left", "buttons": 1, "clickCount": 1, "pointerType": "pen",
                "force": force if kind != "mouseReleased" else 0.0,
            })  # fmt: skip
        tools.detach()

    def press(self, keys):
        self.page.locator(".tb-stage canvas").hover()
        self.page.evaluate(f"{STUDIO}.root.focus()")
        self.page.keyboard.press(keys)

    def edits(self, count):
        self.until(f"{STUDIO}.state.edits === {count}", 30.0)


def along(scene, part):
    return follow(scene.part_image == scene.parts.index(part))[0]


def paint_and_more(driver, folder):
    """What a designer does, by mouse and keys."""
    page, scene = driver.page, driver.scene
    before = driver.pixels()
    assert driver.state()["edits"] == 1
    driver.stroke(along(scene, "handle"))
    driver.edits(2)
    after = driver.pixels()
    state = driver.state()
    assert state["part"] == "handle"
    assert "only='handle'" in state["history"][-1]
    inside = np.zeros(scene.height * scene.width, bool)
    inside[scene.pixels[scene.part_slice(scene.parts.index("handle"))]] = True
    changed = (before != after).any(axis=-1).reshape(-1)
    assert changed[inside].mean() > 0.5
    assert not changed[~inside].any()
    # a slider of the part that was painted
    slider = page.locator(".tb-sliders input[aria-label=bright]")
    slider.fill(f"{min(state['scores']['bright'] + 0.2, 1.5):.2f}")
    driver.until(f"{STUDIO}.state.scores.bright > {state['scores']['bright'] + 0.03}")
    driver.settled()
    assert "edit.move('handle', bright=" in driver.state()["history"][-1]
    moved = driver.pixels()
    assert not (moved != after).any(axis=-1).reshape(-1)[~inside].any()
    # the same slider by the keyboard: no shortcut of whatever is around takes the keys
    count = driver.state()["edits"]
    score = driver.state()["scores"]["bright"]
    slider.focus()
    for _ in range(8):
        page.keyboard.press("ArrowDown")
    driver.until(f"{STUDIO}.state.scores.bright < {score - 0.03}")
    driver.settled()
    assert driver.state()["edits"] > count
    assert driver.state()["part"] == "handle"
    # back by keys, and forth
    count = driver.state()["edits"]
    for _ in range(count - 1):
        driver.press("Control+z")
    driver.edits(1)
    np.testing.assert_array_equal(driver.pixels(), before)
    driver.press("Control+Shift+z")
    driver.edits(2)
    np.testing.assert_array_equal(driver.pixels(), after)
    # what was there before is shown, not done
    driver.press("b")
    driver.until(f"{STUDIO}.before && !{STUDIO}.link.flying")
    driver.press("b")
    driver.until(f"!{STUDIO}.before && !{STUDIO}.link.flying")
    driver.edits(2)
    # a design is saved, and opened again
    page.locator(".tb input[aria-label=file]").fill("mine")
    page.locator(".tb").get_by_role("button", name="save", exact=True).click()
    driver.until(f"!{STUDIO}.link.flying && !{STUDIO}.link.queue.length")
    assert (folder / "mine.tbr").is_file()
    driver.press("Control+z")
    driver.edits(1)
    page.locator(".tb").get_by_role("button", name="open", exact=True).click()
    driver.edits(2)
    opened = driver.pixels()
    assert np.abs(opened.astype(int) - after).mean() < 1.0
    # the camera turns by dragging, and the new view is prepared
    page.locator(".tb").get_by_role("button", name="orbit").click()
    driver.stroke([(60.0, 60.0), (90.0, 60.0)])
    driver.until(f"!{STUDIO}.state.ready")
    turned = driver.pixels()
    assert np.abs(turned.astype(int) - opened).mean() > 2.0
    # so does the map
    page.locator(".tb").get_by_role("button", name="light").click()
    driver.stroke([(60.0, 60.0), (140.0, 60.0)])
    driver.until(f"!{STUDIO}.state.ready")
    relit = driver.pixels()
    assert np.abs(relit.astype(int) - turned).mean() > 1.0
    assert "fps" in page.locator(".tb-status").inner_text()
    assert "error" in page.locator(".tb-status").inner_text()
    return relit


def test_the_page(page, tmp_path, training, monkeypatch):
    monkeypatch.setattr(preparation, "training_of", lambda library, seed: training)
    edit = example()
    session = Session(edit, tmp_path)
    server = Server(session)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        page.goto(server.url)
        driver = Driver(page, edit.scene)
        shown = paint_and_more(driver, tmp_path)
        page.reload()
        np.testing.assert_array_equal(driver.pixels(), shown)
        assert driver.state()["edits"] == 2
        # the very pixels of the frame
        frame = session.edit.render(exact=False)
        np.testing.assert_array_equal(driver.pixels(), session.display(frame))
        # a second tab shows the same, and what the first does next
        second = page.context.new_page()
        second.goto(server.url)
        other = Driver(second, edit.scene)
        np.testing.assert_array_equal(other.pixels(), shown)
        page.bring_to_front()
        driver.stroke(along(session.edit.scene, "lid"))
        driver.edits(3)
        other.edits(3)
        np.testing.assert_array_equal(other.pixels(), driver.pixels())
        driver.press("Control+z")
        driver.edits(2)
        np.testing.assert_array_equal(driver.pixels(), shown)
        # a part is picked by a click
        driver.press("2")
        x, y = along(session.edit.scene, "spout")[0]
        driver.stroke([(x, y), (x, y)])
        driver.until(f"{STUDIO}.state.part === 'spout'")
        # a pen that is pressed harder does more
        driver.press("1")
        line = along(session.edit.scene, "body")
        amounts = []
        for force in (0.2, 0.9):
            driver.pen(line, force)
            driver.edits(3)
            amounts.append(session.edit.history[-1].split("amount=")[1].split(",")[0])
            driver.press("Control+z")
            driver.edits(2)
        assert 0.0 < 3.0 * float(amounts[0]) < float(amounts[1])
        # a tab that is closed in the middle of a stroke leaves what it painted
        second.bring_to_front()
        box = second.locator(".tb-stage canvas").bounding_box()
        scale = box["width"] / other.scene.width
        line = along(session.edit.scene, "spout")
        second.mouse.move(box["x"] + line[0][0] * scale, box["y"] + line[0][1] * scale)
        second.mouse.down()
        second.mouse.move(box["x"] + line[-1][0] * scale, box["y"] + line[-1][1] * scale, steps=5)
        other.until(f"{STUDIO}.times.length && !{STUDIO}.link.flying")
        second.close()
        page.bring_to_front()
        driver.edits(3)
        assert "only='spout'" in driver.state()["history"][-1]
        driver.press("Control+z")
        driver.edits(2)
        np.testing.assert_array_equal(driver.pixels(), shown)
        page.screenshot(path=tmp_path / "page.png")
    finally:
        server.stop()
        thread.join(30.0)
    assert not thread.is_alive()
    driver.until("document.querySelector('.tb-bad[role=alert]').textContent.includes('connection')")


@contextlib.contextmanager
def served(edit, folder):
    """The session and the address of the page of an edit session."""
    session = Session(edit, folder)
    server = Server(session)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield session, server.url
    finally:
        server.stop()
        thread.join(30.0)


def small():
    """A scene that is prepared at once."""
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=8), size=48)
    return tb.EditSession(scene, "preview", cache=False, error=1.0)


@pytest.mark.parametrize(
    ("width", "height", "ratio"),
    [(1280, 800, 1), (1440, 900, 2), (3840, 2160, 1), (800, 1200, 1), (640, 400, 2)],
)
def test_the_picture_is_as_large_as_the_window_allows(browser, tmp_path, width, height, ratio):
    with served(small(), tmp_path) as (_, address):
        context = browser.new_context(
            viewport={"width": width, "height": height}, device_scale_factor=ratio
        )
        page = context.new_page()
        page.goto(address)
        driver = Driver(page, None)
        driver.settled()
        box = page.locator(".tb-stage canvas").bounding_box()
        side = page.locator(".tb-side").bounding_box()
        assert box["width"] == pytest.approx(box["height"])
        beside = side["x"] >= box["x"] + box["width"]
        assert beside == (width > height and width > 800)
        if beside:
            assert box["height"] >= 0.9 * min(height, width - side["width"] - 40)
        else:
            assert box["width"] >= 0.9 * min(0.6 * height, width)
        # nothing is cut, and letters grow with the window
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        letters = page.evaluate(
            "parseFloat(getComputedStyle(document.querySelector('.tb')).fontSize)"
        )
        assert letters >= (22.0 if width > 3000 else 13.0)
        context.close()


def test_the_surround_is_neutral_and_readable(page, tmp_path):
    channels = """(name) => {
      const probe = document.createElement('i');
      probe.style.color = `var(${name})`;
      document.querySelector('.tb').append(probe);
      return getComputedStyle(probe).color.match(/\\d+/g).map(Number);
    }"""

    def luminance(name):
        value = np.array(page.evaluate(channels, name)[:3]) / 255.0
        linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
        return float(linear @ (0.2126, 0.7152, 0.0722))

    with served(small(), tmp_path) as (_, address):
        page.goto(address)
        Driver(page, None).settled()
        for button in ("bright room", "dark room"):
            page.get_by_role("button", name=button).click()
            assert len(set(page.evaluate(channels, "--back")[:3])) == 1
            for back in ("--back", "--raised"):
                for ink in ("--text", "--quiet", "--bad"):
                    dark, bright = sorted((luminance(back), luminance(ink)))
                    assert (bright + 0.05) / (dark + 0.05) >= 4.5, (button, back, ink)


def test_only_one_pointer_paints(page, tmp_path):
    with served(small(), tmp_path) as (session, address):
        page.goto(address)
        driver = Driver(page, session.edit.scene)
        driver.settled()
        box = page.locator(".tb-stage canvas").bounding_box()
        x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
        count = driver.state()["edits"]
        page.mouse.move(x, y)
        page.mouse.down(button="middle")
        page.mouse.move(x + 40, y, steps=4)
        page.mouse.up(button="middle")
        fire = """([name, id, primary, x, y]) => document.querySelector("canvas").dispatchEvent(
          new PointerEvent(name, {pointerId: id, isPrimary: primary, pointerType: 'touch',
            button: 0, buttons: 1, clientX: x, clientY: y, bubbles: true}))"""
        # a test's own pointers cannot be captured
        page.evaluate("document.querySelector('.tb-stage canvas').setPointerCapture = () => {}")
        page.evaluate(fire, ["pointerdown", 7, False, x, y])
        assert page.evaluate(f"{STUDIO}.held ?? null") is None
        # a second finger neither paints nor ends what the first does
        page.evaluate(fire, ["pointerdown", 5, True, x, y])
        page.evaluate(fire, ["pointerdown", 7, False, x, y])
        page.evaluate(fire, ["pointerup", 7, False, x, y])
        assert page.evaluate(f"{STUDIO}.held") == "brush"
        # a pointer that is lost ends the stroke where it was
        page.evaluate(fire, ["lostpointercapture", 5, True, 0, 0])
        assert page.evaluate(f"{STUDIO}.held") is None
        driver.edits(count + 1)
        driver.settled()
        assert "Stroke([(24.0, 24.0)]" in session.edit.history[-1]
        # a Cyrillic keyboard undoes as well
        page.evaluate("""document.dispatchEvent(new KeyboardEvent('keydown',
          {key: '\u044f', code: 'KeyZ', ctrlKey: true, bubbles: true}))""")
        driver.edits(count)


def test_traits_are_in_groups_and_radius_has_keys(page, tmp_path):
    with served(small(), tmp_path) as (session, address):
        page.goto(address)
        driver = Driver(page, session.edit.scene)
        driver.settled()
        shown = page.locator(".tb-sliders input").evaluate_all(
            "all => all.filter(one => one.checkVisibility()).map(one => one.ariaLabel)"
        )
        assert shown == ["shiny", "metallic", "rough", "dusty", "bright"]
        every = page.locator(".tb-sliders input").evaluate_all("all => all.map(x => x.ariaLabel)")
        assert sorted(every) == sorted(session.edit.traits.names)
        page.locator(".tb-sliders summary", has_text="made of").click()
        assert page.locator(".tb-sliders input[aria-label=gold]").is_visible()
        before = float(page.evaluate(f"{STUDIO}.radius.input.value"))
        driver.press("]")
        assert float(page.evaluate(f"{STUDIO}.radius.input.value")) > before
        driver.press("[")
        driver.press("[")
        assert float(page.evaluate(f"{STUDIO}.radius.input.value")) < before


def test_a_material_is_found_and_dropped_on_a_part(page, tmp_path):
    scene = tb.Scene(tb.teapot(4), tb.EnvironmentMap.sky(rows=8), size=96)
    edit = tb.EditSession(scene, "preview", cache=False, error=1.0)
    with served(edit, tmp_path) as (session, address):
        page.goto(address)
        driver = Driver(page, scene)
        driver.settled()
        page.get_by_label("find a material").fill("old brass")  # the first action
        first = tb.find_materials("old brass")[0]
        shelf = page.locator(".tb-shelf button")
        driver.until(f"document.querySelector('.tb-shelf button')?.title === '{first}'")
        # its sphere is drawn behind: brass is yellow
        corner = "document.querySelector('.tb-shelf canvas').getContext('2d')"
        driver.until(f"{corner}.getImageData(20, 20, 1, 1).data[0] > 60")
        red, _, blue, _ = page.evaluate(f"[...{corner}.getImageData(20, 20, 1, 1).data]")
        assert red > 1.1 * blue
        rows, columns = np.nonzero(scene.part_image == scene.parts.index("lid"))
        box = page.locator(".tb-stage canvas").bounding_box()
        scale = box["width"] / scene.width
        place = {"x": float(np.median(columns)) * scale, "y": float(np.median(rows)) * scale}
        shelf.first.drag_to(page.locator(".tb-stage canvas"), target_position=place)  # the second
        driver.until(f"{STUDIO}.state.material === '{first}'")
        assert session.edit.material("lid").name == first
        assert driver.state()["part"] == "lid"
        # what is no query is told
        page.get_by_label("find a material").fill("shiny > high")
        driver.until(
            "document.querySelector('[role=alert]').textContent.includes('expected terms')"
        )


def test_a_design_leaves_by_one_click(page, tmp_path):
    with served(small(), tmp_path) as (_, address):
        page.goto(address)
        driver = Driver(page, None)
        driver.settled()
        page.get_by_role("button", name="export", exact=True).click()
        driver.until("document.querySelector('.tb-told').textContent.startsWith('written')")
        assert "error of a lit sphere" in page.locator(".tb-told").inner_text()
        assert tb.load_mesh(tmp_path / "design.glb").parts == ("sphere",)
        page.locator(".tb input[aria-label=file]").fill("elsewhere/design")
        page.get_by_role("button", name="export", exact=True).click()
        driver.until(
            "document.querySelector('[role=alert]').textContent.includes('without a path')"
        )


def test_a_design_of_another_shape_brings_its_parts(page, tmp_path):
    other = tb.Scene(tb.teapot(4), tb.EnvironmentMap.sky(rows=8), size=32)
    tb.EditSession(other, "preview", cache=False, error=1.0).save(tmp_path / "pot.tbr")
    with served(small(), tmp_path) as (_, address):
        page.goto(address)
        driver = Driver(page, None)
        driver.settled()
        second = page.context.new_page()
        second.goto(address)
        Driver(second, None).settled()
        page.bring_to_front()
        page.locator(".tb input[aria-label=file]").fill("pot")
        page.locator(".tb").get_by_role("button", name="open", exact=True).click()
        for tab in (page, second):
            tab.bring_to_front()
            Driver(tab, None).until(
                "document.querySelector('[aria-label=part]').options.length > 4"
            )


def test_a_wrong_token_is_told(page, tmp_path):
    edit = tb.EditSession(tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=8), size=16))
    server = Server(Session(edit, tmp_path))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        answer = page.goto(server.url.replace("token=", "token=x"))
        assert answer.status == 403
        assert "traitbrdf studio" in page.inner_text("body")
    finally:
        server.stop()
        thread.join(30.0)


def test_jupyter_lab(page, tmp_path):
    pytest.importorskip("jupyterlab", reason="jupyterlab is not installed")
    write_notebook(tmp_path / "live.ipynb", "import traitbrdf as tb\n" + SCENE, "tb.studio(edit)")
    with jupyter_lab(tmp_path) as address:
        page.goto(f"{address}/lab/tree/live.ipynb")
        driver = Driver(page, example().scene)
        driver.until(KERNEL_IDLE)
        page.evaluate(RUN_ALL)
        shown = paint_and_more(driver, tmp_path)
        page.screenshot(path=tmp_path / "lab.png")
        # the kernel remembers what the page forgets
        page.evaluate("jupyterapp.commands.execute('docmanager:save')")
        page.reload()
        np.testing.assert_array_equal(driver.pixels(), shown)
        assert driver.state()["edits"] == 2
        # a page of this machine has a socket; without it, the kernel's messages do
        assert page.evaluate(f"{STUDIO}.channel === {STUDIO}.socket")
        page.evaluate(f"{STUDIO}.socket.close()")
        driver.until(f"{STUDIO}.channel === {STUDIO}.model")
        driver.press("1")
        driver.stroke(along(driver.scene, "lid"))
        driver.edits(3)
        driver.press("Control+z")
        driver.edits(2)
        np.testing.assert_array_equal(driver.pixels(), shown)
