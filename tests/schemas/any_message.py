"""Hypothesis strategies: any message of any topic, and when two messages are equal."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from endo3d.schemas import messages as m
from endo3d.schemas import topics

MAP_POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz", "intensity", "sigma")]
    + [("count", "<u2")]
    + [(name, "<i2") for name in ("kx", "ky", "kz")]
)
POINT_TYPES = ("<f4", "<f8", "<u2", "<i2", "<u1", "<i1", "<u4", "<i4")

stamps = st.integers(-(2**62), 2**62)
counts = st.integers(0, 2**64 - 1)
small_counts = st.integers(0, 2**32 - 1)
texts = st.text(st.characters(exclude_categories=("Cs",)), max_size=40)
figures = st.floats(width=64)
finite = st.floats(allow_nan=False, allow_infinity=False)
sizes = st.floats(min_value=1e-9, max_value=1e9)
coordinates = st.floats(-1e6, 1e6)


def matrices(*shape: int, elements: st.SearchStrategy[float] = figures) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.float64, shape, elements=elements)


def images(*kinds: str) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(st.sampled_from(kinds), hnp.array_shapes(min_dims=2, max_dims=2, max_side=20))


def records(dtype: np.dtype, dims: int, smallest: int) -> st.SearchStrategy[np.ndarray]:
    """Points whose bytes are arbitrary: NaN payloads and infinities too."""
    shapes = hnp.array_shapes(min_dims=dims, max_dims=dims, min_side=smallest, max_side=12)

    def of_shape(shape: tuple[int, ...]) -> st.SearchStrategy[np.ndarray]:
        size = int(np.prod(shape)) * dtype.itemsize
        return st.binary(min_size=size, max_size=size).map(
            lambda raw: np.frombuffer(raw, dtype).reshape(shape)
        )

    return shapes.flatmap(of_shape)


names = st.text(st.characters(codec="ascii", categories=("L", "N")), min_size=1, max_size=12)
dtypes = st.lists(
    st.tuples(names, st.sampled_from(POINT_TYPES)), min_size=1, max_size=12, unique_by=lambda f: f[0]
).map(np.dtype)


@st.composite
def transforms(draw: st.DrawFn) -> np.ndarray:
    quaternion = draw(
        hnp.arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-3)
    )
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    T[:3, 3] = draw(matrices(3, elements=coordinates))
    return T


frames = st.builds(
    m.Frame,
    stamp_ns=stamps,
    sequence=counts,
    image=images("|u1", "<u2"),
    pattern_set=texts,
    slot=st.integers(-1, 1000),
    epoch=counts,
    exposure_us=figures,
    trigger_ns=stamps,
    camera_frame_id=counts,
    frame_id=texts,
)
clouds = st.builds(
    m.Cloud,
    stamp_ns=stamps,
    sequence=counts,
    points=records(m.POINT, dims=2, smallest=1),
    window_frames=small_counts,
    newest_stamp_ns=stamps,
    epoch=counts,
    pattern_set=texts,
    grid_px=sizes,
    valid_count=counts,
    slot_slips=counts,
    frame_id=texts,
)
depths = st.builds(
    m.DepthMap,
    stamp_ns=stamps,
    sequence=counts,
    depth=images("<u2"),
    scale_mm=sizes,
    offset_mm=finite,
    grid_px=sizes,
    frame_id=texts,
)
poses = st.builds(
    m.Pose,
    stamp_ns=stamps,
    sequence=counts,
    T_world_camera=transforms(),
    information=matrices(6, 6),
    state=st.sampled_from(m.Tracking),
    sigma_weak_um=figures,
    weak_direction=matrices(6),
    inlier_share=figures,
    residual_um=figures,
    photometric_share=figures,
    submap=st.integers(-(2**31), 2**31 - 1),
    newest_stamp_ns=stamps,
    frame_id=texts,
)
part_poses = st.builds(
    m.PartPose,
    stamp_ns=stamps,
    sequence=counts,
    T_part_camera=transforms(),
    information=matrices(6, 6),
    state=st.sampled_from(m.Fit),
    tracking=st.sampled_from(m.Tracking),
    sigma_weak_um=figures,
    weak_direction=matrices(6),
    inlier_share=figures,
    residual_um=figures,
    model=texts,
    frame_id=texts,
)
frame_transforms = st.builds(
    m.Transform, stamp_ns=stamps, parent_frame_id=texts, child_frame_id=texts, T_parent_child=transforms()
)
maps = st.builds(
    m.MapDelta,
    stamp_ns=stamps,
    sequence=counts,
    points=st.one_of(st.just(MAP_POINT), dtypes).flatmap(lambda dtype: records(dtype, dims=1, smallest=0)),
    removed=hnp.arrays(np.int16, st.tuples(st.integers(0, 300), st.just(3))),
    revision=counts,
    reset=st.booleans(),
    map_points=counts,
    merging_distance_mm=sizes,
    frame_id=texts,
)
modes = st.builds(
    m.Mode,
    stamp_ns=stamps,
    mode=texts,
    pattern_set=texts,
    epoch=counts,
    start_ns=stamps,
    frame_period_ns=stamps,
    exposure_us=figures,
    running=st.booleans(),
)
cameras = st.builds(
    m.CameraCalibration,
    stamp_ns=stamps,
    width=small_counts,
    height=small_counts,
    K=matrices(3, 3, elements=finite),
    dist=matrices(5, elements=finite),
    frame_id=texts,
)
projectors = st.builds(
    m.ProjectorCalibration,
    stamp_ns=stamps,
    width=small_counts,
    height=small_counts,
    K=matrices(3, 3, elements=finite),
    dist=matrices(5, elements=finite),
    T_projector_camera=matrices(4, 4, elements=finite),
    yaml=texts,
    frame_id=texts,
)
truths = st.builds(
    m.Truth, stamp_ns=stamps, sequence=counts, T_scene_camera=matrices(4, 4), scene=texts, slow_motion=figures
)
statuses = st.builds(
    m.Status,
    stamp_ns=stamps,
    service=texts,
    host=texts,
    pid=small_counts,
    state=st.sampled_from(m.ServiceState),
    note=texts,
    rate_hz=figures,
    latency_p50_ms=figures,
    latency_p99_ms=figures,
    cpu_share=figures,
    memory_mb=figures,
    received=st.dictionaries(texts, counts, max_size=4),
    published=st.dictionaries(texts, counts, max_size=4),
    dropped=st.dictionaries(texts, counts, max_size=4),
    values=st.dictionaries(texts, figures, max_size=4),
)
lines = st.builds(
    m.LogLine,
    stamp_ns=stamps,
    level=st.sampled_from(m.Level),
    message=texts,
    service=texts,
    file=texts,
    line=small_counts,
)

MESSAGES = {
    topics.FRAME: frames,
    topics.CLOUD: clouds,
    topics.DEPTH: depths,
    topics.POSE: poses,
    topics.PART_POSE: part_poses,
    topics.TRANSFORM: frame_transforms,
    topics.MAP: maps,
    topics.MODE: modes,
    topics.CAMERA: cameras,
    topics.PROJECTOR: projectors,
    topics.TRUTH: truths,
    topics.STATUS: statuses,
    topics.LOG: lines,
}


def example(topic: topics.Topic) -> m.Message:
    """One message of the topic, always the same."""
    return _EXAMPLES[topic]


_T = np.eye(4)
_T[:3] = [[0, -1, 0, 1.5], [1, 0, 0, -2.25], [0, 0, 1, 21.0]]
_K = np.array([[1700.0, 0, 960], [0, 1700, 600], [0, 0, 1]])
_STAMP = 1_760_000_000_123_456_789
_POINTS = np.zeros((3, 5), m.POINT)
for _at, _name in enumerate(m.POINT.names):
    _POINTS[_name] = np.arange(15).reshape(3, 5) + 100 * _at
_POINTS[1, 2] = np.nan
_MAP_POINTS = np.zeros(4, MAP_POINT)
_MAP_POINTS["z"] = [20, 21, 22, 23]
_MAP_POINTS["kx"] = [-400, 0, 400, 1]
_EXAMPLES: dict[topics.Topic, m.Message] = {
    topics.of(message): message
    for message in (
        m.Frame(
            _STAMP,
            41,
            np.arange(24, dtype=np.uint8).reshape(4, 6),
            "interleaved f1=25",
            7,
            3,
            5200.0,
            _STAMP - 2_600_000,
            977,
        ),
        m.Cloud(_STAMP, 41, _POINTS, 25, _STAMP + 72_000_000, 3, "interleaved f1=25", 4.0, 14, 1),
        m.DepthMap(_STAMP, 41, np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000, 0.0005, 5.0, 4.0),
        m.Pose(
            _STAMP,
            41,
            _T,
            np.diag([4.0, 4, 9, 100, 100, 50]),
            m.Tracking.DEGENERATE,
            12.5,
            np.array([0, 0, 0, 0, 0, 1.0]),
            0.75,
            8.5,
            0.25,
            2,
            _STAMP + 72_000_000,
        ),
        m.PartPose(
            _STAMP,
            41,
            _T,
            np.diag([4.0, 4, 9, 100, 100, 50]),
            m.Fit.DEGENERATE,
            m.Tracking.TRACKING,
            12.5,
            np.array([0, 1.0, 0, 0, 0, 0]),
            0.75,
            8.5,
            "blade.stl",
        ),
        m.Transform(_STAMP, "world", "camera", _T),
        m.MapDelta(
            _STAMP,
            41,
            _MAP_POINTS,
            np.array([[1, -2, 3], [-32768, 0, 32767]], np.int16),
            17,
            False,
            1234,
            0.05,
        ),
        m.Mode(_STAMP, "interleaved", "interleaved f1=25", 3, _STAMP + 5, 5_555_556, 5200.0, True),
        m.CameraCalibration(_STAMP, 1920, 1200, _K, np.array([-0.125, 0.0625, 0.001, -0.001, 0.5])),
        m.ProjectorCalibration(_STAMP, 960, 960, _K, np.zeros(5), _T, "camera:\n  width: 1920\n"),
        m.Truth(_STAMP, 41, _T, "contour_standard", 4.3),
        m.Status(
            _STAMP,
            "decoder",
            "rig7",
            4321,
            m.ServiceState.DEGRADED,
            "slow: give it a core",
            171.5,
            11.0,
            19.5,
            0.85,
            312.0,
            {"frame": 1000},
            {"cloud": 990, "depth": 990},
            {"frame:missed": 10},
            {"slips": 1.0},
        ),
        m.LogLine(_STAMP, m.Level.WARNING, "a slot slipped", "decoder", "decoder.py", 88),
    )
}


def assert_equal(one: m.Message, other: m.Message, rotation_tolerance: float = 1e-12) -> None:
    """Field by field, NaN equal to NaN, arrays byte for byte, but a rotation may travel as a quaternion."""
    assert type(one) is type(other)
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if field.name in ("T_world_camera", "T_part_camera", "T_parent_child"):
            np.testing.assert_allclose(a[:3, :3], b[:3, :3], rtol=0, atol=rotation_tolerance)
            np.testing.assert_array_equal(a[:, 3], b[:, 3])
        elif isinstance(a, np.ndarray):
            assert a.shape == b.shape, field.name
            assert a.dtype == b.dtype, field.name
            assert a.tobytes() == b.tobytes(), field.name
        elif isinstance(a, Mapping):
            assert a.keys() == b.keys(), field.name
            np.testing.assert_array_equal([a[key] for key in a], [b[key] for key in a])
        elif isinstance(a, float):
            np.testing.assert_equal(a, b, field.name)
        else:
            assert a == b, field.name
