import pytest
from qrlsuite.testing import assert_conforms

EVERYTHING = [
    ("ansatz", "rzz-ring"),
    ("model", "fourier"),
    ("environment", "channel-hop"),
    ("task", "channel-hop"),
    ("circuit-backend", "damped"),
    ("model", "vqc-damped"),
    ("significance-test", "half"),
    ("tracker", "acme_qrl.tracker"),
]


@pytest.mark.parametrize(("kind", "name"), EVERYTHING)
def test_it_conforms(kind, name, tmp_path, monkeypatch):
    monkeypatch.setenv("ACME_LOG", str(tmp_path / "log.txt"))
    assert_conforms(kind, name)
