"""The 3D view of the report in a real browser: it plays, changes surfaces, levels and morphs, and logs no error."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.avatar.formats.levels_of_detail import encode_level
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.report.embed import read_level
from pipeline.report.page import render_page
from tests.report.report_sample import sample_page
from tests.tools.browser import BrowserPage, open_browser

pytestmark = pytest.mark.slow  # software WebGL

MORPHS = ("jawOpen", "wide")
FAKE_HEADSET = """Object.defineProperty(navigator, "xr", {value: {
  isSessionSupported: async (mode) => mode === "immersive-vr",
  requestSession: async () => { throw new Error("no headset is worn"); },
}})"""


def with_morphs(glb: bytes, folder: Path) -> Path:
    """Write the avatar with two sparse morph targets: one moves the upper half, one widens it."""
    path = folder / "plain.glb"
    path.write_bytes(glb)
    file = GlbFile(path)
    document = GlbWriter.from_file(file)
    mesh = document.json["meshes"][0]
    primitive = mesh["primitives"][0]
    positions = file.accessor(primitive["attributes"]["POSITION"])
    upper = positions[:, 1:2] > np.median(positions[:, 1])
    moves = [np.where(upper, move, 0.0).astype(np.float32) for move in ([0.0, 0.5, 0.0], positions * [0.5, 0.0, 0.0])]
    primitive["targets"] = [{"POSITION": document.add_sparse_array(move, bounds=True)} for move in moves]
    mesh |= {"weights": [0.0, 0.0], "extras": {"targetNames": list(MORPHS)}}
    (folder / "avatar.glb").write_bytes(document.to_bytes())
    return folder / "avatar.glb"


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewer")
    content = sample_page()
    avatar = with_morphs(content.glb, folder)
    (folder / "avatar_lod1.glb").write_bytes(encode_level(GlbFile(avatar), 0.5, 1))
    coverage = np.linspace(0, 255, 32 * 32).astype(np.uint8).reshape(32, 32)
    levels = [read_level(folder / "avatar_lod1.glb")]
    page = render_page(replace(content, glb=avatar.read_bytes(), levels=levels, coverage=coverage))
    (folder / "index.html").write_text(page, encoding="utf-8")
    return folder / "index.html"


@pytest.fixture(scope="module")
def browser() -> Iterator[BrowserPage]:
    with open_browser() as page:
        yield page


@pytest.fixture
def page(browser: BrowserPage, file: Path) -> Iterator[BrowserPage]:
    browser.resize(720, 600)
    browser.open(file)
    browser.evaluate("document.getElementById('viewer').scrollIntoView()")
    yield browser
    assert browser.problems == []


def choose(page: BrowserPage, label: str, value: str) -> None:
    """Choose an entry of a list as a user does."""
    page.evaluate(
        f"""(() => {{ const list = document.querySelector('select[aria-label="{label}"]');
        list.value = "{value}"; list.dispatchEvent(new Event("change")); }})()"""
    )


def push(page: BrowserPage, text: str) -> None:
    """Push a button of the view."""
    page.evaluate(f"[...document.querySelectorAll('#viewer button')].find((b) => b.textContent === '{text}').click()")


def picture(page: BrowserPage) -> np.ndarray:
    """Return the view's pixels, drawn now."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    box = page.evaluate("JSON.stringify(document.querySelector('.viewer-picture').getBoundingClientRect())")
    x, y, width, height = (round(json.loads(box)[key]) for key in ("x", "y", "width", "height"))
    return page.screenshot()[max(y, 0) : y + height, x : x + width].astype(np.int16)


def test_every_surface_and_overlay_changes_the_picture(page: BrowserPage):
    push(page, "Pause")
    seen = [picture(page)]
    for surface in ("unlit", "clay", "coverage"):
        choose(page, "Surface", surface)
        seen.append(picture(page))
    for overlay in ("Wireframe", "Skeleton"):
        push(page, overlay)
        seen.append(picture(page))
    changes = [np.abs(b - a).max() for a, b in zip(seen[:-1], seen[1:], strict=True)]
    assert min(changes) > 10, changes
    assert page.evaluate("avatarView.renderer.info.render.calls") <= 7


def test_a_headset_draws_few_things(page: BrowserPage):
    picture(page)
    assert page.evaluate("avatarView.renderer.info.render.calls") <= 4


def test_clips_play_pause_and_scrub(page: BrowserPage):
    page.wait("avatarView.avatar.time > 0.05")
    push(page, "Pause")
    page.evaluate(
        """(() => { const bar = document.querySelector('input[aria-label="Time in the clip"]');
        bar.value = 0.4; bar.dispatchEvent(new Event("input")); })()"""
    )
    assert page.evaluate("avatarView.avatar.time") == pytest.approx(0.4)
    before = page.evaluate("avatarView.avatar.skeleton.bones.map((b) => b.matrixWorld.elements[13])")
    choose(page, "Clip", "-1")
    picture(page)
    assert page.evaluate("avatarView.avatar.duration") == 0
    assert page.evaluate("avatarView.avatar.skeleton.bones.map((b) => b.matrixWorld.elements[13])") != before


def test_morphs_and_levels_share_skeleton_and_weights(page: BrowserPage):
    push(page, "Pause")
    top = "avatarView.avatar.posedBox().max.y"
    assert page.evaluate("[...document.querySelectorAll('.viewer-morphs label')].map((l) => l.textContent)") == [
        *MORPHS
    ]
    faces = page.evaluate("avatarView.avatar.triangles")
    assert faces[1] < faces[0]
    for level in (0, 1):
        choose(page, "Level of detail", str(level))
        rest = page.evaluate(top)
        page.evaluate(
            """(() => { const slider = document.querySelector(".viewer-morphs input");
            slider.value = 1; slider.dispatchEvent(new Event("input")); })()"""
        )
        assert page.evaluate(top) - rest > 0.1
        push(page, "Reset all")
        assert page.evaluate(top) == pytest.approx(rest, abs=1e-6)


def test_keys_and_touch(page: BrowserPage):
    page.resize(390, 800, touch=True)
    page.evaluate("document.getElementById('viewer').focus()")
    was_playing = page.evaluate("avatarView.playing")
    page.press(" ")
    assert page.evaluate("avatarView.playing") is not was_playing
    for key in ("ArrowLeft", "ArrowUp", "+", "Home"):
        before = page.evaluate("avatarView.camera.position.toArray()")
        page.press(key)
        assert page.evaluate("avatarView.camera.position.toArray()") != before, key
    sizes = page.evaluate("[...document.querySelectorAll('.viewer-bar button')].map((b) => b.clientHeight)")
    assert min(sizes) >= 36
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


def test_the_headset_button_appears_only_with_a_headset(browser: BrowserPage, file: Path):
    labels = "[...document.querySelectorAll('#viewer button')].map((b) => b.textContent)"
    browser.open(file)
    assert "Enter VR" not in browser.evaluate(labels)
    script = browser.call("Page.addScriptToEvaluateOnNewDocument", source=FAKE_HEADSET)["identifier"]
    browser.open(file)
    push(browser, "Enter VR")
    browser.wait(f"{labels}.includes('No VR')")  # the session was refused
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script)
    assert browser.problems == []
