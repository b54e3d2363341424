"""What runs on IBM's and Amazon's devices, tried on fake devices and simulators of the same interface."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
from types import SimpleNamespace
from typing import Any

import pennylane as qml
import pytest
import torch
from qiskit import QuantumCircuit
from qiskit.circuit import Parameter
from qiskit.providers.fake_provider import GenericBackendV2
from qiskit.quantum_info import SparsePauliOp
from torch import Tensor

from qrlsuite.circuit import Circuit, create_backend, expectations
from qrlsuite.errors import OptionError
from qrlsuite.plugins.circuits.options import QiskitOptions
from qrlsuite.plugins.circuits.pennylane import braket_terms
from qrlsuite.plugins.circuits.runtime import Runtime

IBM = pytest.mark.skipif(
    importlib.util.find_spec("qiskit_ibm_runtime") is None, reason="pip install '.[ibm]'"
)
BRAKET = pytest.mark.skipif(importlib.util.find_spec("braket") is None, reason="pip install '.[braket]'")


def deep() -> Circuit:
    """Return a circuit of sixteen CNOTs that does nothing at inputs of 0: both values are 1 without noise."""
    circuit = Circuit(2)
    for _ in range(16):
        circuit.append("CNOT", (0, 1))
        circuit.append("RY", 1, circuit.input(0))
    return circuit


def at_zero(backend: str, **options: Any) -> Tensor:
    return expectations(deep(), torch.zeros(2, 2, dtype=torch.float64), {}, backend, seed=1, **options)


def noisy(wires: Any, **more: Any) -> Any:
    """Return a device whose CNOTs depolarize."""
    model = qml.NoiseModel(
        {qml.noise.op_in(["CNOT"]): lambda op, **_: qml.DepolarizingChannel(0.01, op.wires[1])}
    )
    return qml.noise.add_noise(qml.device("default.mixed", wires=wires, **more), model)


@pytest.fixture
def devices(monkeypatch: pytest.MonkeyPatch) -> None:
    point = importlib.metadata.EntryPoint("noisy.simulator", f"{__name__}:noisy", "pennylane.plugins")
    known = {**qml.plugin_devices, point.name: point}
    monkeypatch.setattr(qml.devices.device_constructor, "plugin_devices", known)


@pytest.mark.usefixtures("devices")
@pytest.mark.parametrize("shots", [None, 4000])
def test_noise_is_extrapolated_to_none_on_a_pennylane_device(shots: int | None) -> None:
    given = {"device": "noisy.simulator"} | ({"shots": shots} if shots else {})
    plain, mitigated = at_zero("pennylane", **given), at_zero("pennylane", **given, mitigation="zero-noise")
    assert plain[:, 1].max() < 0.85
    assert (mitigated - 1).abs().max() < 0.5 * (plain[:, 1] - 1).abs().min()
    backend: Any = create_backend("pennylane", deep(), **given, mitigation="zero-noise")
    assert backend.repeats == 3


@IBM
def test_a_fake_device_runs_with_mitigation_through_runtime() -> None:
    given = {"device": "FakeManilaV2", "shots": 2000}
    plain = at_zero("qiskit", **given)
    readout = at_zero("qiskit", **given, mitigation="readout")
    both = at_zero("qiskit", **given, mitigation="zero-noise", runtime="session")
    assert plain.max() < readout.min() < 0.97
    assert (both - 1).abs().max() < (readout - 1).abs().min()
    assert torch.equal(plain, at_zero("qiskit", **given, runtime="job"))
    backend: Any = create_backend("qiskit", deep(), **given)
    assert backend.simulator
    assert re.match(r"0 jobs wait at FakeManilaV2; about 5\d\d s of", backend.terms(1000))


@IBM
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"device": "FakeManilaV2"}, "device = 'FakeManilaV2' measures: say how often, such as shots=1000"),
        (
            {"device": "FakeManillaV2", "shots": 9},
            "device = 'FakeManillaV2' is unknown; did you mean 'FakeMan",
        ),
        ({"device": "ibm_nowhere", "shots": 9}, "no account of IBM Quantum is saved here"),
        ({"mitigation": "readout", "shots": 9}, "mitigation = 'readout' needs a device"),
        ({"device": "FakeManilaV2", "shots": 9, "noise_model": "depolarizing"}, "has its own noise"),
        ({"device": "FakeManilaV2", "shots": 9}, "has 5 qubits, the circuit 6"),
    ],
)
def test_what_an_ibm_device_cannot_run_is_refused(
    options: dict[str, Any], sentence: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))  # no account
    with pytest.raises(OptionError, match=sentence):
        create_backend("qiskit", Circuit(6), **options)


@BRAKET
def test_amazon_s_local_simulator_runs_and_its_devices_need_an_account(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    torch.testing.assert_close(
        at_zero("pennylane", device="braket.local.qubit", shots=100), torch.ones(2, 2, dtype=torch.float64)
    )
    for name in ("AWS_DEFAULT_REGION", "AWS_PROFILE", "AWS_ACCESS_KEY_ID"):
        monkeypatch.delenv(name, raising=False)
    arn = "arn:aws:braket:::device/quantum-simulator/amazon/sv1"
    with pytest.raises(
        OptionError, match=r"cannot be opened .*region.* \(`aws configure` sets region and account\)"
    ):
        at_zero("pennylane", device=arn, shots=100)


class Aws:
    """What is asked of an `AwsDevice`, in Amazon's own types."""

    def __init__(self) -> None:
        from braket.aws.queue_information import QueueDepthInfo, QueueType
        from braket.device_schema.device_service_properties_v1 import DeviceCost

        self.depth = QueueDepthInfo({QueueType.NORMAL: "12", QueueType.PRIORITY: "1"}, "0")
        self.properties = self.service = self
        self.deviceCost = DeviceCost(price=0.03, unit="shot")

    def queue_depth(self) -> Any:
        return self.depth


@BRAKET
def test_what_amazon_s_device_says_before() -> None:
    said = braket_terms(Aws(), 100, 2000)
    assert said == (
        "tasks that wait: Normal: 12, Priority: 1; $0.03 a shot, $6,000.00 in all, and Amazon's price of 2,000 tasks"
    )


class Off(GenericBackendV2):  # type: ignore[misc, unused-ignore]
    """A device that is not there today."""

    def status(self) -> Any:
        return SimpleNamespace(operational=False, status_msg="maintenance", pending_jobs=7)


class Away(GenericBackendV2):  # type: ignore[misc, unused-ignore]
    """A device that does not answer."""

    def status(self) -> Any:
        raise ConnectionError("the service\nhung up")


@pytest.mark.parametrize(
    ("device", "sentence"),
    [
        (Off(2, seed=0), "device = 'ibm_x' is out of service: maintenance"),
        (Away(2, seed=0), "device = 'ibm_x' does not answer: the service hung up"),
        (
            GenericBackendV2(2, basis_gates=["x", "rz", "cx"], seed=0),
            "device = 'ibm_x' cannot run this circuit: ",
        ),
    ],
)
def test_a_device_that_cannot_run_a_circuit_is_refused_before_anything_is_executed(
    device: Any, sentence: str
) -> None:
    circuit = QuantumCircuit(2)
    circuit.ry(Parameter("angle"), 0)
    circuit.cx(0, 1)
    with pytest.raises(OptionError, match=sentence):
        Runtime(QiskitOptions(device="ibm_x", shots=9), device, circuit, [SparsePauliOp("ZZ")])


def test_without_their_packages_devices_name_them() -> None:
    with pytest.raises(OptionError, match=r"mitigation = .zero-noise.: device .default\.qubit. has no noise"):
        create_backend("pennylane", deep(), mitigation="zero-noise")
    if importlib.util.find_spec("qiskit_ibm_runtime") is None:
        with pytest.raises(OptionError, match=r"pip install qiskit-ibm-runtime"):
            create_backend("qiskit", deep(), device="ibm_fez", shots=9)
    if importlib.util.find_spec("braket") is None:
        with pytest.raises(OptionError, match=r"pip install amazon-braket-pennylane-plugin"):
            create_backend("pennylane", deep(), device="arn:aws:braket:::device/qpu/ionq/Forte-1", shots=9)
