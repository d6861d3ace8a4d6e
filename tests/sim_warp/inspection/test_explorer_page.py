"""The explorer's page in Chromium, from a file and without a network: frames, keys, overlays, playing, hostile names."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from playwright.sync_api import Page as Tab
from playwright.sync_api import expect, sync_playwright

from tests.analysis.reports.browser import CHROMIUM, WIDTHS, find_faults, needs_chromium
from tests.synthetic import write_synthetic_data
from xew.dataset import find_records
from xew.episode import episode_folder, read_states, read_video
from xew.rollout import write_rollout
from xew.sim_warp.inspection.explorer import Page, choose_scenes, find_predictions, write_page
from xew.sim_warp.rendering import streams

pytestmark = needs_chromium

FRAMES = 18
TASK = "place_empty_cup"
LABELS = yaml.safe_load((Path(__file__).parents[2] / "faults" / "inputs" / "labels.yaml").read_text(encoding="utf-8"))
HOSTILE = "</script><script>window.ran=1</script><img src=x onerror=window.ran=1>"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes, of two robots and of one, whose instruction and objects are hostile."""
    root = tmp_path_factory.mktemp("explored")
    write_synthetic_data(root, (TASK,), (0, 1), ("ur5_wsg", "piper"), FRAMES)
    episode_folder(root, TASK, 1, "ur5_wsg").rename(root / "away")
    for path in root.rglob("episode.json"):
        header = {"object_names": [HOSTILE], "instruction": "".join(map(str, LABELS)) + HOSTILE}
        path.write_text(json.dumps(json.loads(path.read_text()) | header))
    truth = read_video(episode_folder(root, TASK, 0, "piper") / "rgb.mkv")
    wrong = np.where(np.arange(FRAMES)[:, None, None, None] < 9, truth, 255 - truth)
    write_rollout(root / "tree", TASK, 0, "piper", wrong, {"model": HOSTILE})
    return root


@pytest.fixture(scope="module")
def page(data: Path) -> Path:
    """Their page, with the flow of everything to the right in the lower half."""
    flow = np.zeros((FRAMES, 240, 320, 2), np.float32)
    flow[:, 120:] = [25, 0]

    class Streams:
        optical_flow = flow

    predictions = find_predictions([data / "tree"])
    scenes, _ = choose_scenes([cell for cell in find_records(data) if "tree" not in cell[0].parts], (), 6, {})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streams, "command_streams", lambda robot, action, camera, table: Streams)
        write_page(Page(HOSTILE, scenes, 0, predictions), data / "page")
    return data / "page" / "index.html"


@pytest.fixture(scope="module")
def browser_tab(page: Path) -> Iterator[tuple[Tab, list[str]]]:
    """The page on a desk, and what Chromium complains of."""
    complaints: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        tab = browser.new_context(viewport={"width": WIDTHS["desk"], "height": 1600}, offline=True).new_page()
        tab.on("console", lambda message: complaints.append(message.text))
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        tab.on("request", lambda r: complaints.extend([r.url] * (not r.url.startswith("file:"))))
        tab.goto(page.resolve().as_uri())
        yield tab, complaints
        browser.close()


@pytest.fixture
def tab(browser_tab: tuple[Tab, list[str]]) -> Tab:
    """The page at the first frame of the first scene, without overlays."""
    tab, _ = browser_tab
    tab.evaluate("location.hash = '#place_empty_cup/0'")
    expect(tab.locator("figure")).to_have_count(2)
    for button in tab.locator("[aria-pressed=true]").all():
        button.click()
    tab.evaluate("document.activeElement.blur()")
    tab.keyboard.press("Home")
    at_frame(tab, 0)
    return tab


def at_frame(tab: Tab, number: int) -> None:
    """Wait until a frame is drawn, and hold that the slider says so."""
    expect(tab.locator("#robots")).to_have_attribute("data-frame", str(number))
    expect(tab.locator("#slider")).to_have_value(str(number))


def picture(tab: Tab, label: str) -> np.ndarray:
    """What a canvas shows, at the episode's size: [240 320 3] uint8 RGB."""
    shot = tab.get_by_role("img", name=label, exact=True).screenshot()
    image = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR)
    return cv2.resize(image, (320, 240), interpolation=cv2.INTER_LINEAR)[..., ::-1].astype(int)


def nearest(image: np.ndarray, video: np.ndarray) -> int:
    """Number of the frame that a picture is most alike."""
    return int(np.abs(video.astype(int) - image).mean((1, 2, 3)).argmin())


def test_the_page_fits_a_phone_and_a_desk_in_light_and_dark(page: Path) -> None:
    """It stands first: it starts a browser of its own, and Playwright runs one at a time."""
    assert find_faults(page, images=0, charts=0) == []


def test_keys_and_buttons_step_to_the_very_frame_of_all_robots(tab: Tab, data: Path) -> None:
    for key, frame in (("Shift+ArrowRight", 10), ("ArrowRight", 11), ("ArrowRight", 12), ("ArrowLeft", 11)):
        tab.keyboard.press(key)
        at_frame(tab, frame)
    for title, robot in (("UR5", "ur5_wsg"), ("Piper", "piper")):
        video = read_video(episode_folder(data, TASK, 0, robot) / "rgb.mkv")
        assert np.abs(video[11].astype(int) - video[10]).mean() > 0.2, "frames differ"
        assert nearest(picture(tab, f"Video of {title}"), video) == 11
    tab.get_by_role("button", name="One frame ahead").click()
    at_frame(tab, 12)
    tab.get_by_label("Frame", exact=True).fill("5")
    at_frame(tab, 5)
    tab.keyboard.press("End")
    at_frame(tab, FRAMES - 1)
    tab.keyboard.press("ArrowRight")
    at_frame(tab, FRAMES - 1)


def test_space_plays_and_pauses_on_the_frame_that_is_told(tab: Tab, data: Path) -> None:
    tab.keyboard.press("Space")
    expect(tab.locator("#play")).to_have_accessible_name("Pause")
    tab.wait_for_function("Number(document.getElementById('robots').dataset.frame) >= 6")
    tab.keyboard.press("Space")
    expect(tab.locator("#play")).to_have_accessible_name("Play")
    stopped = int(tab.locator("#slider").input_value())
    at_frame(tab, stopped)
    assert nearest(picture(tab, "Video of Piper"), read_video(episode_folder(data, TASK, 0, "piper") / "rgb.mkv")) == stopped
    tab.keyboard.press("ArrowLeft")
    at_frame(tab, max(0, stopped - 1))


def test_overlays_lie_where_the_states_say(tab: Tab, data: Path) -> None:
    states = read_states(episode_folder(data, TASK, 0, "piper"))
    frame = int(np.flatnonzero(states.contact.any((1, 2)))[0])
    tab.get_by_label("Frame", exact=True).fill(str(frame))
    at_frame(tab, frame)
    plain = picture(tab, "Video of Piper")

    def change(press: str) -> np.ndarray:
        tab.keyboard.press(press)
        changed = np.abs(picture(tab, "Video of Piper") - plain).max(-1) > 60
        tab.keyboard.press(press)
        assert np.abs(picture(tab, "Video of Piper") - plain).max() <= 2, "the overlay is gone"
        return changed

    tab.evaluate("document.activeElement.blur()")
    mask = states.robot_mask[frame].astype(np.uint8)
    edge = cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((7, 7), np.uint8)) > 0
    outlined = change("m")
    assert outlined.sum() > 200 and outlined[edge].sum() == outlined.sum()
    flow = change("f")
    robot = cv2.dilate(mask, np.ones((7, 7), np.uint8)) > 0
    assert flow[125:].mean() > 0.5 and not flow[:115][~robot[:115]].any()
    points = change("k")
    x, y = states.keypoints[frame][states.keypoint_visible[frame]].round().astype(int).T
    near = np.zeros((240, 320), np.uint8)
    near[y, x] = 1
    near = cv2.dilate(near, np.ones((11, 11), np.uint8)) > 0
    assert points.any() and points[near].sum() == points.sum()
    assert change("c").any()
    button = tab.get_by_role("button", name="Mask")
    button.click()
    expect(button).to_have_attribute("aria-pressed", "true")
    tab.keyboard.press("Space")
    expect(button).to_have_attribute("aria-pressed", "false")
    expect(tab.locator("#play")).to_have_accessible_name("Play")


def test_predictions_stand_beside_the_truth_with_their_error(tab: Tab) -> None:
    assert picture(tab, "difference of Piper").min() > 240
    expect(tab.locator("figure", has_text="Piper")).to_contain_text("exact")
    expect(tab.locator("figure", has_text="UR5")).to_contain_text("not predicted")
    before = picture(tab, "prediction of Piper")
    tab.get_by_label("Frame", exact=True).fill("12")
    at_frame(tab, 12)
    assert np.median(picture(tab, "difference of Piper")) < 128
    assert np.abs(picture(tab, "prediction of Piper") - before).mean() > 30
    assert re.search(r"PSNR\d+\.\d dB · mean \d+\.\d dB", tab.locator("figure", has_text="Piper").text_content() or "")


def test_hostile_names_are_shown_and_run_nothing(tab: Tab, browser_tab: tuple[Tab, list[str]]) -> None:
    expect(tab.locator("h1")).to_have_text(HOSTILE)
    expect(tab.locator("#models option")).to_have_text(HOSTILE)
    shown = tab.locator("#instruction").text_content() or ""
    assert all(str(label) in shown for label in LABELS) and shown.endswith(HOSTILE)
    assert HOSTILE in (tab.locator("canvas[aria-label*=touches]").first.get_attribute("aria-label") or "")
    tab.keyboard.press("n")
    expect(tab.locator("figure")).to_have_count(1)
    at_frame(tab, 0)
    expect(tab.locator("#models-label")).to_be_hidden()
    assert tab.evaluate("window.ran") is None and tab.locator("img, main script").count() == 0
    assert browser_tab[1] == [], "no console message, and nothing leaves the machine"


def test_what_is_missing_is_told(tab: Tab, page: Path) -> None:
    (script,) = page.parent.glob("scenes/001*.js")
    script.rename(page.parent / "away.js")
    try:
        other = tab.context.new_page()
        other.goto(f"{page.resolve().as_uri()}#place_empty_cup/1")
        alert = other.get_by_role("alert")
        alert.wait_for(timeout=10_000)
        assert alert.inner_text() == (f"scenes/{script.name} is missing; copy the page's whole folder, or make the page again.")
        assert other.locator("figure").count() == 0, "nothing of it is drawn"
        other.close()
    finally:
        (page.parent / "away.js").rename(script)
