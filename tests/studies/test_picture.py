"""README's first screen: its moving picture, its result and its words."""

import io
import re

import numpy as np
import pytest
from PIL import Image

from studies import picture
from tests.conftest import ROOT

README = ROOT / "README.md"


def test_a_frame_shows_both_sides_and_the_picture_moves():
    frames = [*picture.frames(time=60.0)]
    assert {frame.shape for frame in frames} == {(picture.SIZE[1], 2 * picture.SIZE[0], 3)}
    assert len(frames) == 12 // picture.EVERY
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 100
    with Image.open(io.BytesIO(picture.moving(frames))) as image:
        assert (image.format, image.n_frames) == ("GIF", len(frames))


def test_the_committed_results_fill_pages_and_pictures_again(tmp_path, monkeypatch):
    page, results = tmp_path / "page.md", tmp_path / "benchmark.json"
    page.write_text("a <!-- finding:begin --><!-- finding:end --> b <!-- benchmark:begin --><!-- benchmark:end -->")
    results.write_bytes((ROOT / "results" / "benchmark" / "benchmark.json").read_bytes())
    monkeypatch.setattr(picture, "PAGES", [page])
    assert picture.main([str(results)]) == 0
    said = re.search(
        r"<!-- finding:begin -->\n(Of controllers that are not told .*)\n<!-- finding:end -->", page.read_text()
    )
    assert said is not None
    assert said[1] in README.read_text()
    for name in ("result.svg", "pareto.svg"):
        assert (tmp_path / name).read_bytes() == (ROOT / "results" / "benchmark" / name).read_bytes()


def test_readmes_first_screen_is_short_and_light():
    text = README.read_text()
    words = re.sub(r"```.*?```|<!--.*?-->|\]\([^)]*\)", " ", text, flags=re.DOTALL)
    assert len(re.findall(r"\w[\w.'-]*", words)) <= 450
    assert text[: text.index("```")].count("\n") < 40
    pictures = [ROOT / name for name in re.findall(r"!\[[^]]+\]\(([^)]+)\)", text)]
    assert [each.name for each in pictures] == ["lost-and-held.gif", "result.svg"]
    assert sum(each.stat().st_size for each in pictures) < 1_500_000


@pytest.mark.parametrize("name", ["benchmark", "crystal", "bounds", "frontier"])
def test_every_report_shows_its_pictures(name):
    folder = ROOT / "results" / name
    shown = re.findall(r"^!\[[^]]+\]\(([^)]+)\)$", (folder / "report.md").read_text(), re.MULTILINE)
    assert "pareto.svg" in shown
    assert all((folder / each).is_file() for each in shown)
