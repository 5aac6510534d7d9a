"""Schema: the generated code is up to date, and the naming rules hold."""

import importlib.util
from pathlib import Path

import pytest
from ddakf_api.v1 import tracking_pb2 as pb

PROTOS = Path(__file__).resolve().parents[2] / "protos"
ENUMS = list(pb.DESCRIPTOR.enum_types_by_name.values())


def test_generated_code_is_up_to_date():
    pytest.importorskip("grpc_tools", reason="grpcio-tools, the generator, is not installed")
    spec = importlib.util.spec_from_file_location("generate_protos", PROTOS / "generate.py")
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    assert generator.stale_files() == [], "run python protos/generate.py"


@pytest.mark.parametrize("enum", ENUMS, ids=lambda enum: enum.name)
def test_every_enum_has_an_unspecified_zero_and_prefixed_names(enum):
    prefix = "".join(f"_{c}" if c.isupper() else c.upper() for c in enum.name).lstrip("_") + "_"
    assert enum.values_by_number[0].name == f"{prefix}UNSPECIFIED"
    assert all(value.name.startswith(prefix) for value in enum.values)


def test_session_states_begin_with_the_tracker_states():
    for name, number in pb.TrackerState.items():
        assert pb.SessionState.Value(name.replace("TRACKER", "SESSION")) == number


def test_arrays_travel_packed():
    """Repeated numeric fields are few: a pose and an offset."""
    fields = [field for message in pb.DESCRIPTOR.message_types_by_name.values() for field in message.fields]
    numbers = [f for f in fields if f.is_repeated and f.cpp_type not in (f.CPPTYPE_MESSAGE, f.CPPTYPE_STRING)]
    names = {f"{field.containing_type.name}.{field.name}" for field in numbers if field.enum_type is None}
    assert names == {"Pose.matrix", "PackedArray.offset"}
