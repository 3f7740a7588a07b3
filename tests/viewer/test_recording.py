"""Recordings contain the frames that were shown."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import meshio
import numpy as np
import pytest
import torch
from PIL import Image

from dpl.fem import PatchLoads
from dpl.viewer.frames import ViewSettings
from dpl.viewer.recording import (
    DURATION,
    FRAME_RATE,
    MAX_FRAMES,
    Recording,
    animate_load,
    resample,
    rotating_load,
)
from dpl.viewer.renderer import Renderer


@pytest.fixture
def recording(body):
    """Three frames in half a second."""
    recording = Recording(body)
    recording.start()
    for index, now in ((1, 10.0), (2, 10.2), (3, 10.5)):
        recording.add(
            body.solve(body.sample(index), ViewSettings(quantity="von Mises stress")), now
        )
    recording.running = False
    return recording


def test_a_series_contains_forces_displacements_stresses_and_volume_ratios(
    recording, body, tmp_path
):
    path = recording.save_series(tmp_path)
    sets = ET.parse(path).getroot().findall(".//DataSet")
    assert [float(one.get("timestep")) for one in sets] == pytest.approx([0.0, 0.2, 0.5])
    for one, (_, frame) in zip(sets, recording.frames, strict=True):
        found = meshio.read(path.parent / one.get("file"))
        assert np.ptp(found.points[:, 0]) == pytest.approx(100.0)
        data = found.point_data
        assert data["force [N]"] == pytest.approx(frame.request.force.numpy())
        assert data["displacement [m]"] == pytest.approx(frame.displacement.numpy())
        stress = data["von Mises stress [Pa]"][body.surface.nodes]
        assert stress == pytest.approx(frame.values)
        assert data["det F"].min() > 0
    again = recording.save_series(tmp_path)
    assert again != path
    assert path.exists()


def test_a_series_of_a_grasp_contains_the_forces_of_the_gripper(body, tip, tmp_path):
    motion = torch.tensor([0.0, 0.0, 0.05]).double()
    request = body.grasp(body.patch(tip, 0.3).held_nodes, motion, 0 * motion)
    frame, recording = body.solve(request, ViewSettings()), Recording(body)
    recording.start()
    recording.add(frame, 0.0)
    path = recording.save_series(tmp_path)
    data = meshio.read(path.with_suffix("") / "frame_0000.vtu").point_data
    assert data["force [N]"] == pytest.approx(frame.grasp.nodal_force)
    assert np.linalg.norm(data["force [N]"].sum(axis=0)) > 1.0
    assert data["displacement [m]"] == pytest.approx(frame.grasp.displacement)
    renderer = Renderer.fitting(body, [frame], (640, 360))
    assert is_red(np.asarray(renderer.render(frame, 1.0, []))).sum() > 40, "an arrow of the force"


@pytest.mark.parametrize("kind", [".gif", ".mp4"])
def test_an_animation_has_the_duration_of_the_recording(recording, body, tmp_path, kind):
    if kind == ".mp4":
        pytest.importorskip("imageio_ffmpeg", reason="the extra viewer is not installed")
    path = recording.save_animation(tmp_path, kind, (320, 180))
    if kind == ".gif":
        image = Image.open(path)
        times = 0
        for k in range(image.n_frames):
            image.seek(k)
            times += image.info["duration"]
        assert times / 1000 == pytest.approx(0.5, abs=2 / FRAME_RATE)
        assert image.size == (320, 180)
    else:
        import imageio_ffmpeg

        frames, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
        assert frames == pytest.approx(0.5 * FRAME_RATE, abs=2)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_frames_are_added_while_recording_up_to_the_limit(recording, body, tmp_path):
    frames = recording.frames
    chosen = resample(frames)
    assert chosen[0] is frames[0][1], "the last frame that was shown before each tick"
    assert chosen[round(0.3 * FRAME_RATE)] is frames[1][1]
    assert chosen[-1] is frames[-1][1]
    recording.add(chosen[0], 11.0)
    assert len(recording.frames) == 3
    recording.start()
    with pytest.raises(ValueError, match="the recording is empty"):
        recording.save_series(tmp_path)
    for k in range(MAX_FRAMES + 5):
        recording.add(chosen[0], float(k))
    assert len(recording.frames) == MAX_FRAMES
    assert not recording.running


def is_red(picture):
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (red > 170) & (green < 60) & (blue < 80)


def test_an_image_shows_the_deformed_body_and_the_arrow_of_its_load(body):
    frame = body.solve(body.sample(1), ViewSettings())
    renderer = Renderer.fitting(body, [frame], (640, 360))
    picture = np.asarray(renderer.render(frame, 1.0, []))
    background = picture[0, 0].astype(int)
    pixels = renderer.camera.project(frame.points, 640, 360)[:, :2]
    assert ((pixels > 0) & (pixels < (640, 360))).all(), "the camera shows the whole body"
    drawn = np.abs(picture.astype(int) - background).sum(axis=2) > 30
    assert 0.05 < drawn[:, :500].mean() < 0.6
    rest = renderer.render(frame._replace(points=body.surface.undeformed), 1.0, [])
    assert np.abs(np.asarray(rest).astype(int) - picture).max() > 50
    assert is_red(picture).sum() > 40, "an arrow of the load"
    zero = replace(frame.request, force=0 * frame.request.force)
    unloaded = np.asarray(renderer.render(frame._replace(request=zero), 1.0, []))
    assert not is_red(unloaded).any()


def test_an_image_of_a_body_at_rest_is_grey_and_has_no_legend(body):
    frame = body.solve(body.zero_load(), ViewSettings())
    renderer = Renderer.fitting(body, [frame], (640, 360))
    picture = np.asarray(renderer.render(frame, 0.0, [])).astype(int)
    assert np.ptp(picture, axis=2).max() < 50, "neutral colours"
    with_legend = np.asarray(renderer.render(frame, 1.0, []))[:, 560:]
    assert (picture[:, 560:] == picture[0, 0]).all()
    assert (with_legend != picture[0, 0]).any()


@pytest.mark.parametrize("family", ["modes", "discs"])
def test_the_rotating_load_is_in_the_training_range(scene, make_body, family):
    if family == "discs":
        discs = PatchLoads(scene.loads.linear, young=4500.0, deflection=0.1)
        scene = replace(scene, loads=discs)
    body = make_body(scene)
    request_at = rotating_load(body)
    frames = [body.solve(request_at(DURATION * k / 7), ViewSettings()) for k in range(1, 7)]
    assert not any(frame.answer.out_of_distribution for frame in frames)
    largest = max(float(frame.displacement.abs().max()) for frame in frames)
    assert largest > 0.02 * body.scene.length
    first, again = request_at(DURATION / 7).force, request_at(DURATION * 8 / 7).force
    assert torch.allclose(again, first, atol=1e-9 * float(first.abs().max()))


@pytest.mark.slow
def test_a_rotating_load_is_written_as_a_looping_gif(body, tmp_path):
    path = tmp_path / "live.gif"
    animate_load(body, path, size=(320, 180))
    image = Image.open(path)
    assert image.n_frames == 5 * FRAME_RATE
    assert image.info["loop"] == 0
