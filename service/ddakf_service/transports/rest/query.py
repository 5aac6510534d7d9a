"""Query of a REST call: its parameters are those of the route."""

from __future__ import annotations

from typing import get_origin

from fastapi.dependencies.utils import get_flat_params
from fastapi.params import Header, Path
from fastapi.routing import APIRoute
from starlette.requests import HTTPConnection

from ..query_parameters import require_known

_CHECKED = "/v1/"  # a probe or Prometheus may add parameters of its own to the other paths


async def check_query(connection: HTTPConnection) -> None:
    """Dependency of every route; those of WebSockets, which close with an error, check their query themselves.

    Raises:
        InvalidArgument: names an unknown or repeated parameter.
    """
    route, query = connection.scope.get("route"), connection.query_params
    if query and isinstance(route, APIRoute) and route.path.startswith(_CHECKED):
        fields = [field for field in get_flat_params(route.dependant) if not isinstance(field.field_info, (Header, Path))]
        lists = {field.alias for field in fields if get_origin(field.field_info.annotation) is list}
        require_known(query, [field.alias for field in fields], lists)
