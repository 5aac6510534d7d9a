"""Logs carry the session's id and the extra fields, as text or JSON."""

import json
import logging
import re
from pathlib import Path

import pytest
from ddakf_service.observability.logs import configure_logging, current_session


@pytest.fixture
def logged(capsys):
    """Configures logging in a format and returns a function for the last line; restores logging afterwards."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level

    def configure(form):
        configure_logging("info", form)
        return lambda: capsys.readouterr().err

    yield configure
    root.handlers[:], root.level = handlers, level


def test_json_lines_carry_session_and_fields(logged):
    written = logged("json")
    token = current_session.set("s-1")
    logging.getLogger("some.module").warning("lost %d", 3, extra={"worker": 7})
    current_session.reset(token)
    line = json.loads(written())
    assert line.pop("time").endswith("Z")
    assert line == {"level": "warning", "logger": "some.module", "session": "s-1", "message": "lost 3", "worker": 7}


def test_a_session_given_with_the_line_wins(logged):
    written = logged("text")
    logging.getLogger("m").info("created", extra={"session": "s-2", "vertices": 5})
    assert written().endswith("INFO    s-2 created vertices=5\n")


@pytest.mark.parametrize("form", ["text", "json"])
def test_fields_that_a_library_adds_to_every_record_stay_out(logged, form):
    factory = logging.getLogRecordFactory()

    def with_a_stamp(*args, **keywords):
        record = factory(*args, **keywords)
        record._library_timestamp_ns = 1
        return record

    logging.setLogRecordFactory(with_a_stamp)
    try:
        written = logged(form)
        logging.getLogger("m").info("created", extra={"vertices": 5})
    finally:
        logging.setLogRecordFactory(factory)
    line = written()
    assert "vertices" in line
    assert "_library" not in line


def test_exceptions_are_part_of_the_line(logged):
    written = logged("json")
    try:
        raise ValueError("oh")
    except ValueError:
        logging.getLogger("m").exception("failed")
    assert "ValueError: oh" in json.loads(written())["exception"]


def test_the_sample_of_the_documents_has_the_fields_of_a_line(logged):
    text = (Path(__file__).parents[3] / "docs/operations.md").read_text()
    lines = re.search(r"```json\n(.*?)```", text, re.S)[1].replace(",\n ", ", ").splitlines()
    written = logged("json")
    logging.getLogger("some.module").info("done")
    fields = list(json.loads(written()))
    assert [list(json.loads(line))[: len(fields)] for line in lines] == [fields] * 4
