"""A log opens in Rerun as it is: its own reader finds images, clouds, transforms and pinholes in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rerun.chunk import McapReader
from scans import K, messages, pose_of

from endo3d.schemas.messages import Cloud, Frame, MapDelta
from endo3d.services.views.colour import TABLES, packed


def column(log: Path, entity: str, name: str) -> list[object]:
    """All values of one component, in order of time."""
    values: list[object] = []
    for chunk in McapReader(log).stream().to_chunks():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and name in batch.schema.names:
            values += [value for value in batch.column(name).to_pylist() if value is not None]
    return values


def test_frames_are_grey_images(log: Path) -> None:
    frames = [message for message in messages(4) if isinstance(message, Frame)]
    buffers = column(log, "/frame", "Image:buffer")
    assert len(buffers) == 4
    for frame, (buffer,) in zip(frames, buffers, strict=True):
        np.testing.assert_array_equal(np.frombuffer(bytes(buffer), np.uint8).reshape(300, 480), frame.image)
    ((form,), *_) = column(log, "/frame", "Image:format")
    assert (form["width"], form["height"], form["color_model"]) == (480, 300, 1)  # 1 = L, grey


def test_clouds_are_points(log: Path) -> None:
    cloud = next(message for message in messages(4) if isinstance(message, Cloud))
    positions = np.array(column(log, "/cloud", "Points3D:positions")[0])
    valid = cloud.points[np.isfinite(cloud.points["z"])]
    finite = positions[np.isfinite(positions).all(axis=1)]
    np.testing.assert_array_equal(finite, np.stack([valid[a] for a in "xyz"], axis=1))


def test_the_map_has_its_colours_by_height(log: Path) -> None:
    delta = next(message for message in messages(4) if isinstance(message, MapDelta))
    colours = np.array(column(log, "/map", "Points3D:colors")[0])
    rgb = TABLES["height"][np.clip((21 - delta.points["z"]) * (255 / 2), 0, 255).astype(np.uint8)]
    np.testing.assert_array_equal(colours, packed(rgb))
    assert len(np.unique(colours)) > 50


def test_depth_maps_are_images_too(log: Path) -> None:
    assert len(column(log, "/depth", "Image:buffer")) == 4


def test_transforms_and_poses_are_where_they_were(log: Path) -> None:
    translations = [value for (value,) in column(log, "/transform", "Transform3D:translation")]
    np.testing.assert_allclose(translations, [pose_of(k)[:3, 3] for k in range(4)], atol=1e-6)
    assert len(column(log, "/pose", "InstancePoses3D:translations")) == 4


def test_calibration_is_a_pinhole(log: Path) -> None:
    (((*columns,),),) = column(log, "/calibration/camera", "Pinhole:image_from_camera")
    np.testing.assert_allclose(np.reshape(columns, (3, 3)).T, K, rtol=1e-6)
    assert column(log, "/calibration/projector", "Pinhole:image_from_camera")


def test_words_are_a_text_log(log: Path) -> None:
    assert [text for (text,) in column(log, "/log/decoder", "TextLog:text")] == [f"frame {k}" for k in range(4)]
