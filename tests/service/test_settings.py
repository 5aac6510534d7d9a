"""Settings: flags override the environment, which overrides the file and the defaults; errors name the setting."""

import pytest
from ddakf_service.settings import Settings, load, shown

from ddakf.errors import InvalidConfig


@pytest.fixture
def config_file(tmp_path):
    path = tmp_path / "ddakf.toml"
    path.write_text('host = "127.0.0.3"\ngrpc_port = 3\nhttp_port = 3\n')
    return path


def test_precedence(monkeypatch, config_file):
    monkeypatch.setenv("DDAKF_GRPC_PORT", "2")
    monkeypatch.setenv("DDAKF_HTTP_PORT", "2")
    settings, origins = load({"http_port": "1"}, config_file)
    assert (settings.http_port, settings.grpc_port, settings.host) == (1, 2, "127.0.0.3")
    assert str(origins["http_port"]) == "flag --http-port"
    assert str(origins["grpc_port"]) == "environment DDAKF_GRPC_PORT"
    assert str(origins["host"]) == f"file {config_file}"
    assert str(origins["workers"]) == "default"


def test_the_environment_may_name_the_file(monkeypatch, config_file):
    monkeypatch.setenv("DDAKF_CONFIG", str(config_file))
    assert load()[0].host == "127.0.0.3"


def test_default_workers_are_between_one_and_four():
    assert 1 <= load()[0].workers <= 4


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"workers": "0"}, ["workers", "1", "'0'", "--workers"]),
        ({"grpc_port": "many"}, ["grpc_port", "integer", "'many'"]),
        ({"http_port": "70000"}, ["http_port", "65535"]),
        ({"default_flow": "best-effort"}, ["default_flow", "realtime", "best-effort"]),
        ({"idle_timeout": "-1"}, ["idle_timeout", "greater than 0"]),
    ],
)
def test_a_bad_setting_is_named(flags, words):
    with pytest.raises(InvalidConfig) as caught:
        load(flags)
    assert all(word in str(caught.value) for word in words)


def test_a_bad_environment_variable_is_named(monkeypatch):
    monkeypatch.setenv("DDAKF_WORKERS", "none")
    with pytest.raises(InvalidConfig, match="environment DDAKF_WORKERS"):
        load()


@pytest.mark.parametrize("text", ["hots = 1\n", "host = \n", "[limits]\nmax_points = 1\n"])
def test_a_bad_file_is_named(tmp_path, text):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(InvalidConfig, match=r"bad\.toml"):
        load({}, path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InvalidConfig, match="No such"):
        load({}, tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("url", "without"),
    [
        ("postgresql+psycopg://me:s3cr@t@host/db", "postgresql+psycopg://me:***@host/db"),
        ("postgresql+psycopg://host/db?user=me&password=s3cr@t&x=1", "postgresql+psycopg://host/db?user=me&password=***&x=1"),
        ("postgresql+psycopg://host/db?sslpassword=s3cret&x=1", "postgresql+psycopg://host/db?sslpassword=***&x=1"),
        ("s3://bucket/folder?AWS_Secret_Access_Key=s3cret", "s3://bucket/folder?AWS_Secret_Access_Key=***"),
        ("s3://bucket/folder?session-token=s3cret", "s3://bucket/folder?session-token=***"),
        ("sqlite:////var/ddakf.sqlite", "sqlite:////var/ddakf.sqlite"),
    ],
)
def test_passwords_are_not_shown(url, without):
    assert shown("database_url", url) == without


def test_every_setting_says_what_it_means():
    assert all(field.description for field in Settings.model_fields.values())
