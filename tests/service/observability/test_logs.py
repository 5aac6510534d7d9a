"""Logs carry the session's id and the extra fields, as text or JSON."""

import json
import logging

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


def test_exceptions_are_part_of_the_line(logged):
    written = logged("json")
    try:
        raise ValueError("oh")
    except ValueError:
        logging.getLogger("m").exception("failed")
    assert "ValueError: oh" in json.loads(written())["exception"]
