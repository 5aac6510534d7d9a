"""Object stores through fsspec: the file system of a URL, with bounded waits, and one kind of error for all drivers."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import fsspec.config
from fsspec.core import url_to_fs
from fsspec.spec import AbstractFileSystem

# The store tries again by itself; botocore's defaults wait for minutes. FSSPEC_S3_CONFIG_KWARGS replaces these.
_S3 = {"config_kwargs": {"connect_timeout": 5, "read_timeout": 10, "retries": {"max_attempts": 1}}}


def file_system(url: str) -> tuple[AbstractFileSystem, str]:
    """The file system of a URL and the path in it.

    Raises:
        ValueError, ImportError: fsspec does not know the scheme, or the driver is missing.
    """
    options: dict[str, Any] = {}
    if url.startswith(("s3://", "s3a://")):
        options = {name: value for name, value in _S3.items() if name not in fsspec.config.conf.get("s3", {})}
    return url_to_fs(url, skip_instance_cache=True, **options)


@contextlib.contextmanager
def reaching_store() -> Iterator[None]:
    """Context whose errors are all ``OSError``: drivers raise classes of their own when a store does not answer."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        raise OSError(f"{type(error).__name__}: {error}") from error
