import pytest
from qrlsuite.testing import assert_conforms

EVERYTHING = [
    ("ansatz", "rzz-ring"),
    ("model", "waves"),
    ("environment", "channel-hop"),
    ("task", "channel-hop"),
    ("circuit-backend", "damped"),
    ("model", "vqc-damped"),
    ("rule", "half"),
    ("tracker", "acme-log"),
]


@pytest.mark.parametrize(("kind", "name"), EVERYTHING)
def test_it_conforms(kind, name):
    assert_conforms(kind, name)
