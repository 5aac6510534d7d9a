import datetime

from google.protobuf import empty_pb2 as _empty_pb2
from google.protobuf import field_mask_pb2 as _field_mask_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ArrayEncoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ARRAY_ENCODING_UNSPECIFIED: _ClassVar[ArrayEncoding]
    ARRAY_ENCODING_FLOAT32: _ClassVar[ArrayEncoding]
    ARRAY_ENCODING_FLOAT64: _ClassVar[ArrayEncoding]
    ARRAY_ENCODING_FLOAT16: _ClassVar[ArrayEncoding]
    ARRAY_ENCODING_QUANTISED_16: _ClassVar[ArrayEncoding]
    ARRAY_ENCODING_QUANTISED_8: _ClassVar[ArrayEncoding]
    ARRAY_ENCODING_INT32: _ClassVar[ArrayEncoding]
    ARRAY_ENCODING_UINT32: _ClassVar[ArrayEncoding]
    ARRAY_ENCODING_BOOL: _ClassVar[ArrayEncoding]

class TrackerState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRACKER_STATE_UNSPECIFIED: _ClassVar[TrackerState]
    TRACKER_STATE_INITIALIZING: _ClassVar[TrackerState]
    TRACKER_STATE_TRACKING: _ClassVar[TrackerState]
    TRACKER_STATE_RECOVERING: _ClassVar[TrackerState]
    TRACKER_STATE_LOST: _ClassVar[TrackerState]

class SessionState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SESSION_STATE_UNSPECIFIED: _ClassVar[SessionState]
    SESSION_STATE_INITIALIZING: _ClassVar[SessionState]
    SESSION_STATE_TRACKING: _ClassVar[SessionState]
    SESSION_STATE_RECOVERING: _ClassVar[SessionState]
    SESSION_STATE_LOST: _ClassVar[SessionState]
    SESSION_STATE_IDLE: _ClassVar[SessionState]
    SESSION_STATE_EXPIRED: _ClassVar[SessionState]
    SESSION_STATE_CLOSED: _ClassVar[SessionState]

class FlowMode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    FLOW_MODE_UNSPECIFIED: _ClassVar[FlowMode]
    FLOW_MODE_REALTIME: _ClassVar[FlowMode]
    FLOW_MODE_LOSSLESS: _ClassVar[FlowMode]

class SessionView(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SESSION_VIEW_UNSPECIFIED: _ClassVar[SessionView]
    SESSION_VIEW_BASIC: _ClassVar[SessionView]
    SESSION_VIEW_FULL: _ClassVar[SessionView]

class PointCodec(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    POINT_CODEC_UNSPECIFIED: _ClassVar[PointCodec]
    POINT_CODEC_RAW_FLOAT32: _ClassVar[PointCodec]
    POINT_CODEC_QUANTISED_16: _ClassVar[PointCodec]
    POINT_CODEC_MORTON_ZSTD: _ClassVar[PointCodec]
    POINT_CODEC_MORTON_DEFLATE: _ClassVar[PointCodec]
    POINT_CODEC_DRACO: _ClassVar[PointCodec]

class DepthEncoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DEPTH_ENCODING_UNSPECIFIED: _ClassVar[DepthEncoding]
    DEPTH_ENCODING_FLOAT32_METRES: _ClassVar[DepthEncoding]
    DEPTH_ENCODING_UINT16_MILLIMETRES: _ClassVar[DepthEncoding]

class DepthCompression(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DEPTH_COMPRESSION_UNSPECIFIED: _ClassVar[DepthCompression]
    DEPTH_COMPRESSION_NONE: _ClassVar[DepthCompression]
    DEPTH_COMPRESSION_ZSTD: _ClassVar[DepthCompression]
    DEPTH_COMPRESSION_PNG: _ClassVar[DepthCompression]
    DEPTH_COMPRESSION_RVL: _ClassVar[DepthCompression]

class WarningCode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    WARNING_CODE_UNSPECIFIED: _ClassVar[WarningCode]
    WARNING_CODE_SENSOR_ORIGIN_MISSING: _ClassVar[WarningCode]
    WARNING_CODE_NOTHING_IN_REACH: _ClassVar[WarningCode]
    WARNING_CODE_LENGTH_UNIT: _ClassVar[WarningCode]
    WARNING_CODE_TIME_UNIT: _ClassVar[WarningCode]
    WARNING_CODE_STALE_CLOCK: _ClassVar[WarningCode]
    WARNING_CODE_UPSIDE_DOWN: _ClassVar[WarningCode]
    WARNING_CODE_MIRRORED: _ClassVar[WarningCode]
    WARNING_CODE_POINTS_BEHIND_SENSOR: _ClassVar[WarningCode]
    WARNING_CODE_BODY_APART: _ClassVar[WarningCode]
    WARNING_CODE_CLOCK_JUMP: _ClassVar[WarningCode]
    WARNING_CODE_HEADING_UNCERTAIN: _ClassVar[WarningCode]
    WARNING_CODE_WRONG_UP: _ClassVar[WarningCode]
    WARNING_CODE_SPLIT_SEAMS: _ClassVar[WarningCode]
    WARNING_CODE_BODY_OFF: _ClassVar[WarningCode]
    WARNING_CODE_SENSORS_OFF: _ClassVar[WarningCode]
    WARNING_CODE_GARMENT_SIZE: _ClassVar[WarningCode]
    WARNING_CODE_WHOLE_PERSON: _ClassVar[WarningCode]
    WARNING_CODE_NARROW_MASK: _ClassVar[WarningCode]

class NoticeKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    NOTICE_KIND_UNSPECIFIED: _ClassVar[NoticeKind]
    NOTICE_KIND_DRAINING: _ClassVar[NoticeKind]
    NOTICE_KIND_SLOW_DOWN: _ClassVar[NoticeKind]
    NOTICE_KIND_RECONNECT: _ClassVar[NoticeKind]
    NOTICE_KIND_RESUMED: _ClassVar[NoticeKind]
    NOTICE_KIND_WAITING: _ClassVar[NoticeKind]
ARRAY_ENCODING_UNSPECIFIED: ArrayEncoding
ARRAY_ENCODING_FLOAT32: ArrayEncoding
ARRAY_ENCODING_FLOAT64: ArrayEncoding
ARRAY_ENCODING_FLOAT16: ArrayEncoding
ARRAY_ENCODING_QUANTISED_16: ArrayEncoding
ARRAY_ENCODING_QUANTISED_8: ArrayEncoding
ARRAY_ENCODING_INT32: ArrayEncoding
ARRAY_ENCODING_UINT32: ArrayEncoding
ARRAY_ENCODING_BOOL: ArrayEncoding
TRACKER_STATE_UNSPECIFIED: TrackerState
TRACKER_STATE_INITIALIZING: TrackerState
TRACKER_STATE_TRACKING: TrackerState
TRACKER_STATE_RECOVERING: TrackerState
TRACKER_STATE_LOST: TrackerState
SESSION_STATE_UNSPECIFIED: SessionState
SESSION_STATE_INITIALIZING: SessionState
SESSION_STATE_TRACKING: SessionState
SESSION_STATE_RECOVERING: SessionState
SESSION_STATE_LOST: SessionState
SESSION_STATE_IDLE: SessionState
SESSION_STATE_EXPIRED: SessionState
SESSION_STATE_CLOSED: SessionState
FLOW_MODE_UNSPECIFIED: FlowMode
FLOW_MODE_REALTIME: FlowMode
FLOW_MODE_LOSSLESS: FlowMode
SESSION_VIEW_UNSPECIFIED: SessionView
SESSION_VIEW_BASIC: SessionView
SESSION_VIEW_FULL: SessionView
POINT_CODEC_UNSPECIFIED: PointCodec
POINT_CODEC_RAW_FLOAT32: PointCodec
POINT_CODEC_QUANTISED_16: PointCodec
POINT_CODEC_MORTON_ZSTD: PointCodec
POINT_CODEC_MORTON_DEFLATE: PointCodec
POINT_CODEC_DRACO: PointCodec
DEPTH_ENCODING_UNSPECIFIED: DepthEncoding
DEPTH_ENCODING_FLOAT32_METRES: DepthEncoding
DEPTH_ENCODING_UINT16_MILLIMETRES: DepthEncoding
DEPTH_COMPRESSION_UNSPECIFIED: DepthCompression
DEPTH_COMPRESSION_NONE: DepthCompression
DEPTH_COMPRESSION_ZSTD: DepthCompression
DEPTH_COMPRESSION_PNG: DepthCompression
DEPTH_COMPRESSION_RVL: DepthCompression
WARNING_CODE_UNSPECIFIED: WarningCode
WARNING_CODE_SENSOR_ORIGIN_MISSING: WarningCode
WARNING_CODE_NOTHING_IN_REACH: WarningCode
WARNING_CODE_LENGTH_UNIT: WarningCode
WARNING_CODE_TIME_UNIT: WarningCode
WARNING_CODE_STALE_CLOCK: WarningCode
WARNING_CODE_UPSIDE_DOWN: WarningCode
WARNING_CODE_MIRRORED: WarningCode
WARNING_CODE_POINTS_BEHIND_SENSOR: WarningCode
WARNING_CODE_BODY_APART: WarningCode
WARNING_CODE_CLOCK_JUMP: WarningCode
WARNING_CODE_HEADING_UNCERTAIN: WarningCode
WARNING_CODE_WRONG_UP: WarningCode
WARNING_CODE_SPLIT_SEAMS: WarningCode
WARNING_CODE_BODY_OFF: WarningCode
WARNING_CODE_SENSORS_OFF: WarningCode
WARNING_CODE_GARMENT_SIZE: WarningCode
WARNING_CODE_WHOLE_PERSON: WarningCode
WARNING_CODE_NARROW_MASK: WarningCode
NOTICE_KIND_UNSPECIFIED: NoticeKind
NOTICE_KIND_DRAINING: NoticeKind
NOTICE_KIND_SLOW_DOWN: NoticeKind
NOTICE_KIND_RECONNECT: NoticeKind
NOTICE_KIND_RESUMED: NoticeKind
NOTICE_KIND_WAITING: NoticeKind

class Vector3(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("matrix",)
    MATRIX_FIELD_NUMBER: _ClassVar[int]
    matrix: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, matrix: _Optional[_Iterable[float]] = ...) -> None: ...

class PackedArray(_message.Message):
    __slots__ = ("encoding", "data", "offset", "step")
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    encoding: ArrayEncoding
    data: bytes
    offset: _containers.RepeatedScalarFieldContainer[float]
    step: float
    def __init__(self, encoding: _Optional[_Union[ArrayEncoding, str]] = ..., data: _Optional[bytes] = ..., offset: _Optional[_Iterable[float]] = ..., step: _Optional[float] = ...) -> None: ...

class Mesh(_message.Message):
    __slots__ = ("vertices", "faces")
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    FACES_FIELD_NUMBER: _ClassVar[int]
    vertices: PackedArray
    faces: PackedArray
    def __init__(self, vertices: _Optional[_Union[PackedArray, _Mapping]] = ..., faces: _Optional[_Union[PackedArray, _Mapping]] = ...) -> None: ...

class Session(_message.Message):
    __slots__ = ("name", "labels", "state", "create_time", "config_json", "fabric", "limits", "statistics", "etag", "expire_time", "checkpoint_time", "garment", "body", "garment_mesh", "body_mesh", "garment_vertex_count", "garment_face_count", "body_vertex_count", "vertex_map")
    class LabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    NAME_FIELD_NUMBER: _ClassVar[int]
    LABELS_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    CREATE_TIME_FIELD_NUMBER: _ClassVar[int]
    CONFIG_JSON_FIELD_NUMBER: _ClassVar[int]
    FABRIC_FIELD_NUMBER: _ClassVar[int]
    LIMITS_FIELD_NUMBER: _ClassVar[int]
    STATISTICS_FIELD_NUMBER: _ClassVar[int]
    ETAG_FIELD_NUMBER: _ClassVar[int]
    EXPIRE_TIME_FIELD_NUMBER: _ClassVar[int]
    CHECKPOINT_TIME_FIELD_NUMBER: _ClassVar[int]
    GARMENT_FIELD_NUMBER: _ClassVar[int]
    BODY_FIELD_NUMBER: _ClassVar[int]
    GARMENT_MESH_FIELD_NUMBER: _ClassVar[int]
    BODY_MESH_FIELD_NUMBER: _ClassVar[int]
    GARMENT_VERTEX_COUNT_FIELD_NUMBER: _ClassVar[int]
    GARMENT_FACE_COUNT_FIELD_NUMBER: _ClassVar[int]
    BODY_VERTEX_COUNT_FIELD_NUMBER: _ClassVar[int]
    VERTEX_MAP_FIELD_NUMBER: _ClassVar[int]
    name: str
    labels: _containers.ScalarMap[str, str]
    state: SessionState
    create_time: _timestamp_pb2.Timestamp
    config_json: str
    fabric: str
    limits: SessionLimits
    statistics: SessionStatistics
    etag: str
    expire_time: _timestamp_pb2.Timestamp
    checkpoint_time: _timestamp_pb2.Timestamp
    garment: Mesh
    body: Mesh
    garment_mesh: str
    body_mesh: str
    garment_vertex_count: int
    garment_face_count: int
    body_vertex_count: int
    vertex_map: PackedArray
    def __init__(self, name: _Optional[str] = ..., labels: _Optional[_Mapping[str, str]] = ..., state: _Optional[_Union[SessionState, str]] = ..., create_time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., config_json: _Optional[str] = ..., fabric: _Optional[str] = ..., limits: _Optional[_Union[SessionLimits, _Mapping]] = ..., statistics: _Optional[_Union[SessionStatistics, _Mapping]] = ..., etag: _Optional[str] = ..., expire_time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., checkpoint_time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., garment: _Optional[_Union[Mesh, _Mapping]] = ..., body: _Optional[_Union[Mesh, _Mapping]] = ..., garment_mesh: _Optional[str] = ..., body_mesh: _Optional[str] = ..., garment_vertex_count: _Optional[int] = ..., garment_face_count: _Optional[int] = ..., body_vertex_count: _Optional[int] = ..., vertex_map: _Optional[_Union[PackedArray, _Mapping]] = ...) -> None: ...

class SessionLimits(_message.Message):
    __slots__ = ("max_points", "max_frame_rate", "idle_timeout", "max_lifetime", "max_frames_in_flight", "departure_timeout")
    MAX_POINTS_FIELD_NUMBER: _ClassVar[int]
    MAX_FRAME_RATE_FIELD_NUMBER: _ClassVar[int]
    IDLE_TIMEOUT_FIELD_NUMBER: _ClassVar[int]
    MAX_LIFETIME_FIELD_NUMBER: _ClassVar[int]
    MAX_FRAMES_IN_FLIGHT_FIELD_NUMBER: _ClassVar[int]
    DEPARTURE_TIMEOUT_FIELD_NUMBER: _ClassVar[int]
    max_points: int
    max_frame_rate: float
    idle_timeout: float
    max_lifetime: float
    max_frames_in_flight: int
    departure_timeout: float
    def __init__(self, max_points: _Optional[int] = ..., max_frame_rate: _Optional[float] = ..., idle_timeout: _Optional[float] = ..., max_lifetime: _Optional[float] = ..., max_frames_in_flight: _Optional[int] = ..., departure_timeout: _Optional[float] = ...) -> None: ...

class SessionStatistics(_message.Message):
    __slots__ = ("frames_applied", "frames_dropped", "frames_rejected", "frame_rate", "reliability", "paper_score", "coverage", "last_sequence_number", "last_capture_time", "last_frame_time", "last_latency", "frames_late", "recoveries", "frames_lost", "memory_bytes", "warnings")
    FRAMES_APPLIED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_DROPPED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_REJECTED_FIELD_NUMBER: _ClassVar[int]
    FRAME_RATE_FIELD_NUMBER: _ClassVar[int]
    RELIABILITY_FIELD_NUMBER: _ClassVar[int]
    PAPER_SCORE_FIELD_NUMBER: _ClassVar[int]
    COVERAGE_FIELD_NUMBER: _ClassVar[int]
    LAST_SEQUENCE_NUMBER_FIELD_NUMBER: _ClassVar[int]
    LAST_CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    LAST_FRAME_TIME_FIELD_NUMBER: _ClassVar[int]
    LAST_LATENCY_FIELD_NUMBER: _ClassVar[int]
    FRAMES_LATE_FIELD_NUMBER: _ClassVar[int]
    RECOVERIES_FIELD_NUMBER: _ClassVar[int]
    FRAMES_LOST_FIELD_NUMBER: _ClassVar[int]
    MEMORY_BYTES_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    frames_applied: int
    frames_dropped: int
    frames_rejected: int
    frame_rate: float
    reliability: float
    paper_score: float
    coverage: float
    last_sequence_number: int
    last_capture_time: float
    last_frame_time: _timestamp_pb2.Timestamp
    last_latency: float
    frames_late: int
    recoveries: int
    frames_lost: int
    memory_bytes: int
    warnings: _containers.RepeatedCompositeFieldContainer[WarningCount]
    def __init__(self, frames_applied: _Optional[int] = ..., frames_dropped: _Optional[int] = ..., frames_rejected: _Optional[int] = ..., frame_rate: _Optional[float] = ..., reliability: _Optional[float] = ..., paper_score: _Optional[float] = ..., coverage: _Optional[float] = ..., last_sequence_number: _Optional[int] = ..., last_capture_time: _Optional[float] = ..., last_frame_time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., last_latency: _Optional[float] = ..., frames_late: _Optional[int] = ..., recoveries: _Optional[int] = ..., frames_lost: _Optional[int] = ..., memory_bytes: _Optional[int] = ..., warnings: _Optional[_Iterable[_Union[WarningCount, _Mapping]]] = ...) -> None: ...

class WarningCount(_message.Message):
    __slots__ = ("warning", "frames")
    WARNING_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    warning: Warning
    frames: int
    def __init__(self, warning: _Optional[_Union[Warning, _Mapping]] = ..., frames: _Optional[int] = ...) -> None: ...

class GetServerInfoRequest(_message.Message):
    __slots__ = ("api_version",)
    API_VERSION_FIELD_NUMBER: _ClassVar[int]
    api_version: str
    def __init__(self, api_version: _Optional[str] = ...) -> None: ...

class ServerInfo(_message.Message):
    __slots__ = ("api_version", "server_version", "point_codecs", "depth_compressions", "result_encodings", "fabrics", "max_message_bytes", "max_limits", "max_vertices", "draining", "build", "max_body_vertices")
    API_VERSION_FIELD_NUMBER: _ClassVar[int]
    SERVER_VERSION_FIELD_NUMBER: _ClassVar[int]
    POINT_CODECS_FIELD_NUMBER: _ClassVar[int]
    DEPTH_COMPRESSIONS_FIELD_NUMBER: _ClassVar[int]
    RESULT_ENCODINGS_FIELD_NUMBER: _ClassVar[int]
    FABRICS_FIELD_NUMBER: _ClassVar[int]
    MAX_MESSAGE_BYTES_FIELD_NUMBER: _ClassVar[int]
    MAX_LIMITS_FIELD_NUMBER: _ClassVar[int]
    MAX_VERTICES_FIELD_NUMBER: _ClassVar[int]
    DRAINING_FIELD_NUMBER: _ClassVar[int]
    BUILD_FIELD_NUMBER: _ClassVar[int]
    MAX_BODY_VERTICES_FIELD_NUMBER: _ClassVar[int]
    api_version: str
    server_version: str
    point_codecs: _containers.RepeatedScalarFieldContainer[PointCodec]
    depth_compressions: _containers.RepeatedScalarFieldContainer[DepthCompression]
    result_encodings: _containers.RepeatedScalarFieldContainer[ArrayEncoding]
    fabrics: _containers.RepeatedScalarFieldContainer[str]
    max_message_bytes: int
    max_limits: SessionLimits
    max_vertices: int
    draining: bool
    build: str
    max_body_vertices: int
    def __init__(self, api_version: _Optional[str] = ..., server_version: _Optional[str] = ..., point_codecs: _Optional[_Iterable[_Union[PointCodec, str]]] = ..., depth_compressions: _Optional[_Iterable[_Union[DepthCompression, str]]] = ..., result_encodings: _Optional[_Iterable[_Union[ArrayEncoding, str]]] = ..., fabrics: _Optional[_Iterable[str]] = ..., max_message_bytes: _Optional[int] = ..., max_limits: _Optional[_Union[SessionLimits, _Mapping]] = ..., max_vertices: _Optional[int] = ..., draining: bool = ..., build: _Optional[str] = ..., max_body_vertices: _Optional[int] = ...) -> None: ...

class CreateSessionRequest(_message.Message):
    __slots__ = ("api_version", "session", "session_id", "request_id", "clean")
    API_VERSION_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    CLEAN_FIELD_NUMBER: _ClassVar[int]
    api_version: str
    session: Session
    session_id: str
    request_id: str
    clean: bool
    def __init__(self, api_version: _Optional[str] = ..., session: _Optional[_Union[Session, _Mapping]] = ..., session_id: _Optional[str] = ..., request_id: _Optional[str] = ..., clean: bool = ...) -> None: ...

class GetSessionRequest(_message.Message):
    __slots__ = ("name", "view")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VIEW_FIELD_NUMBER: _ClassVar[int]
    name: str
    view: SessionView
    def __init__(self, name: _Optional[str] = ..., view: _Optional[_Union[SessionView, str]] = ...) -> None: ...

class ListSessionsRequest(_message.Message):
    __slots__ = ("page_size", "page_token", "states", "labels")
    class LabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    STATES_FIELD_NUMBER: _ClassVar[int]
    LABELS_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    states: _containers.RepeatedScalarFieldContainer[SessionState]
    labels: _containers.ScalarMap[str, str]
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ..., states: _Optional[_Iterable[_Union[SessionState, str]]] = ..., labels: _Optional[_Mapping[str, str]] = ...) -> None: ...

class ListSessionsResponse(_message.Message):
    __slots__ = ("sessions", "next_page_token")
    SESSIONS_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    sessions: _containers.RepeatedCompositeFieldContainer[Session]
    next_page_token: str
    def __init__(self, sessions: _Optional[_Iterable[_Union[Session, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class UpdateSessionRequest(_message.Message):
    __slots__ = ("session", "update_mask")
    SESSION_FIELD_NUMBER: _ClassVar[int]
    UPDATE_MASK_FIELD_NUMBER: _ClassVar[int]
    session: Session
    update_mask: _field_mask_pb2.FieldMask
    def __init__(self, session: _Optional[_Union[Session, _Mapping]] = ..., update_mask: _Optional[_Union[_field_mask_pb2.FieldMask, _Mapping]] = ...) -> None: ...

class ResetSessionRequest(_message.Message):
    __slots__ = ("name", "vertices", "velocities")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    VELOCITIES_FIELD_NUMBER: _ClassVar[int]
    name: str
    vertices: PackedArray
    velocities: PackedArray
    def __init__(self, name: _Optional[str] = ..., vertices: _Optional[_Union[PackedArray, _Mapping]] = ..., velocities: _Optional[_Union[PackedArray, _Mapping]] = ...) -> None: ...

class DeleteSessionRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class SnapshotSessionRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class SessionSnapshot(_message.Message):
    __slots__ = ("session", "data")
    SESSION_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    session: Session
    data: bytes
    def __init__(self, session: _Optional[_Union[Session, _Mapping]] = ..., data: _Optional[bytes] = ...) -> None: ...

class RestoreSessionRequest(_message.Message):
    __slots__ = ("api_version", "session", "session_id", "request_id", "data")
    API_VERSION_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    api_version: str
    session: Session
    session_id: str
    request_id: str
    data: bytes
    def __init__(self, api_version: _Optional[str] = ..., session: _Optional[_Union[Session, _Mapping]] = ..., session_id: _Optional[str] = ..., request_id: _Optional[str] = ..., data: _Optional[bytes] = ...) -> None: ...

class WatchSessionRequest(_message.Message):
    __slots__ = ("name", "api_version", "every_nth", "include_frames")
    NAME_FIELD_NUMBER: _ClassVar[int]
    API_VERSION_FIELD_NUMBER: _ClassVar[int]
    EVERY_NTH_FIELD_NUMBER: _ClassVar[int]
    INCLUDE_FRAMES_FIELD_NUMBER: _ClassVar[int]
    name: str
    api_version: str
    every_nth: int
    include_frames: bool
    def __init__(self, name: _Optional[str] = ..., api_version: _Optional[str] = ..., every_nth: _Optional[int] = ..., include_frames: bool = ...) -> None: ...

class GetSessionHistoryRequest(_message.Message):
    __slots__ = ("name", "start_time", "end_time", "resolution", "max_samples")
    NAME_FIELD_NUMBER: _ClassVar[int]
    START_TIME_FIELD_NUMBER: _ClassVar[int]
    END_TIME_FIELD_NUMBER: _ClassVar[int]
    RESOLUTION_FIELD_NUMBER: _ClassVar[int]
    MAX_SAMPLES_FIELD_NUMBER: _ClassVar[int]
    name: str
    start_time: _timestamp_pb2.Timestamp
    end_time: _timestamp_pb2.Timestamp
    resolution: float
    max_samples: int
    def __init__(self, name: _Optional[str] = ..., start_time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., end_time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., resolution: _Optional[float] = ..., max_samples: _Optional[int] = ...) -> None: ...

class HistorySample(_message.Message):
    __slots__ = ("start_time", "frames_applied", "frames_dropped", "frames_late", "frames_rejected", "reliability", "least_reliability", "paper_score", "coverage", "latency", "greatest_latency")
    START_TIME_FIELD_NUMBER: _ClassVar[int]
    FRAMES_APPLIED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_DROPPED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_LATE_FIELD_NUMBER: _ClassVar[int]
    FRAMES_REJECTED_FIELD_NUMBER: _ClassVar[int]
    RELIABILITY_FIELD_NUMBER: _ClassVar[int]
    LEAST_RELIABILITY_FIELD_NUMBER: _ClassVar[int]
    PAPER_SCORE_FIELD_NUMBER: _ClassVar[int]
    COVERAGE_FIELD_NUMBER: _ClassVar[int]
    LATENCY_FIELD_NUMBER: _ClassVar[int]
    GREATEST_LATENCY_FIELD_NUMBER: _ClassVar[int]
    start_time: _timestamp_pb2.Timestamp
    frames_applied: int
    frames_dropped: int
    frames_late: int
    frames_rejected: int
    reliability: float
    least_reliability: float
    paper_score: float
    coverage: float
    latency: float
    greatest_latency: float
    def __init__(self, start_time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., frames_applied: _Optional[int] = ..., frames_dropped: _Optional[int] = ..., frames_late: _Optional[int] = ..., frames_rejected: _Optional[int] = ..., reliability: _Optional[float] = ..., least_reliability: _Optional[float] = ..., paper_score: _Optional[float] = ..., coverage: _Optional[float] = ..., latency: _Optional[float] = ..., greatest_latency: _Optional[float] = ...) -> None: ...

class StateChange(_message.Message):
    __slots__ = ("time", "state")
    TIME_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    time: _timestamp_pb2.Timestamp
    state: SessionState
    def __init__(self, time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., state: _Optional[_Union[SessionState, str]] = ...) -> None: ...

class SessionHistory(_message.Message):
    __slots__ = ("name", "resolution", "samples", "state_changes")
    NAME_FIELD_NUMBER: _ClassVar[int]
    RESOLUTION_FIELD_NUMBER: _ClassVar[int]
    SAMPLES_FIELD_NUMBER: _ClassVar[int]
    STATE_CHANGES_FIELD_NUMBER: _ClassVar[int]
    name: str
    resolution: float
    samples: _containers.RepeatedCompositeFieldContainer[HistorySample]
    state_changes: _containers.RepeatedCompositeFieldContainer[StateChange]
    def __init__(self, name: _Optional[str] = ..., resolution: _Optional[float] = ..., samples: _Optional[_Iterable[_Union[HistorySample, _Mapping]]] = ..., state_changes: _Optional[_Iterable[_Union[StateChange, _Mapping]]] = ...) -> None: ...

class StoredMesh(_message.Message):
    __slots__ = ("name", "vertex_count", "face_count", "bytes", "create_time", "mesh")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERTEX_COUNT_FIELD_NUMBER: _ClassVar[int]
    FACE_COUNT_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    CREATE_TIME_FIELD_NUMBER: _ClassVar[int]
    MESH_FIELD_NUMBER: _ClassVar[int]
    name: str
    vertex_count: int
    face_count: int
    bytes: int
    create_time: _timestamp_pb2.Timestamp
    mesh: Mesh
    def __init__(self, name: _Optional[str] = ..., vertex_count: _Optional[int] = ..., face_count: _Optional[int] = ..., bytes: _Optional[int] = ..., create_time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., mesh: _Optional[_Union[Mesh, _Mapping]] = ...) -> None: ...

class CreateMeshRequest(_message.Message):
    __slots__ = ("api_version", "mesh")
    API_VERSION_FIELD_NUMBER: _ClassVar[int]
    MESH_FIELD_NUMBER: _ClassVar[int]
    api_version: str
    mesh: Mesh
    def __init__(self, api_version: _Optional[str] = ..., mesh: _Optional[_Union[Mesh, _Mapping]] = ...) -> None: ...

class GetMeshRequest(_message.Message):
    __slots__ = ("name", "include_mesh")
    NAME_FIELD_NUMBER: _ClassVar[int]
    INCLUDE_MESH_FIELD_NUMBER: _ClassVar[int]
    name: str
    include_mesh: bool
    def __init__(self, name: _Optional[str] = ..., include_mesh: bool = ...) -> None: ...

class ListMeshesRequest(_message.Message):
    __slots__ = ("page_size", "page_token")
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ...) -> None: ...

class ListMeshesResponse(_message.Message):
    __slots__ = ("meshes", "next_page_token")
    MESHES_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    meshes: _containers.RepeatedCompositeFieldContainer[StoredMesh]
    next_page_token: str
    def __init__(self, meshes: _Optional[_Iterable[_Union[StoredMesh, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class DeleteMeshRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class TrackRequest(_message.Message):
    __slots__ = ("start", "frame", "ping")
    START_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    PING_FIELD_NUMBER: _ClassVar[int]
    start: Start
    frame: Frame
    ping: Ping
    def __init__(self, start: _Optional[_Union[Start, _Mapping]] = ..., frame: _Optional[_Union[Frame, _Mapping]] = ..., ping: _Optional[_Union[Ping, _Mapping]] = ...) -> None: ...

class Start(_message.Message):
    __slots__ = ("name", "api_version", "flow_mode", "result_options", "takeover", "answered_through")
    NAME_FIELD_NUMBER: _ClassVar[int]
    API_VERSION_FIELD_NUMBER: _ClassVar[int]
    FLOW_MODE_FIELD_NUMBER: _ClassVar[int]
    RESULT_OPTIONS_FIELD_NUMBER: _ClassVar[int]
    TAKEOVER_FIELD_NUMBER: _ClassVar[int]
    ANSWERED_THROUGH_FIELD_NUMBER: _ClassVar[int]
    name: str
    api_version: str
    flow_mode: FlowMode
    result_options: ResultOptions
    takeover: bool
    answered_through: int
    def __init__(self, name: _Optional[str] = ..., api_version: _Optional[str] = ..., flow_mode: _Optional[_Union[FlowMode, str]] = ..., result_options: _Optional[_Union[ResultOptions, _Mapping]] = ..., takeover: bool = ..., answered_through: _Optional[int] = ...) -> None: ...

class ResultOptions(_message.Message):
    __slots__ = ("vertex_encoding", "sigma_encoding", "reliability_encoding", "include_velocities", "include_covariance", "every_nth")
    VERTEX_ENCODING_FIELD_NUMBER: _ClassVar[int]
    SIGMA_ENCODING_FIELD_NUMBER: _ClassVar[int]
    RELIABILITY_ENCODING_FIELD_NUMBER: _ClassVar[int]
    INCLUDE_VELOCITIES_FIELD_NUMBER: _ClassVar[int]
    INCLUDE_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    EVERY_NTH_FIELD_NUMBER: _ClassVar[int]
    vertex_encoding: ArrayEncoding
    sigma_encoding: ArrayEncoding
    reliability_encoding: ArrayEncoding
    include_velocities: bool
    include_covariance: bool
    every_nth: int
    def __init__(self, vertex_encoding: _Optional[_Union[ArrayEncoding, str]] = ..., sigma_encoding: _Optional[_Union[ArrayEncoding, str]] = ..., reliability_encoding: _Optional[_Union[ArrayEncoding, str]] = ..., include_velocities: bool = ..., include_covariance: bool = ..., every_nth: _Optional[int] = ...) -> None: ...

class Ping(_message.Message):
    __slots__ = ("token",)
    TOKEN_FIELD_NUMBER: _ClassVar[int]
    token: int
    def __init__(self, token: _Optional[int] = ...) -> None: ...

class Pong(_message.Message):
    __slots__ = ("token", "server_time")
    TOKEN_FIELD_NUMBER: _ClassVar[int]
    SERVER_TIME_FIELD_NUMBER: _ClassVar[int]
    token: int
    server_time: float
    def __init__(self, token: _Optional[int] = ..., server_time: _Optional[float] = ...) -> None: ...

class Frame(_message.Message):
    __slots__ = ("sequence_number", "capture_time", "sensors", "body_vertices", "deadline", "display_time", "point_cloud", "depth_image")
    SEQUENCE_NUMBER_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    SENSORS_FIELD_NUMBER: _ClassVar[int]
    BODY_VERTICES_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_FIELD_NUMBER: _ClassVar[int]
    DISPLAY_TIME_FIELD_NUMBER: _ClassVar[int]
    POINT_CLOUD_FIELD_NUMBER: _ClassVar[int]
    DEPTH_IMAGE_FIELD_NUMBER: _ClassVar[int]
    sequence_number: int
    capture_time: float
    sensors: _containers.RepeatedCompositeFieldContainer[Sensor]
    body_vertices: bytes
    deadline: float
    display_time: float
    point_cloud: PointCloud
    depth_image: DepthImage
    def __init__(self, sequence_number: _Optional[int] = ..., capture_time: _Optional[float] = ..., sensors: _Optional[_Iterable[_Union[Sensor, _Mapping]]] = ..., body_vertices: _Optional[bytes] = ..., deadline: _Optional[float] = ..., display_time: _Optional[float] = ..., point_cloud: _Optional[_Union[PointCloud, _Mapping]] = ..., depth_image: _Optional[_Union[DepthImage, _Mapping]] = ...) -> None: ...

class Sensor(_message.Message):
    __slots__ = ("origin", "pose", "point_count")
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    POINT_COUNT_FIELD_NUMBER: _ClassVar[int]
    origin: Vector3
    pose: Pose
    point_count: int
    def __init__(self, origin: _Optional[_Union[Vector3, _Mapping]] = ..., pose: _Optional[_Union[Pose, _Mapping]] = ..., point_count: _Optional[int] = ...) -> None: ...

class PointCloud(_message.Message):
    __slots__ = ("codec", "point_count", "data", "step", "origin", "crc32", "colors")
    CODEC_FIELD_NUMBER: _ClassVar[int]
    POINT_COUNT_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    CRC32_FIELD_NUMBER: _ClassVar[int]
    COLORS_FIELD_NUMBER: _ClassVar[int]
    codec: PointCodec
    point_count: int
    data: bytes
    step: float
    origin: Vector3
    crc32: int
    colors: bytes
    def __init__(self, codec: _Optional[_Union[PointCodec, str]] = ..., point_count: _Optional[int] = ..., data: _Optional[bytes] = ..., step: _Optional[float] = ..., origin: _Optional[_Union[Vector3, _Mapping]] = ..., crc32: _Optional[int] = ..., colors: _Optional[bytes] = ...) -> None: ...

class Intrinsics(_message.Message):
    __slots__ = ("fx", "fy", "cx", "cy")
    FX_FIELD_NUMBER: _ClassVar[int]
    FY_FIELD_NUMBER: _ClassVar[int]
    CX_FIELD_NUMBER: _ClassVar[int]
    CY_FIELD_NUMBER: _ClassVar[int]
    fx: float
    fy: float
    cx: float
    cy: float
    def __init__(self, fx: _Optional[float] = ..., fy: _Optional[float] = ..., cx: _Optional[float] = ..., cy: _Optional[float] = ...) -> None: ...

class DepthImage(_message.Message):
    __slots__ = ("encoding", "compression", "width", "height", "data", "intrinsics", "pose", "depth_scale", "mask", "mask_compression", "confidence", "confidence_compression", "min_confidence", "colors")
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    COMPRESSION_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    DEPTH_SCALE_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    MASK_COMPRESSION_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_COMPRESSION_FIELD_NUMBER: _ClassVar[int]
    MIN_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    COLORS_FIELD_NUMBER: _ClassVar[int]
    encoding: DepthEncoding
    compression: DepthCompression
    width: int
    height: int
    data: bytes
    intrinsics: Intrinsics
    pose: Pose
    depth_scale: float
    mask: bytes
    mask_compression: DepthCompression
    confidence: bytes
    confidence_compression: DepthCompression
    min_confidence: int
    colors: bytes
    def __init__(self, encoding: _Optional[_Union[DepthEncoding, str]] = ..., compression: _Optional[_Union[DepthCompression, str]] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., data: _Optional[bytes] = ..., intrinsics: _Optional[_Union[Intrinsics, _Mapping]] = ..., pose: _Optional[_Union[Pose, _Mapping]] = ..., depth_scale: _Optional[float] = ..., mask: _Optional[bytes] = ..., mask_compression: _Optional[_Union[DepthCompression, str]] = ..., confidence: _Optional[bytes] = ..., confidence_compression: _Optional[_Union[DepthCompression, str]] = ..., min_confidence: _Optional[int] = ..., colors: _Optional[bytes] = ...) -> None: ...

class TrackResponse(_message.Message):
    __slots__ = ("started", "result", "frame_error", "notice", "pong", "error", "frame", "reset", "update")
    STARTED_FIELD_NUMBER: _ClassVar[int]
    RESULT_FIELD_NUMBER: _ClassVar[int]
    FRAME_ERROR_FIELD_NUMBER: _ClassVar[int]
    NOTICE_FIELD_NUMBER: _ClassVar[int]
    PONG_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    RESET_FIELD_NUMBER: _ClassVar[int]
    UPDATE_FIELD_NUMBER: _ClassVar[int]
    started: Started
    result: Result
    frame_error: FrameError
    notice: Notice
    pong: Pong
    error: ErrorDetail
    frame: Frame
    reset: ResetSessionRequest
    update: UpdateSessionRequest
    def __init__(self, started: _Optional[_Union[Started, _Mapping]] = ..., result: _Optional[_Union[Result, _Mapping]] = ..., frame_error: _Optional[_Union[FrameError, _Mapping]] = ..., notice: _Optional[_Union[Notice, _Mapping]] = ..., pong: _Optional[_Union[Pong, _Mapping]] = ..., error: _Optional[_Union[ErrorDetail, _Mapping]] = ..., frame: _Optional[_Union[Frame, _Mapping]] = ..., reset: _Optional[_Union[ResetSessionRequest, _Mapping]] = ..., update: _Optional[_Union[UpdateSessionRequest, _Mapping]] = ...) -> None: ...

class Started(_message.Message):
    __slots__ = ("name", "last_sequence_number", "last_capture_time", "flow_mode", "max_frames_in_flight", "repeated_answers")
    NAME_FIELD_NUMBER: _ClassVar[int]
    LAST_SEQUENCE_NUMBER_FIELD_NUMBER: _ClassVar[int]
    LAST_CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    FLOW_MODE_FIELD_NUMBER: _ClassVar[int]
    MAX_FRAMES_IN_FLIGHT_FIELD_NUMBER: _ClassVar[int]
    REPEATED_ANSWERS_FIELD_NUMBER: _ClassVar[int]
    name: str
    last_sequence_number: int
    last_capture_time: float
    flow_mode: FlowMode
    max_frames_in_flight: int
    repeated_answers: int
    def __init__(self, name: _Optional[str] = ..., last_sequence_number: _Optional[int] = ..., last_capture_time: _Optional[float] = ..., flow_mode: _Optional[_Union[FlowMode, str]] = ..., max_frames_in_flight: _Optional[int] = ..., repeated_answers: _Optional[int] = ...) -> None: ...

class Result(_message.Message):
    __slots__ = ("sequence_number", "capture_time", "state", "reliability", "paper_score", "coverage", "frames_dropped", "frames_rejected", "frames_applied", "timings", "frames_late", "display_time", "warnings", "usage", "vertices", "sigma", "vertex_reliability", "observed", "velocities", "covariance")
    class TimingsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    SEQUENCE_NUMBER_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    RELIABILITY_FIELD_NUMBER: _ClassVar[int]
    PAPER_SCORE_FIELD_NUMBER: _ClassVar[int]
    COVERAGE_FIELD_NUMBER: _ClassVar[int]
    FRAMES_DROPPED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_REJECTED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_APPLIED_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_FIELD_NUMBER: _ClassVar[int]
    FRAMES_LATE_FIELD_NUMBER: _ClassVar[int]
    DISPLAY_TIME_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    USAGE_FIELD_NUMBER: _ClassVar[int]
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    SIGMA_FIELD_NUMBER: _ClassVar[int]
    VERTEX_RELIABILITY_FIELD_NUMBER: _ClassVar[int]
    OBSERVED_FIELD_NUMBER: _ClassVar[int]
    VELOCITIES_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    sequence_number: int
    capture_time: float
    state: TrackerState
    reliability: float
    paper_score: float
    coverage: float
    frames_dropped: int
    frames_rejected: int
    frames_applied: int
    timings: _containers.ScalarMap[str, float]
    frames_late: int
    display_time: float
    warnings: _containers.RepeatedCompositeFieldContainer[Warning]
    usage: Usage
    vertices: PackedArray
    sigma: PackedArray
    vertex_reliability: PackedArray
    observed: PackedArray
    velocities: PackedArray
    covariance: PackedArray
    def __init__(self, sequence_number: _Optional[int] = ..., capture_time: _Optional[float] = ..., state: _Optional[_Union[TrackerState, str]] = ..., reliability: _Optional[float] = ..., paper_score: _Optional[float] = ..., coverage: _Optional[float] = ..., frames_dropped: _Optional[int] = ..., frames_rejected: _Optional[int] = ..., frames_applied: _Optional[int] = ..., timings: _Optional[_Mapping[str, float]] = ..., frames_late: _Optional[int] = ..., display_time: _Optional[float] = ..., warnings: _Optional[_Iterable[_Union[Warning, _Mapping]]] = ..., usage: _Optional[_Union[Usage, _Mapping]] = ..., vertices: _Optional[_Union[PackedArray, _Mapping]] = ..., sigma: _Optional[_Union[PackedArray, _Mapping]] = ..., vertex_reliability: _Optional[_Union[PackedArray, _Mapping]] = ..., observed: _Optional[_Union[PackedArray, _Mapping]] = ..., velocities: _Optional[_Union[PackedArray, _Mapping]] = ..., covariance: _Optional[_Union[PackedArray, _Mapping]] = ...) -> None: ...

class Usage(_message.Message):
    __slots__ = ("processor_seconds", "budget_seconds", "widening", "working_vertices", "lighter")
    PROCESSOR_SECONDS_FIELD_NUMBER: _ClassVar[int]
    BUDGET_SECONDS_FIELD_NUMBER: _ClassVar[int]
    WIDENING_FIELD_NUMBER: _ClassVar[int]
    WORKING_VERTICES_FIELD_NUMBER: _ClassVar[int]
    LIGHTER_FIELD_NUMBER: _ClassVar[int]
    processor_seconds: float
    budget_seconds: float
    widening: float
    working_vertices: int
    lighter: bool
    def __init__(self, processor_seconds: _Optional[float] = ..., budget_seconds: _Optional[float] = ..., widening: _Optional[float] = ..., working_vertices: _Optional[int] = ..., lighter: bool = ...) -> None: ...

class Warning(_message.Message):
    __slots__ = ("code", "field", "message")
    CODE_FIELD_NUMBER: _ClassVar[int]
    FIELD_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    code: WarningCode
    field: str
    message: str
    def __init__(self, code: _Optional[_Union[WarningCode, str]] = ..., field: _Optional[str] = ..., message: _Optional[str] = ...) -> None: ...

class ErrorDetail(_message.Message):
    __slots__ = ("name", "field", "expected", "got", "message", "retry_after")
    NAME_FIELD_NUMBER: _ClassVar[int]
    FIELD_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_FIELD_NUMBER: _ClassVar[int]
    GOT_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    RETRY_AFTER_FIELD_NUMBER: _ClassVar[int]
    name: str
    field: str
    expected: str
    got: str
    message: str
    retry_after: float
    def __init__(self, name: _Optional[str] = ..., field: _Optional[str] = ..., expected: _Optional[str] = ..., got: _Optional[str] = ..., message: _Optional[str] = ..., retry_after: _Optional[float] = ...) -> None: ...

class FrameError(_message.Message):
    __slots__ = ("sequence_number", "capture_time", "error", "frames_rejected", "frames_dropped", "frames_late")
    SEQUENCE_NUMBER_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    FRAMES_REJECTED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_DROPPED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_LATE_FIELD_NUMBER: _ClassVar[int]
    sequence_number: int
    capture_time: float
    error: ErrorDetail
    frames_rejected: int
    frames_dropped: int
    frames_late: int
    def __init__(self, sequence_number: _Optional[int] = ..., capture_time: _Optional[float] = ..., error: _Optional[_Union[ErrorDetail, _Mapping]] = ..., frames_rejected: _Optional[int] = ..., frames_dropped: _Optional[int] = ..., frames_late: _Optional[int] = ...) -> None: ...

class Notice(_message.Message):
    __slots__ = ("kind", "message", "value", "target")
    KIND_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    TARGET_FIELD_NUMBER: _ClassVar[int]
    kind: NoticeKind
    message: str
    value: float
    target: str
    def __init__(self, kind: _Optional[_Union[NoticeKind, str]] = ..., message: _Optional[str] = ..., value: _Optional[float] = ..., target: _Optional[str] = ...) -> None: ...
