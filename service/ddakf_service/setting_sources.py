"""Sources of the settings: flags override the environment, which overrides a file, which overrides the defaults."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError
from pydantic_settings import EnvSettingsSource

from ddakf.errors import InvalidConfig, nearest

from .settings import ENV_PREFIX, Settings

CONFIG_VARIABLE = ENV_PREFIX + "CONFIG"

# Variables of other parts: the library, the client, the container.
_OTHERS = ("API_KEY", "BUILD", "CACHE", "COMPILED_KERNELS", "CONFIG", "DATA", "KERNEL_CACHE", "PUBLISH", "SMPL")
# Variables that Kubernetes makes for a service named "ddakf".
_OF_KUBERNETES = re.compile(ENV_PREFIX + r"(\w+_)?(SERVICE_(HOST|PORT)|PORT_\d+_TCP)(_\w+)?|" + ENV_PREFIX + "PORT")
_SECRET = re.compile(r"(://[^:@/]*:).*@|(\b[\w-]*(?:password|secret|token|key)[\w-]*=)[^&]*", re.IGNORECASE)


# Expected values by type of pydantic's error, where its own sentence is about Python.
_EXPECTED = {
    "string_too_short": "some text",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "bool_parsing": "true or false",
}


class SettingSource(NamedTuple):
    """Layer of a value ("flag", "environment", "file" or "default") and its name there."""

    layer: str
    name: str

    def __str__(self) -> str:
        return f"{self.layer} {self.name}".rstrip()


def load(
    flags: Mapping[str, Any] | None = None, config_file: str | Path | None = None
) -> tuple[Settings, dict[str, SettingSource]]:
    """Reads all layers.

    Args:
        flags: values of the command line, by field name.
        config_file: a TOML file; defaults to the file that ``DDAKF_CONFIG`` names, if any.

    Returns:
        the settings, and the layer of each field.

    Raises:
        InvalidConfig: with the setting, the expected and the given value.
    """
    path = config_file or os.environ.get(CONFIG_VARIABLE)
    layers = {
        "flag": dict(flags or {}),
        "environment": EnvSettingsSource(Settings)(),
        "file": _read_file(Path(path)) if path else {},
    }
    values: dict[str, Any] = {}
    sources = {name: SettingSource("default", "") for name in Settings.model_fields}
    for layer in reversed(layers):
        for name, value in layers[layer].items():
            values[name] = value
            sources[name] = SettingSource(layer, _name_in(layer, name, path))
    try:
        return Settings(**values), sources
    except ValidationError as error:
        raise _as_invalid_config(error, sources) from None


def unknown_variables() -> list[str]:
    """One sentence for each variable of the environment that looks like a setting and is none.

    It may belong to another version, so it is reported and not refused.
    """
    known = [ENV_PREFIX + name.upper() for name in Settings.model_fields]
    all_known = {*known, *(ENV_PREFIX + name for name in _OTHERS)}
    names = (name for name in sorted(os.environ) if name.startswith(ENV_PREFIX) and name not in all_known)
    return [f"{name} is no setting{nearest(name, known)}" for name in names if not _OF_KUBERNETES.fullmatch(name)]


def shown(name: str, value: Any) -> str:
    """A value as text, without the password, key or token of a URL."""
    if not name.endswith("_url"):
        return str(value)
    return _SECRET.sub(lambda m: f"{m[1]}***@" if m[1] else f"{m[2]}***", str(value))


def flag_of(name: str) -> str:
    """The command-line flag of a field."""
    return "--" + name.replace("_", "-")


def _name_in(layer: str, name: str, path) -> str:
    if layer == "flag":
        return flag_of(name)
    if layer == "environment":
        return ENV_PREFIX + name.upper()
    return str(path)


def _read_file(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidConfig("config", "a readable TOML file", f"{path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidConfig("config", "a TOML file", f"{path}: {error}") from None


def _as_invalid_config(error: ValidationError, sources: Mapping[str, SettingSource]) -> InvalidConfig:
    first = error.errors(include_url=False)[0]
    name = first["ctx"]["setting"] if first["type"] == "pair" else str(first["loc"][0])
    if first["type"] == "extra_forbidden":
        hint = nearest(name, Settings.model_fields) or "; `ddakf serve --help` lists them"
        return InvalidConfig(name, "the name of a setting", f"an unknown one from {sources[name]}{hint}")
    expected = _EXPECTED.get(first["type"]) or first["msg"].removeprefix("Input should be ").split(", unable to")[0]
    default = Settings.model_fields.get(name)
    value = first["input"].get(name, default and default.default) if first["type"] == "pair" else first["input"]
    return InvalidConfig(name, expected, f"{shown(name, value)!r} from {sources[name]}")
