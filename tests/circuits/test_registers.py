"""The kernels of `registers.cu` on the CPU: compiled by g++, a fiber for each GPU thread (`registers.cpp`)."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from torch import Tensor

from qrlsuite.circuit import Circuit, ansatz
from qrlsuite.device import NUMERICS
from qrlsuite.plugins.circuits.native import NativeBackend, gpu, registers
from qrlsuite.plugins.circuits.native import backend as native
from qrlsuite.plugins.circuits.native.registers import Bits, RegisterSimulator, bits_of
from tests.circuits.test_gpu import circuits
from tests.circuits.test_native import circuits as any_circuit

FIBERS = Path(__file__).with_name("registers.cpp")
needs_compiler = pytest.mark.skipif(
    shutil.which("g++") is None, reason="no g++, which compiles the kernels for the CPU"
)


@pytest.fixture(scope="module")
def emulated(tmp_path_factory: pytest.TempPathFactory) -> object:
    """Launches run on the CPU."""
    folder = tmp_path_factory.mktemp("kernels")

    @cache
    def library(bits: Bits) -> ctypes.CDLL:
        made = folder / f"registers-{sum(bits)}.so"
        words = [f"-D{each}" for each in (f'KERNELS="{registers.SOURCE}"', *registers.definitions(bits))]
        command = ["g++", "-std=c++17", "-O1", "-w", "-shared", "-fPIC", *words, "-o", str(made), str(FIBERS)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return ctypes.CDLL(str(made))

    def launch(bits: Bits, name: str, device: torch.device, shape: tuple[int, ...], *arguments: int) -> None:
        given = (ctypes.c_longlong * len(arguments))(*arguments)
        assert library(bits).launch(name.encode(), *shape, given) == 0, "threads wait at different places"

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registers, "launch", launch)
        patch.setitem(NUMERICS, "circuit kernels", 1)  # they are noted there: gone again after these tests
        yield


def computed(run: Callable[[Tensor, Tensor], Tensor], *given: Tensor) -> list[Tensor]:
    """Return values, and gradients by inputs and parameters."""
    x, p, cotangent = given
    leaves = [x.clone().requires_grad_(), p.clone().requires_grad_()]
    values = run(*leaves)
    return [values.detach(), *torch.autograd.grad(values, leaves, cotangent, materialize_grads=True)]


def drawn(circuit: Circuit, seeds: int, batch: int, largest: float = 6.3) -> list[Tensor]:
    source = torch.Generator().manual_seed(5)
    x = 4 * torch.rand(seeds, batch, circuit.inputs, generator=source) - 2
    p = largest * torch.rand(seeds, circuit.parameter_count, generator=source)
    return [x, p, 2 * torch.rand(seeds, batch, len(circuit.measured), generator=source) - 1]


def require_right(circuit: Circuit, seeds: int = 2, batch: int = 2, largest: float = 6.3) -> None:
    """Compare with the CPU's kernels in float64."""
    backend, given = NativeBackend(circuit), drawn(circuit, seeds, batch, largest)
    right = computed(backend.simulator(), *(each.double() for each in given))
    found = computed(RegisterSimulator(backend.program), *given)
    for name, mine, theirs, limit in zip(
        ("values", "inputs", "parameters"), found, right, (1e-6, 2e-5, 2e-5)
    ):
        assert float((mine - theirs).abs().max() if mine.numel() else 0) < limit, name


def suite() -> dict[str, Circuit]:
    """Every ansatz in each layout of a block: parts of a warp, one warp, several; those of other kinds; a cluster."""
    found = {f"few qubits: {name}": circuit for name, circuit in circuits().items()}
    for name in ("basic", "cx", "cz", "hsiao", "iqp", "jerbi", "perez-salinas", "skolik", "wang"):
        for qubits in (3, 6, 7, 10):
            found[f"{name} {qubits}"] = ansatz(name, qubits=qubits, layers=2)
    for gate in ("xyz", "u3"):
        found[f"iqp {gate}"] = ansatz("iqp", qubits=7, layers=3, gate=gate)
    found["separable"] = ansatz("cz", qubits=12, layers=2, entangled="separable")
    found["iqp 14"], found["cx 14"] = (ansatz(name, qubits=14, layers=2) for name in ("iqp", "cx"))
    return found


@needs_compiler
@pytest.mark.parametrize("name", suite())
def test_circuits_are_right(name: str, emulated: None) -> None:
    circuit = suite()[name]
    require_right(circuit, *((1, 1) if circuit.qubits == 14 else (2, 2)))


@needs_compiler
@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(any_circuit())
def test_any_circuit_is_right(emulated: None, circuit: Circuit) -> None:
    require_right(circuit, largest=1.0)  # angles of many gates are rounded, too


@needs_compiler
@pytest.mark.parametrize("qubits", [6, 10])
def test_a_seed_is_the_same_in_any_company(qubits: int, emulated: None) -> None:
    circuit = ansatz("iqp", qubits=qubits, layers=2)
    run, (x, p, cotangent) = RegisterSimulator(NativeBackend(circuit).program), drawn(circuit, 3, 7)
    for mine, of_all in zip(computed(run, x[2:], p[2:], cotangent[2:]), computed(run, x, p, cotangent)):
        assert torch.equal(mine, of_all[2:])


def test_what_a_gpu_does_not_take_is_left_to_other_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    def takes(layers: int, qubits: int, dtype: torch.dtype = torch.float32) -> bool:
        program = NativeBackend(ansatz("iqp", qubits=qubits, layers=layers)).program
        return bool(RegisterSimulator(program).takes(torch.zeros(1, dtype=dtype)))

    monkeypatch.setattr(gpu, "shared_limit", lambda device: 227 << 10)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (8, 0))
    assert takes(4, 13)
    assert not takes(4, 13, torch.float64)
    assert not takes(100, 6)
    assert not takes(4, 14), "clusters of blocks came with 9.0"
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    assert takes(4, 14)
    assert not takes(1, 15)


def test_they_compute_only_where_they_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "trouble", lambda: None)
    monkeypatch.setattr(native, "registers_trouble", lambda: None)
    for asked, kinds in (("0", [gpu.GPUSimulator]), ("1", [RegisterSimulator, gpu.GPUSimulator])):
        monkeypatch.setenv("QRLSUITE_CAPTURE", asked)
        assert [type(each) for each in NativeBackend(circuits()["iqp"]).gpu_simulators] == kinds


def test_why_they_fail_is_said_once(capsys: pytest.CaptureFixture[str]) -> None:
    native.registers_trouble.cache_clear()
    try:
        assert native.registers_trouble() == native.registers_trouble() is not None, "there is no GPU"
        assert capsys.readouterr().err.count("circuits run by numba-cuda's kernels") == 1
    finally:
        native.registers_trouble.cache_clear()


@pytest.mark.parametrize("qubits", [6, 14])
def test_nvrtc_compiles_them_without_a_gpu(
    qubits: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cuda.core", reason="pip install '.[cuda]'")
    monkeypatch.setattr(registers, "folder", lambda package: tmp_path)
    first, second = (registers.compiled_for.__wrapped__(bits_of(qubits), "sm_90") for _ in range(2))
    assert bytes(first.code) == bytes(second.code)
    assert bytes(first.code).startswith(b"\x7fELF")
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 1


@needs_compiler
def test_records_say_that_they_computed(emulated: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(NUMERICS, "circuit kernels")
    RegisterSimulator(NativeBackend(circuits()["iqp"]).program)(*drawn(circuits()["iqp"], 1, 1)[:2])
    assert NUMERICS == {"circuit kernels": 2}
