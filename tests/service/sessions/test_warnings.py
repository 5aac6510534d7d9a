"""Warnings about wrong input, from the tracker in a worker to the clients, the session's view and the metrics."""

from __future__ import annotations

import logging
from typing import get_args

import numpy as np
import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import Frame

from ddakf.results import WarningCode
from tests.stages.scenes import scan, tube

GARMENT = tube()
CODE, FIELD = "sensor_origin_missing", "sensors"


def front(number: int, origin=None) -> Frame:
    """What a camera at +z sees of the tube, whose place it does not always say."""
    points = scan(GARMENT.vertices, GARMENT, 3000, seed=number)
    return Frame(points[points[:, 2] > 0.02], number / 30, origin)


@pytest.fixture
def worn(client):
    with client.create_session(GARMENT.vertices, GARMENT.faces) as session:
        yield session


def test_a_missing_origin_is_told_everywhere(worn, http, caplog):
    metric = f'ddakf_frame_warnings_total{{code="{CODE}"}}'

    def counted() -> float:
        return next(float(line.split()[1]) for line in http.get("/metrics").text.splitlines() if line.startswith(metric))

    before = counted()
    with caplog.at_level(logging.WARNING, "ddakf_client"):
        results = list(worn.track([front(k) for k in range(1, 5)], flow="lossless"))
    assert [[(w.code, w.field) for w in result.warnings] for result in results] == [[(CODE, FIELD)]] * 4
    assert len([record for record in caplog.records if "one side" in record.getMessage()]) == 1, "each code once"
    ((last, frames),) = worn.info().warnings
    assert (last.code, frames) == (CODE, 4)
    assert last == results[-1].warnings[0]
    (shown,) = http.get(f"/v1/{worn.name}").json()["statistics"]["warnings"]
    told = {"code": f"WARNING_CODE_{CODE.upper()}", "field": FIELD, "message": last.message}
    assert shown == {"warning": told, "frames": "4"}
    assert counted() - before == 4


def test_a_frame_with_its_origin_has_no_warnings(worn):
    results = list(worn.track([front(k, np.array([0.0, 0.3, 3.0])) for k in range(1, 5)], flow="lossless"))
    assert not any(result.warnings for result in results)
    assert worn.info().warnings == ()


def test_every_code_of_the_tracker_is_in_the_contract():
    names = {name.removeprefix("WARNING_CODE_").lower() for name, number in pb.WarningCode.items() if number}
    assert names == set(get_args(WarningCode))
