from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class FrameLabel(_message.Message):
    __slots__ = ("sequence", "pattern_set", "slot", "epoch", "exposure_us", "trigger_ns", "camera_frame_id")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    PATTERN_SET_FIELD_NUMBER: _ClassVar[int]
    SLOT_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_US_FIELD_NUMBER: _ClassVar[int]
    TRIGGER_NS_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    pattern_set: str
    slot: int
    epoch: int
    exposure_us: float
    trigger_ns: int
    camera_frame_id: int
    def __init__(self, sequence: _Optional[int] = ..., pattern_set: _Optional[str] = ..., slot: _Optional[int] = ..., epoch: _Optional[int] = ..., exposure_us: _Optional[float] = ..., trigger_ns: _Optional[int] = ..., camera_frame_id: _Optional[int] = ...) -> None: ...

class CloudLabel(_message.Message):
    __slots__ = ("sequence", "width", "height", "window_frames", "newest_stamp_ns", "epoch", "pattern_set", "grid_px", "valid_count", "slot_slips")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WINDOW_FRAMES_FIELD_NUMBER: _ClassVar[int]
    NEWEST_STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    PATTERN_SET_FIELD_NUMBER: _ClassVar[int]
    GRID_PX_FIELD_NUMBER: _ClassVar[int]
    VALID_COUNT_FIELD_NUMBER: _ClassVar[int]
    SLOT_SLIPS_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    width: int
    height: int
    window_frames: int
    newest_stamp_ns: int
    epoch: int
    pattern_set: str
    grid_px: float
    valid_count: int
    slot_slips: int
    def __init__(self, sequence: _Optional[int] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., window_frames: _Optional[int] = ..., newest_stamp_ns: _Optional[int] = ..., epoch: _Optional[int] = ..., pattern_set: _Optional[str] = ..., grid_px: _Optional[float] = ..., valid_count: _Optional[int] = ..., slot_slips: _Optional[int] = ...) -> None: ...

class DepthLabel(_message.Message):
    __slots__ = ("sequence", "scale_mm", "offset_mm", "grid_px")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SCALE_MM_FIELD_NUMBER: _ClassVar[int]
    OFFSET_MM_FIELD_NUMBER: _ClassVar[int]
    GRID_PX_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    scale_mm: float
    offset_mm: float
    grid_px: float
    def __init__(self, sequence: _Optional[int] = ..., scale_mm: _Optional[float] = ..., offset_mm: _Optional[float] = ..., grid_px: _Optional[float] = ...) -> None: ...

class PoseHealth(_message.Message):
    __slots__ = ("sequence", "state", "information", "sigma_weak_um", "weak_direction", "inlier_share", "residual_um", "photometric_share", "submap", "newest_stamp_ns")
    class Tracking(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        UNSPECIFIED: _ClassVar[PoseHealth.Tracking]
        TRACKING: _ClassVar[PoseHealth.Tracking]
        DEGENERATE: _ClassVar[PoseHealth.Tracking]
        LOST: _ClassVar[PoseHealth.Tracking]
        RELOCALISED: _ClassVar[PoseHealth.Tracking]
    UNSPECIFIED: PoseHealth.Tracking
    TRACKING: PoseHealth.Tracking
    DEGENERATE: PoseHealth.Tracking
    LOST: PoseHealth.Tracking
    RELOCALISED: PoseHealth.Tracking
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    INFORMATION_FIELD_NUMBER: _ClassVar[int]
    SIGMA_WEAK_UM_FIELD_NUMBER: _ClassVar[int]
    WEAK_DIRECTION_FIELD_NUMBER: _ClassVar[int]
    INLIER_SHARE_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_UM_FIELD_NUMBER: _ClassVar[int]
    PHOTOMETRIC_SHARE_FIELD_NUMBER: _ClassVar[int]
    SUBMAP_FIELD_NUMBER: _ClassVar[int]
    NEWEST_STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    state: PoseHealth.Tracking
    information: _containers.RepeatedScalarFieldContainer[float]
    sigma_weak_um: float
    weak_direction: _containers.RepeatedScalarFieldContainer[float]
    inlier_share: float
    residual_um: float
    photometric_share: float
    submap: int
    newest_stamp_ns: int
    def __init__(self, sequence: _Optional[int] = ..., state: _Optional[_Union[PoseHealth.Tracking, str]] = ..., information: _Optional[_Iterable[float]] = ..., sigma_weak_um: _Optional[float] = ..., weak_direction: _Optional[_Iterable[float]] = ..., inlier_share: _Optional[float] = ..., residual_um: _Optional[float] = ..., photometric_share: _Optional[float] = ..., submap: _Optional[int] = ..., newest_stamp_ns: _Optional[int] = ...) -> None: ...

class PartHealth(_message.Message):
    __slots__ = ("sequence", "state", "tracking", "information", "sigma_weak_um", "weak_direction", "inlier_share", "residual_um", "model")
    class Fit(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        UNSPECIFIED: _ClassVar[PartHealth.Fit]
        SEARCHING: _ClassVar[PartHealth.Fit]
        ALIGNED: _ClassVar[PartHealth.Fit]
        DEGENERATE: _ClassVar[PartHealth.Fit]
        LOST: _ClassVar[PartHealth.Fit]
    UNSPECIFIED: PartHealth.Fit
    SEARCHING: PartHealth.Fit
    ALIGNED: PartHealth.Fit
    DEGENERATE: PartHealth.Fit
    LOST: PartHealth.Fit
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    TRACKING_FIELD_NUMBER: _ClassVar[int]
    INFORMATION_FIELD_NUMBER: _ClassVar[int]
    SIGMA_WEAK_UM_FIELD_NUMBER: _ClassVar[int]
    WEAK_DIRECTION_FIELD_NUMBER: _ClassVar[int]
    INLIER_SHARE_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_UM_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    state: PartHealth.Fit
    tracking: PoseHealth.Tracking
    information: _containers.RepeatedScalarFieldContainer[float]
    sigma_weak_um: float
    weak_direction: _containers.RepeatedScalarFieldContainer[float]
    inlier_share: float
    residual_um: float
    model: str
    def __init__(self, sequence: _Optional[int] = ..., state: _Optional[_Union[PartHealth.Fit, str]] = ..., tracking: _Optional[_Union[PoseHealth.Tracking, str]] = ..., information: _Optional[_Iterable[float]] = ..., sigma_weak_um: _Optional[float] = ..., weak_direction: _Optional[_Iterable[float]] = ..., inlier_share: _Optional[float] = ..., residual_um: _Optional[float] = ..., model: _Optional[str] = ...) -> None: ...

class MapLabel(_message.Message):
    __slots__ = ("sequence", "removed", "revision", "reset", "map_points", "merging_distance_mm")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    REMOVED_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    RESET_FIELD_NUMBER: _ClassVar[int]
    MAP_POINTS_FIELD_NUMBER: _ClassVar[int]
    MERGING_DISTANCE_MM_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    removed: bytes
    revision: int
    reset: bool
    map_points: int
    merging_distance_mm: float
    def __init__(self, sequence: _Optional[int] = ..., removed: _Optional[bytes] = ..., revision: _Optional[int] = ..., reset: bool = ..., map_points: _Optional[int] = ..., merging_distance_mm: _Optional[float] = ...) -> None: ...

class RigLabel(_message.Message):
    __slots__ = ("T_projector_camera", "yaml")
    T_PROJECTOR_CAMERA_FIELD_NUMBER: _ClassVar[int]
    YAML_FIELD_NUMBER: _ClassVar[int]
    T_projector_camera: _containers.RepeatedScalarFieldContainer[float]
    yaml: str
    def __init__(self, T_projector_camera: _Optional[_Iterable[float]] = ..., yaml: _Optional[str] = ...) -> None: ...

class Mode(_message.Message):
    __slots__ = ("timestamp", "mode", "pattern_set", "epoch", "start_ns", "frame_period_ns", "exposure_us", "running")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    PATTERN_SET_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    START_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_PERIOD_NS_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_US_FIELD_NUMBER: _ClassVar[int]
    RUNNING_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    mode: str
    pattern_set: str
    epoch: int
    start_ns: int
    frame_period_ns: int
    exposure_us: float
    running: bool
    def __init__(self, timestamp: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., mode: _Optional[str] = ..., pattern_set: _Optional[str] = ..., epoch: _Optional[int] = ..., start_ns: _Optional[int] = ..., frame_period_ns: _Optional[int] = ..., exposure_us: _Optional[float] = ..., running: bool = ...) -> None: ...

class Truth(_message.Message):
    __slots__ = ("timestamp", "sequence", "T_scene_camera", "scene", "slow_motion")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    T_SCENE_CAMERA_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SLOW_MOTION_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    sequence: int
    T_scene_camera: _containers.RepeatedScalarFieldContainer[float]
    scene: str
    slow_motion: float
    def __init__(self, timestamp: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., sequence: _Optional[int] = ..., T_scene_camera: _Optional[_Iterable[float]] = ..., scene: _Optional[str] = ..., slow_motion: _Optional[float] = ...) -> None: ...

class Status(_message.Message):
    __slots__ = ("timestamp", "service", "host", "pid", "state", "note", "rate_hz", "latency_p50_ms", "latency_p99_ms", "cpu_share", "memory_mb", "received", "published", "dropped", "values")
    class State(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        UNSPECIFIED: _ClassVar[Status.State]
        STARTING: _ClassVar[Status.State]
        READY: _ClassVar[Status.State]
        RUNNING: _ClassVar[Status.State]
        DEGRADED: _ClassVar[Status.State]
        FAILED: _ClassVar[Status.State]
        STOPPED: _ClassVar[Status.State]
    UNSPECIFIED: Status.State
    STARTING: Status.State
    READY: Status.State
    RUNNING: Status.State
    DEGRADED: Status.State
    FAILED: Status.State
    STOPPED: Status.State
    class ReceivedEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    class PublishedEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    class DroppedEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    class ValuesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    SERVICE_FIELD_NUMBER: _ClassVar[int]
    HOST_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    NOTE_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    LATENCY_P50_MS_FIELD_NUMBER: _ClassVar[int]
    LATENCY_P99_MS_FIELD_NUMBER: _ClassVar[int]
    CPU_SHARE_FIELD_NUMBER: _ClassVar[int]
    MEMORY_MB_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_FIELD_NUMBER: _ClassVar[int]
    PUBLISHED_FIELD_NUMBER: _ClassVar[int]
    DROPPED_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    service: str
    host: str
    pid: int
    state: Status.State
    note: str
    rate_hz: float
    latency_p50_ms: float
    latency_p99_ms: float
    cpu_share: float
    memory_mb: float
    received: _containers.ScalarMap[str, int]
    published: _containers.ScalarMap[str, int]
    dropped: _containers.ScalarMap[str, int]
    values: _containers.ScalarMap[str, float]
    def __init__(self, timestamp: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., service: _Optional[str] = ..., host: _Optional[str] = ..., pid: _Optional[int] = ..., state: _Optional[_Union[Status.State, str]] = ..., note: _Optional[str] = ..., rate_hz: _Optional[float] = ..., latency_p50_ms: _Optional[float] = ..., latency_p99_ms: _Optional[float] = ..., cpu_share: _Optional[float] = ..., memory_mb: _Optional[float] = ..., received: _Optional[_Mapping[str, int]] = ..., published: _Optional[_Mapping[str, int]] = ..., dropped: _Optional[_Mapping[str, int]] = ..., values: _Optional[_Mapping[str, float]] = ...) -> None: ...
