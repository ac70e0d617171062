"""The page is one well-formed file that carries everything it shows and fetches nothing."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from pipeline.io.glb import GlbFile
from pipeline.report.page import ERROR_MAP_MAX_LEVELS, MAX_IMAGE_PX, error_map, format_metric, render_page
from pipeline.report.templates import ASSETS_DIR
from tests.report.report_sample import sample_page

VOID = {"meta", "link", "img", "input", "br"}


class Outline(HTMLParser):
    """Checks that tags nest, and keeps attributes and texts."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


@pytest.fixture(scope="module")
def page() -> str:
    return render_page(sample_page())


@pytest.fixture(scope="module")
def outline(page: str) -> Outline:
    parser = Outline()
    parser.feed(page)
    assert parser.open == []
    return parser


def test_nothing_is_fetched(outline: Outline):
    links = [attributes.get(key) for _, attributes in outline.attributes for key in ("src", "href", "srcset")]
    assert [link for link in links if link]
    assert all(link.startswith("data:") for link in links if link)
    assert not re.search(r"url\((?!data:)|@import", (ASSETS_DIR / "report.css").read_text())


def test_every_picture_has_a_size_and_a_text(outline: Outline):
    images = [attributes for tag, attributes in outline.attributes if tag == "img"]
    assert len(images) == 2 * 5 + 4 + 1
    assert all(image["alt"] and int(image["width"] or 0) > 0 for image in images)


def test_large_images_are_shrunk_in_proportion():
    large = np.full((40, 2 * MAX_IMAGE_PX, 3), 90, np.uint8)
    parser = Outline()
    parser.feed(render_page(replace(sample_page(), images=[("Mesh", large)])))
    sizes = [(attributes["width"], attributes["height"]) for tag, attributes in parser.attributes if tag == "img"]
    assert (str(MAX_IMAGE_PX), "20") in sizes


def test_what_people_wrote_is_escaped(page: str):
    assert "<title>run &lt;one&gt;</title>" in page
    assert "a &lt;processor&gt;" in page


def test_the_model_is_carried_whole(page: str):
    found = re.search(r'id="avatar-glb">([^<]+)</script>', page)
    assert found
    file = GlbFile(Path("embedded.glb"), base64.b64decode(found.group(1)))
    assert file.gltf["skins"]
    assert file.gltf["animations"]
    assert 0 <= len(file.binary) - file.gltf["buffers"][0]["byteLength"] < 4  # chunks are padded


def test_scripts_cannot_end_early():
    for name in ("viewer.min.js", "report.js", "report.css"):
        assert not re.search(r"</(script|style)", (ASSETS_DIR / name).read_text(encoding="utf-8"), re.IGNORECASE)


def test_frames_without_error_show_a_dash_instead_of_infinity(outline: Outline):
    texts = " ".join(outline.texts)
    assert "– dB" in texts
    assert "inf" not in " ".join(outline.texts[:40])


def test_error_maps_are_black_for_equal_and_brightest_from_the_range_on():
    dark = np.zeros((2, 2, 3), dtype=np.uint8)
    assert error_map(dark, dark).max() <= 4
    assert np.array_equal(error_map(dark, dark + np.uint8(ERROR_MAP_MAX_LEVELS)), error_map(dark, dark + np.uint8(255)))
    assert error_map(dark, dark + np.uint8(ERROR_MAP_MAX_LEVELS)).mean() > 200


@pytest.mark.parametrize(
    ("value", "text"),
    [(True, "yes"), (None, "–"), (0.912345, "0.9123"), (12345, "12,345"), (12345.6, "12,346"), (0.0, "0"), ("a", "a")],
)
def test_figures_are_short(value: object, text: str):
    assert format_metric(value) == text
