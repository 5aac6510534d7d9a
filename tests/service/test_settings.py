"""Settings: flags override the environment, which overrides the file and the defaults; errors name the setting."""

import pytest
from ddakf_service.setting_sources import load, shown, unknown_variables
from ddakf_service.settings import Settings

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
        ({"grpc_port": "many"}, ["grpc_port", "a whole number", "'many'"]),
        ({"http_port": "70000"}, ["http_port", "65535"]),
        ({"default_flow": "best-effort"}, ["default_flow", "realtime", "best-effort"]),
        ({"idle_timeout": "-1"}, ["idle_timeout", "greater than 0"]),
        ({"idle_timeout": "inf"}, ["idle_timeout", "a finite number"]),
        (
            {"idle_timeout": "30", "departure_timeout": "40"},
            ["departure_timeout", "at most the idle_timeout, 30", "'40' from flag"],
        ),
        ({"successor": "foo"}, ["successor", "HOST:PORT", "'foo' from flag --successor"]),
        ({"successor": "foo:0"}, ["successor", "HOST:PORT"]),
        ({"successor": "http://foo:1"}, ["successor", "HOST:PORT"]),
        (
            {"allow_anonymous": "true", "require_keys": "true"},
            ["allow_anonymous", "false where require_keys"],
        ),
        ({"costly_slow_after": "7"}, ["costly_isolate_after", "at least costly_slow_after, 7"]),
        ({"costly_isolate_after": "20"}, ["costly_end_after", "at least costly_isolate_after, 20"]),
        ({"spare_workers": "0", "recycle_frames": "9"}, ["recycle_frames", "0 where spare_workers is 0", "'9' from flag"]),
        ({"host": ""}, ["host", "some text"]),
        ({"require_keys": "perhaps"}, ["require_keys", "true or false"]),
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


@pytest.mark.parametrize("address", ["", "garments.example:7701", "192.0.2.1:1", "[::1]:65535"])
def test_a_successor_is_an_address(address):
    assert load({"successor": address})[0].successor == address


def test_the_default_departure_timeout_is_no_error_beside_a_shorter_idle_timeout():
    assert load({"idle_timeout": "30"})[0].departure_timeout == 60


def test_the_nearest_name_of_a_mistyped_setting_is_shown(tmp_path):
    path = tmp_path / "ddakf.toml"
    path.write_text("max_sesions = 1\n")
    with pytest.raises(InvalidConfig, match=r"max_sesions: .*; did you mean max_sessions"):
        load({}, path)


def test_unknown_variables_are_told_with_the_nearest_name(monkeypatch):
    for name in ("DDAKF_WROKERS", "DDAKF_ZZZZZZZZZZZZZZZZ"):
        monkeypatch.setenv(name, "1")
    for name in ("DDAKF_KERNEL_CACHE", "DDAKF_WORKERS", "DDAKF_CONFIG", "DDAKF_DATA"):  # known
        monkeypatch.setenv(name, "1")
    for name in ("DDAKF_PORT", "DDAKF_SERVICE_HOST", "DDAKF_SERVICE_PORT_GRPC", "DDAKF_PORT_7701_TCP_ADDR"):  # of Kubernetes
        monkeypatch.setenv(name, "tcp://10.0.0.1:7701")
    assert unknown_variables() == [
        "DDAKF_WROKERS is no setting; did you mean DDAKF_WORKERS or DDAKF_SPARE_WORKERS?",
        "DDAKF_ZZZZZZZZZZZZZZZZ is no setting",
    ]


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
