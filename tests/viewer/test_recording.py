"""Laws of recordings: what is written is what was shown."""

import xml.etree.ElementTree as ET

import meshio
import numpy as np
import pytest
from PIL import Image

from dpl.viewer.animation import animate_load
from dpl.viewer.frames import ViewSettings
from dpl.viewer.rasterizer import Camera, Renderer
from dpl.viewer.recording import MOST, RATE, Recording, evenly


@pytest.fixture
def recording(body):
    """Three frames in half a second."""
    recording = Recording(body)
    recording.start()
    for index, now in ((1, 10.0), (2, 10.2), (3, 10.5)):
        recording.take(
            body.answer(body.sample(index), ViewSettings(quantity="von Mises stress")), now
        )
    recording.stop()
    return recording


def test_a_series_holds_forces_displacements_stress_and_volumes(recording, body, tmp_path):
    path = recording.save_series(tmp_path)
    sets = ET.parse(path).getroot().findall(".//DataSet")
    assert [float(one.get("timestep")) for one in sets] == pytest.approx([0.0, 0.2, 0.5])
    for one, (_, frame) in zip(sets, recording.frames(), strict=True):
        found = meshio.read(path.parent / one.get("file"))
        assert np.ptp(found.points[:, 0]) == pytest.approx(100.0)
        data = found.point_data
        assert data["force [N]"] == pytest.approx(frame.asked.force.numpy())
        assert data["displacement [m]"] == pytest.approx(frame.displacement.numpy())
        stress = data["von Mises stress [Pa]"][body.surface.nodes]
        assert stress == pytest.approx(frame.values)
        assert data["det F"].min() > 0
    again = recording.save_series(tmp_path)
    assert again != path
    assert path.exists()


@pytest.mark.parametrize("kind", [".gif", ".mp4"])
def test_a_film_is_as_long_as_it_took(recording, body, tmp_path, kind):
    if kind == ".mp4":
        pytest.importorskip("imageio_ffmpeg", reason="the extra viewer is not installed")
    scenery = Renderer(body.surface, Camera.before(body.surface), (320, 180))
    path = recording.save_film(tmp_path, scenery, kind)
    if kind == ".gif":
        image = Image.open(path)
        times = 0
        for k in range(image.n_frames):
            image.seek(k)
            times += image.info["duration"]
        assert times / 1000 == pytest.approx(0.5, abs=2 / RATE)
        assert image.size == (320, 180)
    else:
        import imageio_ffmpeg

        frames, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
        assert frames == pytest.approx(0.5 * RATE, abs=2)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_frames_are_taken_while_it_runs_and_there_is_room(recording, body):
    frame = recording.frames()[0][1]
    recording.take(frame, 11.0)
    assert len(recording) == 3
    recording.start()
    for k in range(MOST + 5):
        recording.take(frame, float(k))
    assert len(recording) == MOST
    assert not recording.running


def test_frames_of_a_film_are_the_last_shown_by_then(recording):
    frames = recording.frames()
    chosen = evenly(frames)
    assert chosen[0] is frames[0][1]
    assert chosen[round(0.3 * RATE)] is frames[1][1]
    assert chosen[-1] is frames[-1][1]


def test_nothing_is_not_written(body, tmp_path):
    with pytest.raises(ValueError, match="nothing is recorded yet"):
        Recording(body).save_series(tmp_path)


def test_a_picture_shows_the_body_where_the_camera_sees_it(body):
    scenery = Renderer(body.surface, Camera.before(body.surface), (320, 180))
    frame = body.answer(body.sample(1), ViewSettings())
    picture = np.asarray(scenery.draw(frame.points, frame.values, 1.0, frame.quantity, []))
    paper = picture[0, 0].astype(int)
    drawn = np.abs(picture.astype(int) - paper).sum(axis=2) > 30
    assert 0.05 < drawn[:, :250].mean() < 0.6
    again = scenery.draw(body.surface.rest, frame.values, 1.0, frame.quantity, [])
    assert np.abs(np.asarray(again).astype(int) - picture).max() > 50


@pytest.mark.slow
def test_the_moving_load_becomes_a_loop(body, tmp_path):
    path = tmp_path / "live.gif"
    animate_load(body, path, size=(320, 180))
    image = Image.open(path)
    assert image.n_frames == 5 * RATE
    assert image.info["loop"] == 0
