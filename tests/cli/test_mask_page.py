"""The page of `lodbench mask` in a real browser, with the command behind it, on a photo of 20 megapixels."""

import subprocess
import sys
from contextlib import contextmanager
from io import BytesIO

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.reporting.browser import PHONE, fits, opened

WIDTH, HEIGHT = 5472, 3648
# Rows and columns of houses; the first is in the mask from the start.
FIRST, SECOND = (slice(2900, 3200), slice(4300, 4700)), (slice(1200, 1500), slice(1500, 1900))
RED, GRASS = (170, 70, 60), (80, 130, 70)


@pytest.fixture(scope="module")
def photo(tmp_path_factory):
    """Returns a 20-megapixel photo of two red houses on grass, with a mask of the first beside it."""
    folder = tmp_path_factory.mktemp("photo")
    noise = np.random.default_rng(0).normal(0, 6, (256, 256, 3))
    grass = np.tile(noise + np.array(GRASS), (15, 22, 1))[:HEIGHT, :WIDTH]
    for house in (FIRST, SECOND):
        grass[house] += np.array(RED) - GRASS
    pixels = np.clip(grass, 0, 255).astype(np.uint8)
    cv2.imwrite(str(folder / "photo.jpg"), pixels[..., ::-1])
    cv2.imwrite(str(folder / "start.png"), start().astype(np.uint8) * 255)
    return folder / "photo.jpg"


def start():
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[FIRST] = True
    return mask


@contextmanager
def served(photo, out):
    """Runs the command; yields its page's address. It ends by itself, once the page is closed."""
    command = [sys.executable, "-m", "lodbench", "mask", str(photo)]
    command += ["--mask", str(photo.with_name("start.png")), "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process.stdout.readline().removeprefix("open: ").strip()
            assert process.wait(timeout=30) == 0
        finally:
            process.kill()


class Screen:
    """What a person sees of the page, in CSS pixels."""

    def __init__(self, page):
        self.page = page
        page.wait_for_function("photo !== null && tiles.size === 24")

    def picture(self):
        """Returns the (H, W, 3) pixels of the photo's area, once it is drawn, without the brush."""
        self.page.evaluate("at = null; later(paint)")
        self.page.evaluate("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")
        shot = Image.open(BytesIO(self.page.locator("main").screenshot())).convert("RGB")
        box = self.page.locator("main").bounding_box()
        return np.asarray(shot.resize((round(box["width"]), round(box["height"])), Image.Resampling.BOX), int)

    def second(self):
        """Returns left, top, right and bottom of the second house in the area; its mask is not drawn."""
        is_red = (np.abs(self.picture() - RED).max(axis=2) < 20).astype(np.uint8)
        rows, columns = np.nonzero(cv2.morphologyEx(is_red, cv2.MORPH_OPEN, np.ones((3, 3))))
        return float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1)

    def pixel(self, place):
        """Returns the photo's pixel at a place of the area, by where the second house is."""
        left, top, right, bottom = self.second()
        u = SECOND[1].start + (place[0] - left) * 400 / (right - left)
        v = SECOND[0].start + (place[1] - top) * 300 / (bottom - top)
        return np.array([u - 0.5, v - 0.5])

    def on_page(self, place):
        """Returns a place of the area as one of the window."""
        box = self.page.locator("main").bounding_box()
        return box["x"] + place[0], box["y"] + place[1]

    def settled(self, words):
        """Waits for the page's message; returns it."""
        self.page.wait_for_function("words => get('message').textContent.includes(words)", arg=words)
        return self.page.locator("#message").inner_text()

    def drag(self, first, last):
        self.page.mouse.move(*self.on_page(first))
        self.page.mouse.down()
        self.page.mouse.move(*self.on_page(last), steps=7)
        self.page.mouse.up()

    def saved(self, out):
        """Presses Save; returns the mask that is written."""
        out.unlink(missing_ok=True)
        self.page.locator("#save").click()
        self.settled("saved: " + out.name)
        return cv2.imread(str(out), cv2.IMREAD_GRAYSCALE) > 127

    def close(self):
        self.page.locator("#stop").click()
        self.settled("Closed.")


def distances(first, last):
    """Returns (H, W) how far each pixel is from a line between two, by plain geometry."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    across = last - first
    share = ((columns - first[0]) * across[0] + (rows - first[1]) * across[1]) / (across @ across)
    share = np.clip(share, 0, 1)
    return np.hypot(columns - first[0] - share * across[0], rows - first[1] - share * across[1])


def assert_painted(mask, before, first, last, radius, tolerance):
    """Every pixel under the brush is building, every other as before; undecided within the tolerance."""
    away = distances(first, last)
    assert mask[away < radius - tolerance].all()
    outside = away > radius + tolerance
    assert np.array_equal(mask[outside], before[outside])


def test_twenty_megapixels_are_zoomed_moved_painted_undone_and_saved(photo, tmp_path):
    out = tmp_path / "out.png"
    with served(photo, out) as address, opened(address, scheme="dark") as (page, complaints):
        screen = Screen(page)
        picture = screen.picture()
        shown = np.nonzero((picture.max(axis=2) > 40).any(axis=0))[0]
        left, right = shown.min(), picture.shape[1] - 1 - shown.max()
        below = np.nonzero((picture.max(axis=2) > 40).any(axis=1))[0]
        above, under = below.min(), picture.shape[0] - 1 - below.max()
        assert abs(left - right) <= 1
        assert abs(above - under) <= 1
        assert min(left, above) <= 1  # as large as it can be

        # The wheel enlarges what is under the pointer.
        box = screen.second()
        middle = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
        page.mouse.move(*screen.on_page(middle))
        for _ in range(6):
            page.mouse.wheel(0, -120)
        page.wait_for_function("view.scale > 1")
        near = screen.second()
        assert near[2] - near[0] == pytest.approx(
            400 * np.exp(6 * 120 / 400) * (box[2] - box[0]) / 400, rel=0.03
        )
        assert ((near[0] + near[2]) / 2, (near[1] + near[3]) / 2) == pytest.approx(middle, abs=6)

        # Space and dragging move it.
        page.mouse.move(*screen.on_page((500, 400)))
        page.keyboard.down(" ")
        screen.drag((500, 400), (640, 330))
        page.keyboard.up(" ")
        moved = screen.second()
        assert np.subtract(moved, near) == pytest.approx([140, -70, 140, -70], abs=2)

        # An exact stroke, on grass and house.
        page.locator("#mode").select_option("exact")
        page.locator("#size").fill("41")
        ends = (moved[0] - 80, moved[1] + 60), (moved[0] + 90, moved[1] + 95)
        first, last = screen.pixel(ends[0]), screen.pixel(ends[1])
        assert page.locator("#undo").is_disabled()
        screen.drag(*ends)
        screen.settled("% of the photo is building")
        painted = screen.saved(out)
        assert_painted(painted, start(), first, last, 20.5, tolerance=1.6)
        assert (painted & ~start()).sum() == pytest.approx(
            41 * np.hypot(*(last - first)) + np.pi * 20.5**2, rel=0.03
        )

        page.keyboard.press("Control+z")
        screen.settled("Undone")
        assert np.array_equal(screen.saved(out), start())
        page.keyboard.press("Control+y")
        screen.settled("Drawn again")
        assert np.array_equal(screen.saved(out), painted)
        page.locator("#undo").click()
        screen.settled("Undone")
        assert page.locator("#undo").is_disabled()

        # Similar pixels: a stroke brings the house, its grass is left; what was there stays.
        page.locator("#mode").select_option("similar")
        screen.drag((moved[0] + 60, moved[1] + 60), (moved[2] - 60, moved[3] - 60))
        screen.settled("% of the photo is building")
        expected = start()
        expected[SECOND] = True
        followed = screen.saved(out)
        assert (followed & expected).sum() / (followed | expected).sum() > 0.98
        screen.close()
        assert complaints == []


def test_fingers_on_a_phone_zoom_and_paint(photo, tmp_path):
    out = tmp_path / "out.png"
    with served(photo, out) as address, opened(address, PHONE, has_touch=True) as (page, complaints):
        screen = Screen(page)
        assert fits(page)
        area = page.locator("main").bounding_box()
        assert area["height"] > 0.6 * PHONE["height"]
        fingers = page.context.new_cdp_session(page)

        def touch(kind, *places):
            points = [
                dict(zip("xy", screen.on_page(place), strict=True), id=n) for n, place in enumerate(places)
            ]
            fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        box = screen.second()
        x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
        touch("touchStart", (x - 10, y))
        touch("touchStart", (x - 10, y), (x + 10, y))
        for step in range(1, 9):
            touch("touchMove", (x - 10 - 5 * step, y), (x + 10 + 5 * step, y))
        touch("touchMove", (x - 50, y), (x + 50.2, y))  # browsers pass moves on with the next frame
        page.wait_for_function(f"view.scale > 4.9 * {PHONE['width']} / {WIDTH}")
        before = screen.second()
        touch("touchMove", (x - 30, y + 25), (x + 70.2, y + 25))  # two fingers move it as well
        touch("touchEnd")
        near = screen.second()
        assert near[2] - near[0] == pytest.approx(400 * 5 * PHONE["width"] / WIDTH, abs=3)
        assert np.subtract(near, before) == pytest.approx([20, 25, 20, 25], abs=3)
        assert page.locator("#undo").is_disabled()  # two fingers paint nothing

        page.locator("#mode").select_option("exact")
        page.locator("#size").fill("61")
        ends = (near[0] - 20, near[1] + 30), (near[0] + 20, near[1] + 50)
        first, last = screen.pixel(ends[0]), screen.pixel(ends[1])
        touch("touchStart", ends[0])
        for share in (0.25, 0.5, 0.75, 1):
            touch("touchMove", np.add(ends[0], share * np.subtract(ends[1], ends[0])).tolist())
        touch("touchEnd")
        screen.settled("% of the photo is building")
        assert_painted(screen.saved(out), start(), first, last, 30.5, tolerance=6)
        screen.close()
        assert complaints == []


def test_the_brush_is_shown_as_large_as_it_is(photo, tmp_path):
    out = tmp_path / "out.png"
    with served(photo, out) as address, opened(address) as (page, _):
        screen = Screen(page)
        page.locator("#size").fill("300")
        page.mouse.move(*screen.on_page((400, 300)))
        page.mouse.move(*screen.on_page((400, 300)))
        page.evaluate("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")
        shot = np.asarray(Image.open(BytesIO(page.locator("main").screenshot())).convert("RGB"), int)
        is_ring = shot.min(axis=2) > 200
        columns = np.nonzero(is_ring[300, 200:600])[0] + 200
        box = screen.second()
        assert columns.max() - columns.min() == pytest.approx(300 * (box[2] - box[0]) / 400, abs=3)
        assert (columns.max() + columns.min()) / 2 == pytest.approx(400, abs=1.5)
        page.keyboard.press("]")
        assert page.locator("#size").input_value() == "360"
        page.keyboard.press("0")
        screen.close()
