"""Version handshake: compatible and refused versions."""

import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import VersionMismatch
from ddakf_api.version import require_compatible


@pytest.mark.parametrize("version", [API_VERSION, "1.0", "1.99"])
def test_the_same_major_version_is_accepted(version):
    require_compatible(version, peer="client")


@pytest.mark.parametrize("version", ["2.0", "0.9", "", "1", "one.two", "1.0.0", "9" * 5000 + ".1"])
@pytest.mark.parametrize("peer", ["client", "server"])
def test_other_versions_are_refused_with_both_versions_in_the_message(version, peer):
    with pytest.raises(VersionMismatch) as refusal:
        require_compatible(version, peer=peer)
    assert API_VERSION in str(refusal.value)
    assert (version or "none")[:20] in str(refusal.value)
    assert len(str(refusal.value)) < 200
