"""The kernels of NVIDIA GPUs on the CPU, where numba simulates a GPU thread by thread: in a process of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from qrlsuite.circuit import Circuit, ansatz
from qrlsuite.plugins.circuits.native import NativeBackend
from qrlsuite.plugins.circuits.native import backend as native
from tests.conftest import HANGS


def circuits() -> dict[str, Circuit]:
    """Circuits that together have every kind of step, on few qubits: a simulated block takes a second."""
    products = ansatz("cz", qubits=3, layers=2)
    products.measure([(0, 2), 1, (0, 1, 2)])
    apart = Circuit(4, inputs=2)
    w = apart.parameter("w", (2,))
    apart.append("RX", 0, apart.input(0) + w[0])
    apart.append("H", 1)
    apart.append("RY", 2, w[1] * apart.input(1))
    apart.append("H", 2)
    apart.append("RX", 3, 0.8)
    apart.append("U3", 3, w[0], apart.input(1), 0.3, control=1)
    apart.append("H", 1)
    apart.append("CNOT", (3, 1))
    hadamards = Circuit(3)
    for q in range(3):
        hadamards.append("RX", q, hadamards.input(q))
    for q in range(3):
        hadamards.append("H", q)
    hadamards.append("RZ", 0, hadamards.input(1), control=2)
    hadamards.append("H", 0)
    fixed = Circuit(1)
    fixed.append("RX", 0, fixed.input(0))
    return {
        "no parameters": fixed,
        "iqp": ansatz("iqp", qubits=2, layers=2),
        "cx": ansatz("cx", qubits=3, layers=2, gate="u3"),
        "cz, products": products,
        "apart": apart,
        "hadamards": hadamards,
    }


def differences(circuit: Circuit, dtype: torch.dtype) -> dict[str, float]:
    """Return by how much values and gradients of simulated kernels are off from the CPU's, at most."""
    from qrlsuite.plugins.circuits.native import gpu

    source = torch.Generator().manual_seed(5)
    backend = NativeBackend(circuit)
    inputs = 4 * torch.rand(2, 2, circuit.inputs, generator=source, dtype=dtype) - 2
    flat = 6 * torch.rand(2, circuit.parameter_count, generator=source, dtype=dtype)
    cotangent = torch.rand(2, 2, len(circuit.measured), generator=source, dtype=dtype)
    results = []
    for run in (backend.simulator(), gpu.GPUSimulator(backend.program)):
        x, p = inputs.clone().requires_grad_(), flat.clone().requires_grad_()
        values = run(x, p)
        values.backward(cotangent)
        results.append((values.detach(), x.grad, p.grad))
    names = ("values", "inputs", "parameters")
    return {
        name: float((mine - theirs).abs().max()) if mine.numel() else 0.0
        for name, mine, theirs in zip(names, *results)
    }


def main(states: int) -> None:
    """Print the differences of all circuits, where a block has room for so many states in shared memory, and no more.

    For one state it is one circuit, which needs the same as others do of another size.
    """
    from qrlsuite.plugins.circuits.native import gpu

    kinds = (torch.float64, torch.float32)
    chosen = {(name, kind) for name in circuits() for kind in kinds if name == "iqp" or kind == torch.float64}
    room = {0: 0, 2: gpu.ALWAYS_SHARED}
    if states == 1:
        chosen = {("iqp", torch.float64)}
        program = NativeBackend(circuits()["iqp"]).program
        room[1] = gpu.GPUSimulator(program).bytes_of(torch.zeros(0, dtype=torch.float64), 1, backward=True)
    gpu.shared_limit = lambda device: room[states]  # type: ignore[assignment]
    gpu.BLOCKS = 3  # of 4 lanes, so that one takes a second where blocks share the memory of all
    launched = []
    launch = gpu._launch

    def listening(name: str, *arguments: object) -> None:
        launched.append(name)
        launch(name, *arguments)  # type: ignore[arg-type]

    gpu._launch = listening  # type: ignore[assignment]
    with torch.no_grad():
        right = gpu.computes_right("cpu")
    launched.clear()
    found = {f"{name}, {kind}": differences(circuits()[name], kind) for name, kind in sorted(chosen, key=str)}
    print(json.dumps({"right": right, "launched": sorted(set(launched)), "differences": found}))


@pytest.mark.parametrize(
    ("states", "kernels"),
    [
        (2, ["backward shared", "collect", "forward shared"]),
        (1, ["backward half", "collect", "forward shared"]),
        (0, ["backward", "collect", "forward"]),
    ],
    ids=["both states in shared memory", "one of them", "none"],
)
def test_simulated_kernels_equal_the_cpus(states: int, kernels: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.circuits.test_gpu", str(states)],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
        timeout=HANGS,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["right"], "the check of a GPU, also where gradients are off"
    assert result["launched"] == kernels
    for name, differences in result["differences"].items():
        limit = 1e-12 if "float64" in name else 1e-5
        assert max(differences.values()) < limit, (name, differences)


def test_circuits_have_every_kind_of_step() -> None:
    from qrlsuite.plugins.circuits.native.program import HADAMARD, PERMUTE, ROTATE, SIGN, compile_circuit

    programs = [compile_circuit(circuit) for circuit in circuits().values()]
    kinds = {kind for program in programs for kind in program.steps[:, 0].tolist()}
    assert kinds == {ROTATE, HADAMARD, PERMUTE, SIGN}
    assert any(len(program.components) > 1 for program in programs)
    assert {row[5] for program in programs for row in program.steps.tolist()} >= {0, 1, 3}
    assert any(row[4] and row[0] == ROTATE for program in programs for row in program.steps.tolist()), (
        "a phase"
    )


def test_a_missing_package_is_named_once(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(native.importlib.util, "find_spec", lambda name: None)
    native.trouble.cache_clear()
    try:
        for _ in range(2):
            backend = NativeBackend(ansatz("iqp", qubits=2, layers=1))
            assert backend.gpu_simulators == []
        said = capsys.readouterr().err
        assert said.count("plain torch operations") == 1
        assert "pip install 'numba-cuda[cu13]'" in said
    finally:
        native.trouble.cache_clear()


if __name__ == "__main__":
    main(int(sys.argv[1]))
